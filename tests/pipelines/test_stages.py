"""What a stream says of the frames that it gives, next to the frames themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from facediff.animation import Animation
from facediff.pipelines.stages import AnimationStream, Each, Follow, Stretch


class OneAtATime:
    """A model that gives a frame for every piece of speech, and has none left at the end."""

    frames = 0

    def feed(self, samples: np.ndarray) -> np.ndarray:
        self.frames += 1
        return np.full((1, 2, 3), self.frames, np.float32)

    def finish(self) -> np.ndarray:
        return np.zeros((0, 2, 3), np.float32)


def test_heads_are_those_of_the_frames_that_are_given() -> None:
    """Resampled speech has a last piece of its own, after which the model may have no frame left."""

    def decode(stretch: Stretch) -> Stretch:
        head = np.full((len(stretch), 6), float(stretch.start))
        face = np.zeros((2, 3), np.float32)
        return (
            replace(stretch, animation=Animation("face", stretch.points, face, 25, head=head)) if len(head) else stretch
        )

    stream = AnimationStream(OneAtATime(), [Each(decode)], rate=32_000)
    for index in range(3):
        assert len(stream.feed(np.zeros(3200, np.float32))) == 1
        np.testing.assert_array_equal(stream.heads, np.full((1, 6), float(index)))
    assert len(stream.finish()) == 1
    np.testing.assert_array_equal(stream.heads, np.full((1, 6), 3.0))


class Late:
    """Gives each frame its number as a value, two frames late."""

    fed = 0

    def feed(self, speech: np.ndarray) -> np.ndarray:
        self.fed += 1
        return np.array([self.fed - 3.0]) if self.fed > 2 else np.zeros(0)

    def finish(self, frames: int) -> np.ndarray:
        return np.arange(max(0.0, self.fed - 2), frames)


def test_frames_wait_for_their_own_values_and_keep_their_numbers() -> None:
    def check(stretch: Stretch, values: np.ndarray) -> Stretch:
        np.testing.assert_array_equal(values, stretch.start + np.arange(len(stretch)))
        np.testing.assert_array_equal(stretch.points[:, 0, 0], 1 + values)
        return stretch

    stream = AnimationStream(OneAtATime(), [Follow(Late(), check), Follow(Late(), check)])
    assert [len(stream.feed(np.zeros(1600, np.float32))) for _ in range(5)] == [0, 0, 1, 1, 1]
    assert len(stream.finish()) == 2
