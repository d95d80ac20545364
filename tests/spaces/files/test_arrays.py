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
        for suffix in (*((".npy",) if entry.flat else ()), *((".npz",) if entry.arrays else ())):
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
    for width in {entry.width for entry in LAYOUTS.values() if entry.flat}:
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


def test_a_person_that_changes_and_nan_are_refused(tmp_path: Path) -> None:
    values = RNG.normal(size=(20, 413)).astype(np.float32)
    np.save(tmp_path / "a.npy", values[None])
    with pytest.raises(FaceDiffError, match="shape 300"):
        read_parameters(tmp_path / "a.npy", layout="unitalker_d5")
    values[:, :300] = values[0, :300]
    values[7, 350] = np.nan
    np.save(tmp_path / "a.npy", values[None])
    with pytest.raises(FaceDiffError, match="frame 7"):
        read_parameters(tmp_path / "a.npy", layout="unitalker_d5")


def test_the_release_of_3dmead_is_read_by_its_datasets(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    random = np.random.default_rng(4)
    parts = {"shape": 300, "exp": 100, "global_pose": 3, "jaw": 3, "cam": 3}
    arrays = {name: random.standard_normal((1, 12, width)).astype(np.float32) for name, width in parts.items()}
    folder = tmp_path / "M003" / "front" / "happy" / "level_1" / "001"
    folder.mkdir(parents=True)
    with h5py.File(folder / "shape_pose_cam.hdf5", "w") as file:
        for name, array in arrays.items():
            file[name] = array
    clip = read_parameters(folder / "shape_pose_cam.hdf5")
    expected = np.concatenate([arrays[name][0] for name in ("exp", "global_pose", "jaw")], axis=1)
    np.testing.assert_array_equal(clip.values, expected)
    assert clip.identity is not None
    np.testing.assert_allclose(clip.identity, arrays["shape"][0].mean(0), rtol=1e-5, atol=1e-6)
    assert (clip.name, clip.frame_rate, clip.layout) == ("001", 25.0, "flame_3dmead_release")
    assert clip.space.head == (100, 101, 102)
    with h5py.File(tmp_path / "half.h5", "w") as file:
        file["exp"] = arrays["exp"]
    with pytest.raises(FaceDiffError, match=r"half\.h5: has no .shape"):
        read_parameters(tmp_path / "half.h5")


def test_the_flat_form_of_3dmead_has_a_shape_for_each_frame(tmp_path: Path) -> None:
    array = np.random.default_rng(5).standard_normal((1, 9, 403)).astype(np.float32)
    np.save(tmp_path / "M003_001_0_0.npy", array)
    clip = read_parameters(tmp_path / "M003_001_0_0.npy", layout="flame_3dmead")
    np.testing.assert_array_equal(clip.values, array[0, :, 300:])
    assert clip.identity is not None
    np.testing.assert_allclose(clip.identity, array[0, :, :300].mean(0), rtol=1e-5, atol=1e-6)


def test_a_style_of_artalk_is_one_tensor(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    motion = torch.randn(50, 106, generator=torch.Generator().manual_seed(0))
    torch.save(motion, tmp_path / "style.pt")
    clip = read_parameters(tmp_path / "style.pt", layout="flame_artalk")
    np.testing.assert_array_equal(clip.values, motion.numpy())
    with pytest.raises(FaceDiffError, match="flame_artalk"):
        read_parameters(tmp_path / "style.pt")
    torch.save({"motion": motion}, tmp_path / "wrapped.pt")
    with pytest.raises(FaceDiffError, match="tensor"):
        read_parameters(tmp_path / "wrapped.pt", layout="flame_artalk")
    (tmp_path / "hostile.pt").write_bytes(b"\x80\x04cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(FaceDiffError, match=r"hostile\.pt"):
        read_parameters(tmp_path / "hostile.pt", layout="flame_artalk")
