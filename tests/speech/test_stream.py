"""What a stream says of the frames that it gives, next to the frames themselves."""

from __future__ import annotations

import numpy as np

from facediff.speech.stream import AnimationStream


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

    def finish(points: np.ndarray, start: int, acted: object) -> tuple[np.ndarray, np.ndarray | None]:
        return points, np.full((len(points), 6), float(start)) if len(points) else None

    stream = AnimationStream(OneAtATime(), finish=finish, rate=32_000)
    for index in range(3):
        assert len(stream.feed(np.zeros(3200, np.float32))) == 1
        np.testing.assert_array_equal(stream.heads, np.full((1, 6), float(index)))
    assert len(stream.finish()) == 1
    np.testing.assert_array_equal(stream.heads, np.full((1, 6), 3.0))
