"""NumPy's files in a declared layout: read, written and read again; bare ones refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.spaces.files import ParameterClip, read_parameters, write_parameters
from facediff.spaces.layouts import LAYOUTS, layouts_of_width

RNG = np.random.default_rng(0)


def test_every_layout_written_and_read_again_is_the_same(tmp_path: Path) -> None:
    for name, entry in LAYOUTS.items():
        values = RNG.normal(0, 0.2, (5, len(entry.space.channels))).astype(np.float32)
        person = RNG.normal(size=entry.identity or 100).astype(np.float32)
        for suffix in (".npy", ".npz") if entry.arrays else (".npy",):
            path = tmp_path / f"{name}{suffix}"
            keeps = bool(entry.identity) if suffix == ".npy" else bool(entry.identity_array)
            clip = ParameterClip(name, values, entry.space, 25.0, identity=person if keeps else None, layout=name)
            write_parameters(path, clip)
            read = read_parameters(path, layout=name, frame_rate=25.0)
            assert np.array_equal(read.values, values), path
            assert read.space == entry.space
            assert (read.identity is None) != keeps
            assert read.identity is None or np.array_equal(read.identity, person)


def test_a_bare_array_is_refused_with_the_layouts_of_its_width(tmp_path: Path) -> None:
    for width in {entry.width for entry in LAYOUTS.values()}:
        np.save(tmp_path / "a.npy", np.zeros((3, width), np.float32))
        with pytest.raises(FaceDiffError) as refused:
            read_parameters(tmp_path / "a.npy")
        assert all(name in str(refused.value) for name in layouts_of_width(width))
    np.save(tmp_path / "a.npy", np.zeros((3, 413)))
    with pytest.raises(FaceDiffError, match="flame_emote of 103"):
        read_parameters(tmp_path / "a.npy", layout="flame_emote")


def test_an_archive_needs_a_layout_and_its_widths(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, exp=np.zeros((4, 50)), pose=np.zeros((4, 6)), shape=np.zeros((4, 100)))
    with pytest.raises(FaceDiffError, match="flame_diffposetalk, flame_dualtalk_truth, flame_emoca"):
        read_parameters(path)
    with pytest.raises(FaceDiffError, match="frame rate"):
        read_parameters(path, layout="flame_emoca")
    assert read_parameters(path, layout="flame_diffposetalk").frame_rate == 25.0
    np.savez(path, exp=np.zeros((4, 100)), pose=np.zeros((4, 6)))
    with pytest.raises(FaceDiffError, match="exp has 100 columns"):
        read_parameters(path, layout="flame_diffposetalk")


def test_pickles_are_never_loaded(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "a.npz", exp=np.array([{"a": 1}], dtype=object), pose=np.zeros((1, 6)))
    for suffix in (".npy", ".npz"):
        with pytest.raises(FaceDiffError, match=f"a{suffix}"):
            read_parameters(tmp_path / f"a{suffix}", layout="flame_diffposetalk")


def motion(head: bool = False) -> np.ndarray:
    """Turns (200, 3) of a head, or of a jaw, which opens about x alone."""
    wave = np.sin(np.linspace(0, 40, 200))[:, None]
    return wave * [0.1, 0.15, 0.08] if head else np.abs(wave) * [0.2, 0.005, 0.005]


@pytest.mark.parametrize("exchanged", [False, True])
def test_head_and_jaw_that_may_be_exchanged_are_reported_and_kept(tmp_path: Path, exchanged: bool) -> None:
    values = RNG.normal(size=(200, 106)).astype(np.float32)
    values[:, 100:103], values[:, 103:] = motion(not exchanged), motion(exchanged)
    np.save(tmp_path / "a.npy", values)
    clip = read_parameters(tmp_path / "a.npy", layout="flame_artalk")
    assert np.array_equal(clip.values, values)
    assert any("exchanged" in note for note in clip.notes) == exchanged


def test_fifty_coefficients_in_a_hundred_are_reported(tmp_path: Path) -> None:
    values = RNG.normal(size=(20, 103)).astype(np.float32)
    values[:, 50:100] = 0
    np.save(tmp_path / "a.npy", values)
    assert any("50 to 99" in note for note in read_parameters(tmp_path / "a.npy", layout="flame_emote").notes)


def test_a_person_that_changes_and_nan_are_refused(tmp_path: Path) -> None:
    values = RNG.normal(size=(20, 403)).astype(np.float32)
    np.save(tmp_path / "a.npy", values[None])
    with pytest.raises(FaceDiffError, match="shape 300"):
        read_parameters(tmp_path / "a.npy", layout="flame_3dmead")
    values[:, :300] = values[0, :300]
    values[7, 350] = np.nan
    np.save(tmp_path / "a.npy", values[None])
    with pytest.raises(FaceDiffError, match="frame 7"):
        read_parameters(tmp_path / "a.npy", layout="flame_3dmead")
