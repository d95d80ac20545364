"""An animation survives its file; what does not fit together is refused with one sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation, metres_per_unit, read_animation, read_archive, write_archive
from facediff.animation.animation import MotionMap, allocate_like, stretches_of
from facediff.animation.archives import AnimationFacts
from facediff.errors import FaceDiffError
from facediff.pipelines.stages import SampleMotion
from facediff.utils.arrays import open_array


@pytest.fixture
def animation() -> Animation:
    rng = np.random.default_rng(0)
    template = rng.normal(size=(6, 3)).astype(np.float32)
    return Animation(
        name="hello",
        vertices=template + rng.normal(0, 0.1, (5, 6, 3)).astype(np.float32),
        template=template,
        frame_rate=25.0,
        faces=np.array([[0, 1, 2], [3, 4, 5]], np.int32),
        unit="mm",
        speech=np.linspace(-1, 1, 3300, dtype=np.float32),
        colours=rng.integers(0, 255, (6, 3)).astype(np.uint8),
        regions={"lips": np.array([1, 2])},
        inner_lip_pairs=np.array([[0, 1]]),
        metadata={"identity": "Zoë"},
    )


def test_archive_gives_back_every_field_without_pickle(animation: Animation, tmp_path: Path) -> None:
    write_archive(tmp_path / "a.npz", animation)
    back = read_archive(tmp_path / "a.npz")
    for name, value in vars(animation).items():
        if name == "regions":
            assert back.regions.keys() == value.keys()
            assert np.array_equal(back.regions["lips"], value["lips"])
        elif isinstance(value, np.ndarray):
            assert np.array_equal(getattr(back, name), value)
        else:
            assert getattr(back, name) == value
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        assert set(archive.files) >= {"vertices", "template", "faces", "speech", "about", "region_lips"}


def test_sound_is_as_long_as_the_picture(animation: Animation) -> None:
    sound = animation.sound()
    assert sound is not None
    assert len(sound) == 3200
    assert np.array_equal(sound, animation.speech[:3200])  # type: ignore[index]
    longer = replace(animation, speech=animation.speech[:100]).sound()  # type: ignore[index]
    assert longer is not None
    assert len(longer) == 3200
    assert not longer[100:].any()


def test_a_part_has_the_sound_of_its_time(animation: Animation) -> None:
    part = animation.part(slice(2, 4))
    assert np.array_equal(part.speech, animation.speech[2 * 640 :])  # type: ignore[arg-type, index]


def test_bare_array_needs_a_frame_rate_and_may_be_flat(animation: Animation, tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", animation.vertices.reshape(5, -1))
    with pytest.raises(FaceDiffError, match="frame_rate"):
        read_animation(tmp_path / "x.npy")
    read = read_animation(tmp_path / "x.npy", AnimationFacts(frame_rate=30, template=animation.template))
    assert np.array_equal(read.vertices, animation.vertices)
    assert np.array_equal(
        read_animation(tmp_path / "x.npy", AnimationFacts(frame_rate=30)).template, animation.vertices[0]
    )


def test_overrides_take_precedence_over_an_archive(animation: Animation, tmp_path: Path) -> None:
    write_archive(tmp_path / "a.npz", animation)
    read = read_animation(tmp_path / "a.npz", AnimationFacts(frame_rate=60, regions={"jaw": np.array([0])}))
    assert read.frame_rate == 60
    assert set(read.regions) == {"lips", "jaw"}
    assert read.unit == "mm"


def test_defaults_never_override_a_file(animation: Animation, tmp_path: Path) -> None:
    defaults = AnimationFacts(
        template=animation.template + 1,
        faces=animation.triangles[:1],
        frame_rate=60,
        unit="m",
        regions={"lips": np.array([5]), "jaw": np.array([0])},
        inner_lip_pairs=np.array([[3, 4]]),
    )
    write_archive(tmp_path / "a.npz", replace(animation, inner_lip_pairs=None))
    read = read_animation(tmp_path / "a.npz", None, defaults)
    assert np.array_equal(read.template, animation.template)
    assert np.array_equal(read.triangles, animation.triangles)
    assert (read.frame_rate, read.unit) == (25, "mm")
    assert read.inner_lip_pairs is not None
    assert read.inner_lip_pairs.tolist() == [[3, 4]]
    assert {name: indices.tolist() for name, indices in read.regions.items()} == {"lips": [1, 2], "jaw": [0]}
    np.save(tmp_path / "x.npy", animation.vertices)
    bare = read_animation(tmp_path / "x.npy", AnimationFacts(unit="cm"), defaults)
    assert np.array_equal(bare.template, animation.template + 1)
    assert (bare.frame_rate, bare.unit) == (60, "cm")
    other = AnimationFacts(defaults, template=np.zeros((9, 3), np.float32), inner_lip_pairs=np.array([[7, 8]]))
    assert read_animation(tmp_path / "a.npz", None, other).inner_lip_pairs is None  # of another topology
    read = read_animation(tmp_path / "x.npy", AnimationFacts(template=animation.template), other)
    assert (read.faces, read.frame_rate, read.regions) == (None, 60, {})


def test_archive_is_never_written_with_motion_that_is_not_finite(animation: Animation, tmp_path: Path) -> None:
    vertices = animation.vertices.copy()
    vertices[3, 2, 1] = np.nan
    with pytest.raises(FaceDiffError, match="frame 3 holds NaN"):
        write_archive(tmp_path / "a.npz", replace(animation, vertices=vertices))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("m", 1.0), ("mm", 0.001), ("0.5", 0.5), ("normalised (the root of its area is 1, about 185 mm)", 0.185)],
)
def test_metres_per_unit(unit: str, metres: float) -> None:
    assert metres_per_unit(unit) == pytest.approx(metres)


def test_motion_in_a_file_is_read_and_written_as_an_array(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facediff.animation.animation.MAPPED_BYTES", 1000)
    motion = np.random.default_rng(0).random((90, 7, 3)).astype(np.float32)
    np.save(tmp_path / "motion.npy", motion)
    mapped = open_array(tmp_path / "motion.npy").view(MotionMap)
    parts = [vertices for _, vertices in stretches_of(mapped)]
    assert [len(part) for part in parts] == [32, 32, 26]
    assert not isinstance(parts[0], np.memmap)
    np.testing.assert_array_equal(np.concatenate(parts), motion)
    np.testing.assert_array_equal(mapped[[3, 80]], motion[[3, 80]])
    np.testing.assert_array_equal([*mapped], motion)
    room = allocate_like(mapped)
    for index, frame in enumerate(motion):
        room[index] = 2 * frame
    np.testing.assert_array_equal(room, 2 * motion)
    sample = SampleMotion(1, "x", None)
    sample.settle(Animation("x", mapped, motion[0], 25.0, speech=np.ones(9000, np.float32)))
    sample.change(lambda stretch: stretch)
    assert len(sample.animation().speech) == 9000  # type: ignore[arg-type]
