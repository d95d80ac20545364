from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.errors import FaceDiffError
from facediff.evaluation import evaluate
from facediff.metrics import Region, protocol
from tests.evaluation.conftest import (
    LENGTHS,
    LIPS,
    OF_VERTICES,
    UPPER,
    VERTICES,
    Files,
    expected,
    scores_of,
)


def subject(clip: str) -> str:
    return clip.rpartition("_")[0]


def expected_of(files: Files, clips: list[str], method: str = "ours") -> dict[str, float]:
    return expected(
        [files.read(files.truth / f"{clip}.npy") for clip in clips],
        [files.read(files.method(method) / f"{clip}_condition_{subject(clip)}.npy") for clip in clips],
        [files.templates[subject(clip)].astype(np.float64) for clip in clips],
    )


@pytest.mark.parametrize("workers", [1, 2])
def test_every_protocol_gives_what_the_released_scripts_give(shared_files: Files, workers: int) -> None:
    report = shared_files.evaluate(protocols=OF_VERTICES, workers=workers)
    assert scores_of(report) == pytest.approx(expected_of(shared_files, list(LENGTHS)), rel=1e-6)
    assert {(score.frames, score.sequences) for score in report.methods[0].scores} == {(sum(LENGTHS.values()), 5)}


def test_the_pooled_numbers_are_those_of_protocol_metrics_to_the_last_digits(shared_files: Files) -> None:
    found = scores_of(shared_files.evaluate(protocols=OF_VERTICES))
    for name in OF_VERTICES:
        metrics = protocol(name).build(Region.from_indices("lips", LIPS), Region.from_indices("upper", UPPER))
        for clip in LENGTHS:
            paths = (
                shared_files.method() / f"{clip}_condition_{subject(clip)}.npy",
                shared_files.truth / f"{clip}.npy",
            )
            prediction, truth = (torch.from_numpy(shared_files.read(path)) for path in paths)
            template = torch.from_numpy(shared_files.templates[subject(clip)])
            metrics.update(prediction, truth, template=template, clip_names=[clip])
        for metric, value in metrics.compute().items():
            assert found[f"{name}/{metric}"] == pytest.approx(value.item(), rel=1e-12)


def test_digits_depend_neither_on_workers_nor_on_the_other_protocols(shared_files: Files) -> None:
    one = scores_of(shared_files.evaluate(protocols=OF_VERTICES, workers=1))
    assert scores_of(shared_files.evaluate(protocols=OF_VERTICES[::-1], workers=2)) == one
    for name in OF_VERTICES:
        alone = scores_of(shared_files.evaluate(protocols=[name]))
        assert alone == {key: value for key, value in one.items() if key.startswith(f"{name}/")}


@pytest.mark.parametrize(
    ("pattern", "name"),
    [
        ("{subject}_{sentence}", "{subject}_{sentence}"),
        ("{sentence}-{subject}", "{sentence}-{subject}"),
        ("{subject}/{sentence}.npy", "{subject}/{sentence}"),
        ("run3_{identity}_as_{subject}_{sentence}", "run3_{subject}_as_{subject}_{sentence}"),
    ],
)
def test_files_may_be_named_otherwise(files: Files, tmp_path: Path, pattern: str, name: str) -> None:
    for clip in reversed(LENGTHS):
        fields = {"subject": subject(clip), "sentence": clip.rpartition("_")[2]}
        target = tmp_path / "renamed" / f"{name.format(**fields)}.npy"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(files.method() / f"{clip}_condition_{subject(clip)}.npy", target)
    given = files.evaluate()
    options = {} if name == "{subject}_{sentence}" else {"patterns": [pattern]}
    shutil.rmtree(files.method())
    (tmp_path / "renamed").rename(files.method())
    assert scores_of(files.evaluate(**options)) == scores_of(given)


def test_subjects_with_underscores_are_told_by_templates_or_by_the_condition(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    region = Region.from_indices("lips", [0])
    truth, ours = tmp_path / "truth", tmp_path / "ours"
    for folder in (truth, ours):
        folder.mkdir()
    np.save(truth / "M003_happy_1_011.npy", rng.random((4, 6)))
    for condition in ("M003", "W009"):
        np.save(ours / f"M003_happy_1_011_condition_{condition}.npy", rng.random((4, 6)))
    options = {"lips": region, "n_vertices": 2, "protocols": ["meshtalk"], "bootstrap": 0}
    for templates in (None, {"M003": torch.zeros(2, 3), "M": torch.zeros(2, 3)}):
        report = evaluate({"ours": ours}, truth, templates=templates, **options)
        assert report.methods[0].sequences[0].conditions == ("M003",)
        assert report.methods[0].missing.unused == ["M003_happy_1_011_condition_W009.npy"]
    assert report.methods[0].sequences[0].subject == "M003"
    assert report.methods[0].sequences[0].sentence == "happy_1_011"


def test_conditions_are_chosen_or_averaged(files: Files) -> None:
    rng = np.random.default_rng(2)
    clips = ["A_e01", "A_e03"]
    for clip in clips:
        motion = files.read(files.truth / f"{clip}.npy")
        files.write(files.method() / f"{clip}_condition_B_C.npy", motion + 0.1 * rng.standard_normal(motion.shape))
    own = files.evaluate(protocols=OF_VERTICES)
    assert scores_of(own) == pytest.approx(expected_of(files, list(LENGTHS)), rel=1e-6)
    assert own.methods[0].missing.unused == [f"{clip}_condition_B_C.npy" for clip in clips]
    truths = [files.read(files.truth / f"{clip}.npy") for clip in clips]
    templates = [files.templates["A"].astype(np.float64)] * 2
    by_condition = {
        condition: expected(
            truths,
            [files.read(files.method() / f"{clip}_condition_{condition}.npy") for clip in clips],
            templates,
        )
        for condition in ("A", "B_C")
    }
    for clip in set(LENGTHS) - set(clips):
        (files.method() / f"{clip}_condition_{subject(clip)}.npy").unlink()
    named = files.evaluate(protocols=OF_VERTICES, identity="B_C")
    assert scores_of(named) == pytest.approx(by_condition["B_C"], rel=1e-6)
    every = files.evaluate(protocols=OF_VERTICES, identity="all")
    mean = {key: (by_condition["A"][key] + by_condition["B_C"][key]) / 2 for key in by_condition["A"]}
    assert scores_of(every) == pytest.approx(mean, rel=1e-6)
    assert every.methods[0].sequences[0].conditions == ("A", "B_C")
    assert every.methods[0].scores[0].frames == 2 * sum(LENGTHS[clip] for clip in clips)
    assert every.methods[0].missing.without_prediction == ["A_e02", "B_C_e01", "B_C_e02"]


def test_frames_cut_are_counted_and_a_protocol_may_refuse(files: Files) -> None:
    long, short = files.method() / "A_e01_condition_A.npy", files.method() / "A_e03_condition_A.npy"
    files.write(long, np.concatenate([files.read(long), np.full((3, VERTICES, 3), 7.0)]))
    report = files.evaluate(protocols=["paper", "codetalker"])
    assert scores_of(report)["paper/lve"] == pytest.approx(expected_of(files, list(LENGTHS))["paper/lve"], rel=1e-6)
    files.write(short, files.read(short)[:-4])
    report = files.evaluate(protocols=["paper", "diffspeaker"])
    wanted = expected_of(files, list(LENGTHS))
    assert scores_of(report) == pytest.approx({key: wanted[key] for key in scores_of(report)}, rel=1e-6)
    rows = {row.clip: (row.cut_prediction, row.cut_truth, row.frames) for row in report.methods[0].sequences}
    assert rows["A_e01"] == (3, 0, 9)
    assert rows["A_e03"] == (0, 4, 10)
    with pytest.raises(FaceDiffError, match="protocol codetalker: A_e03_condition_A: the prediction has 10 frames"):
        files.evaluate(protocols=["codetalker"])


def test_truth_at_a_higher_frame_rate_is_thinned(files: Files) -> None:
    wanted = scores_of(files.evaluate(protocols=OF_VERTICES))
    for clip in LENGTHS:
        path = files.truth / f"{clip}.npy"
        frames = files.read(path)
        np.save(path, np.stack([frames, frames + 1], 1).reshape(-1, VERTICES, 3))
    assert scores_of(files.evaluate(protocols=OF_VERTICES, truth_stride=2)) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("side", ["truth", "prediction"])
def test_nan_names_its_clip(files: Files, side: str) -> None:
    path = files.truth / "A_e03.npy" if side == "truth" else files.method() / "A_e03_condition_A.npy"
    array = files.read(path)
    array[5, 17] = np.nan
    files.write(path, array)
    with pytest.raises(
        FaceDiffError, match=rf"the {side} of A_e03_condition_A holds NaN or infinity, first in frame 5"
    ):
        files.evaluate(workers=2)


def test_everything_that_is_not_scored_is_told(files: Files) -> None:
    ours = files.method()
    (ours / "A_e01_condition_A.npy").write_bytes(b"no array")
    files.write(ours / "A_e02_condition_A.npy", np.zeros((4, VERTICES + 1, 3)))
    (ours / "A_e03_condition_A.npy").unlink()
    files.write(ours / "A_e40_condition_A.npy", np.zeros((4, VERTICES, 3)))
    files.write(ours / "B_C_e01_condition_A.npy", np.zeros((4, VERTICES, 3)))
    files.write(ours / "notes.npy", np.zeros((4, VERTICES, 3)))
    files.write(ours / ".A_e03.partial-1.npy", np.zeros((4, VERTICES, 3)))
    files.write(files.truth / "D_e01.npy", np.zeros((4, VERTICES, 3)))
    files.write(ours / "D_e01_condition_D.npy", np.zeros((4, VERTICES, 3)))
    files.write(files.truth / "calibration.npy", np.zeros((4, VERTICES, 3)))
    report = files.evaluate()
    missing = report.methods[0].missing
    assert [row.clip for row in report.methods[0].sequences] == ["B_C_e01", "B_C_e02"]
    assert scores_of(report)["paper/fdd"] == pytest.approx(
        expected_of(files, ["B_C_e01", "B_C_e02"])["paper/fdd"], rel=1e-6
    )
    assert missing.without_prediction == ["A_e03"]
    assert missing.without_truth == ["A_e40_condition_A.npy"]
    assert missing.unused == ["B_C_e01_condition_A.npy"]
    assert missing.unnamed == ["notes.npy"]
    assert report.unnamed_truths == ["calibration.npy"]
    assert list(missing.unusable) == ["A_e01", "A_e02", "D_e01"]
    assert "not a readable NumPy array" in missing.unusable["A_e01"]
    assert "expected (frames, 60)" in missing.unusable["A_e02"]
    assert missing.unusable["D_e01"] == "no template for D"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"protocols": ["papers"]}, "unknown protocol 'papers'"),
        ({"templates": None}, "FDD needs .*--templates"),
        ({"upper_face": None}, "protocol paper: .* give the upper-face region"),
        ({"lips": Region.from_indices("far", [99])}, "protocol paper: .* hold the index 99"),
        ({"topology": "biwi"}, "protocol paper|23370"),
        ({"patterns": ["{subject}"]}, "{subject}: a pattern of file names has"),
        ({"patterns": ["{subject}_{sentence}_{style}"]}, "no other field"),
        ({"identity": "Z"}, "no prediction has this condition"),
        ({"n_vertices": 21}, "no clip can be scored; A_e01: .*expected"),
        ({"patterns": ["x{subject}_{sentence}"]}, "no file's name fits the pattern, such as A_e01_condition_A.npy"),
        ({"truth_pattern": "{sentence}_{subject}", "templates": None, "protocols": ["meshtalk"]}, "has a truth"),
        ({"truth": Path("nowhere")}, "nowhere: no .npy file"),
        ({"level": 95}, "level 95"),
    ],
)
def test_mistakes_are_told_in_one_sentence(shared_files: Files, options: dict[str, object], message: str) -> None:
    with pytest.raises(FaceDiffError, match=message):
        shared_files.evaluate(**options)
