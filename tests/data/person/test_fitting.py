"""The steps of an import by themselves: order of files, neutral frames, cuts, splits, faces, FLAME parameters."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from facediff.data.corpus import read_manifest
from facediff.data.person import import_person
from facediff.data.person.fitting import loudness, neutral_frames
from facediff.data.person.importer import cut_points, splits
from facediff.errors import FaceDiffError
from facediff.mesh.flame import Flame
from facediff.utils.pickles import load_pickle
from tests.fakes.flame import flame_arrays, write_flame
from tests.fakes.person import RATE, loud, speech, write_speech


def test_loudness_is_the_root_mean_square_around_a_frame() -> None:
    samples = np.random.default_rng(0).normal(0, 0.1, 32000).astype(np.float32)
    found = loudness(samples, 60, 30.0)
    for frame in (10, 33):
        middle = round((frame + 0.5) / 30 * 16000)
        assert found[frame] == pytest.approx(np.sqrt(np.mean(samples[middle - 1600 : middle + 1600] ** 2)), rel=1e-3)
    assert len(found) == 60
    assert loudness(samples, 90, 30.0)[70:].max() == 0  # past its end there is silence


def test_neutral_frames_are_silent_and_still_at_once() -> None:
    loud_ = np.ones(400)
    speed = np.ones(400)
    loud_[100:200] = 0  # silent, but moving until frame 150
    speed[150:300] = 0  # still, but speaking from frame 200 on
    chosen = neutral_frames(loud_, speed)
    assert len(chosen) == 20
    assert chosen.min() >= 150
    assert chosen.max() < 200


def test_cuts_lie_in_the_quietest_places_and_leave_nothing_out() -> None:
    time = np.arange(1800) / RATE
    cuts = cut_points(loudness(speech(60), 1800, RATE), 8 * RATE)
    assert len(cuts) == round(60 / 8)
    assert cuts[0][0] == 0
    assert cuts[-1][1] == 1800
    assert all(one[1] == other[0] for one, other in zip(cuts, cuts[1:], strict=False))
    assert all(loud(time[start : start + 1])[0] == 0 for start, _ in cuts)
    assert all(4 * RATE <= stop - start <= 12 * RATE for start, stop in cuts)
    assert cut_points(np.ones(50), 240) == [(0, 50)]


@pytest.mark.parametrize(
    ("clips", "train", "val", "test"), [(1, 1, 0, 0), (3, 3, 0, 0), (4, 2, 1, 1), (8, 6, 1, 1), (20, 15, 2, 3)]
)
def test_the_last_clips_test_and_those_before_them_validate(clips: int, train: int, val: int, test: int) -> None:
    assert splits(clips) == ["train"] * train + ["val"] * val + ["test"] * test


def flame_corpus(root: Path) -> Path:
    """A corpus of FLAME's topology whose mean face is the model's."""
    root.mkdir()
    face = flame_arrays()["v_template"]
    (root / "templates.pkl").write_bytes(pickle.dumps({"A": 1.03 * face, "B": 0.97 * face}))
    (root / "manifest.json").write_text('{"frame_rate": 30}')
    return root


@pytest.mark.parametrize("form", ["npy", "hdf5"])
def test_flame_parameters_become_vertices_without_head_pose(tmp_path: Path, form: str) -> None:
    """Against the layer itself; the person has the model's mean shape, so that coordinates stay as they are."""
    random = np.random.default_rng(0)
    time = np.arange(90) / RATE
    expression = 0.3 * np.sin(time[:, None] * random.uniform(1, 3, 100))
    jaw = np.stack([0.2 * loud(time), 0 * time, 0 * time], -1)
    path = tmp_path / f"parameters.{form}"
    if form == "npy":
        np.save(path, np.concatenate([np.zeros((90, 300)), expression, jaw], 1)[None].astype(np.float32))
    else:
        import h5py

        with h5py.File(path, "w") as file:
            values = {"shape": np.zeros((90, 300)), "exp": expression, "jaw": jaw, "global_pose": jaw + 0.4}
            for name, value in values.items():
                file[name] = value[None].astype(np.float32)
    model = write_flame(tmp_path / "model.npz", form="npz")
    corpus = flame_corpus(tmp_path / "corpus")
    arguments = {
        "audio": write_speech(tmp_path / "sound.wav", 3),
        "name": "Target",
        "corpus": corpus,
        "output": tmp_path / "out",
        "frame_rate": RATE,
    }
    with pytest.raises(FaceDiffError, match="--flame MODEL"):
        import_person(path, **arguments)  # type: ignore[arg-type]
    report = import_person(path, **arguments, flame=model)  # type: ignore[arg-type]
    assert (report.has_head_motion, report.rotation_max, report.scale) == (False, 0, 1)
    assert report.template_source == "the model's shape without expression"
    np.testing.assert_allclose(
        load_pickle(tmp_path / "out" / "templates.pkl")["Target"], flame_arrays()["v_template"], atol=1e-6
    )
    made = np.load(tmp_path / "out" / "vertices_npy" / "Target_s01.npy").reshape(90, -1, 3)
    true = Flame.read(model).vertices(np.zeros(3), expression.astype("f4"), jaw.astype("f4"))
    np.testing.assert_allclose(made, true, atol=1e-6)
    assert read_manifest(tmp_path / "out")["report"]["has_head_motion"] is False
