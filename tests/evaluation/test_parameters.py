"""Files of parameters scored: layouts, rigs, units, conversations, and what is refused with what it lacks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facediff.cli.app import run
from facediff.errors import FaceDiffError
from facediff.mesh.flame import Flame
from facediff.spaces import layout
from facediff.spaces.files import ParameterClip, write_parameters
from facediff.spaces.operations import permuted
from tests.fakes.flame import write_flame

Array = np.ndarray[Any, np.dtype[np.float64]]
CLIPS = {"ann_a": 40, "ann_b": 25}
LIPS, UPPER = (1, 3), (0, 2)


def write(folder: Path, name: str, values: Array, layout_name: str, suffix: str = ".npy") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    space = layout(layout_name)
    clip = ParameterClip(name, values.astype(np.float32), space, 25.0, layout=layout_name)
    write_parameters(folder / f"{name}{suffix}", clip, layout=layout_name if suffix == ".npy" else "")


def scores(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, float]:
    assert run("evaluate", [*map(str, words), "--quiet", "--bootstrap", "0", "--json", "-"]) == 0
    (method,) = json.loads(capsys.readouterr().out)["methods"]
    return {score["metric"]: score["value"] for score in method["scores"]}


def refused(*words: object) -> str:
    with pytest.raises(FaceDiffError) as error:
        run("evaluate", [*map(str, words), "--quiet"])
    return str(error.value)


@pytest.fixture
def dialogue(tmp_path: Path) -> tuple[Path, Path, dict[str, list[Array]]]:
    """Truths in DualTalk's order of ground truth, predictions in that of its network, and partners."""
    random = np.random.default_rng(0)
    numbers: dict[str, list[Array]] = {}
    for clip, frames in CLIPS.items():
        truth, prediction, partner = 0.3 * random.standard_normal((3, frames, 56))
        numbers[clip] = [x.astype(np.float32).astype(np.float64) for x in (prediction, truth, partner)]
        write(tmp_path / "truth", clip, truth, "flame_dualtalk_truth")
        write(tmp_path / "truth" / "partner", clip, partner, "flame_dualtalk_truth")
        own, _ = permuted(prediction, layout("flame_dualtalk_truth"), layout("flame_dualtalk"))
        write(tmp_path / "ours", clip, own, "flame_dualtalk")
    return tmp_path / "ours", tmp_path / "truth", numbers


def test_dualtalk_by_numpy(
    dialogue: tuple[Path, Path, dict[str, list[Array]]], capsys: pytest.CaptureFixture[str]
) -> None:
    ours, truth, numbers = dialogue
    layouts = ("--layout", "flame_dualtalk", "--truth-layout", "flame_dualtalk_truth")
    found = scores(capsys, ours, truth, *layouts, "--protocol", "dualtalk")
    every = [np.concatenate([clip[side] for clip in numbers.values()]) for side in range(3)]
    assert found["mve"] == pytest.approx(((every[0] - every[1]) ** 2).mean(), rel=1e-6)
    head = slice(50, 53)  # of the ground truth's order
    spread = np.mean([clip[0][:, head].var(0).mean() for clip in numbers.values()])
    assert found["var_head"] == pytest.approx(spread, rel=1e-6)
    gaps = [
        abs(np.corrcoef(g.ravel(), q.ravel())[0, 1] - np.corrcoef(p.ravel(), q.ravel())[0, 1])
        for p, g, q in ((x[:, head] for x in clip) for clip in numbers.values())
    ]
    assert found["rpcc_head"] == pytest.approx(np.mean(gaps), rel=1e-6)
    assert 0 < found["sid_jaw"] <= np.log2(10)
    assert found["p_fd_jaw"] != found["fd_jaw"]


def test_predictions_may_lie_in_the_folder_of_the_truth(
    dialogue: tuple[Path, Path, dict[str, list[Array]]], capsys: pytest.CaptureFixture[str]
) -> None:
    ours, truth, numbers = dialogue
    inside = ours.rename(truth / "ours")
    layouts = ("--layout", "flame_dualtalk", "--truth-layout", "flame_dualtalk_truth")
    found = scores(capsys, inside, truth, *layouts, "--protocol", "facediffuser_beat")
    gaps = np.concatenate([clip[0] - clip[1] for clip in numbers.values()])
    assert found["mve"] == pytest.approx(np.abs(gaps).mean(), rel=1e-5)


def test_artalk_and_unils_on_a_head_that_does_not_turn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = write_flame(tmp_path / "model.pkl")
    flame = Flame.read(model)
    random = np.random.default_rng(1)
    (tmp_path / "lips.txt").write_text("1,3")
    (tmp_path / "upper.txt").write_text("0,2")
    gaps, spreads, jaws = [], [], []
    (tmp_path / "truth" / "speaking").mkdir(parents=True)
    for clip, frames in CLIPS.items():
        truth, prediction = 0.2 * random.standard_normal((2, frames, 106)).astype(np.float32)
        speaking = random.random(frames) < 0.5
        np.save(tmp_path / "truth" / "speaking" / f"{clip}.npy", speaking)
        write(tmp_path / "truth", clip, truth, "flame_artalk")
        write(tmp_path / "ours", clip, prediction, "flame_artalk")
        vertices = [
            flame.vertices(np.zeros(0), x[:, :100].astype(float), x[:, 103:].astype(float)) for x in (prediction, truth)
        ]
        gaps.append(((1000 * (vertices[0] - vertices[1])) ** 2).sum(-1))
        moved = [((1000 * (x - flame.template)) ** 2).sum(-1)[:, UPPER].std(0).mean() for x in vertices]
        spreads.append(abs(moved[0] - moved[1]))
        jaws.append(100 * np.abs(prediction[speaking, 103:].std(0) - truth[speaking, 103:].std(0)).mean().astype(float))
    words = [tmp_path / "ours", tmp_path / "truth", "--layout", "flame_artalk", "--rig", model]
    words += ["--lips", tmp_path / "lips.txt", "--upper-face", tmp_path / "upper.txt"]
    found = scores(capsys, *words, "--protocol", "artalk")
    assert found["lve"] == pytest.approx(np.mean([np.sqrt(x[:, LIPS].max(1).mean()) for x in gaps]), rel=1e-3)
    assert found["mhd"] == pytest.approx(np.mean([np.sqrt(x.mean()) for x in gaps]), rel=1e-3)
    assert found["fdd"] == pytest.approx(np.mean(spreads), rel=1e-3)
    centimetres = scores(capsys, *words, "--protocol", "artalk", "--unit", "cm")
    assert centimetres["lve"] == pytest.approx(found["lve"] / 10, rel=1e-9)
    split = scores(capsys, *words, "--protocol", "unils")
    assert split["s_jdd"] == pytest.approx(np.mean(jaws), rel=1e-5)
    assert split["lve"] == pytest.approx(found["lve"], rel=1e-9)
    assert min(split["s_lve"], split["l_lve"]) < split["lve"] < max(split["s_lve"], split["l_lve"])


def test_facediffuser_on_the_weights_of_beat(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(2)
    space = layout("arkit_51")
    gaps, deviations = [], []
    for clip, frames in CLIPS.items():
        truth, prediction = random.uniform(0, 1, (2, frames, 51)).astype(np.float32)
        write(tmp_path / "truth", clip, truth, "arkit_51", ".json")
        write(tmp_path / "ours", clip, prediction, "arkit_51", ".json")
        truth, prediction = truth.astype(float), prediction.astype(float)
        gaps.append((prediction - truth) ** 2)
        brows = list(space.region("upper_face"))
        deviations.append((truth[:, brows] ** 2).std(0).mean() - (prediction[:, brows] ** 2).std(0).mean())
    found = scores(capsys, tmp_path / "ours", tmp_path / "truth", "--protocol", "facediffuser_beat")
    squares = np.concatenate(gaps)
    assert found["mve"] == pytest.approx(np.sqrt(squares).mean(), rel=1e-5)
    assert found["lve"] == pytest.approx(squares[:, list(space.region("lips"))].max(1).mean(), rel=1e-5)
    assert found["fdd"] == pytest.approx(np.mean(deviations), rel=1e-4)
    assert found["fdd_absolute"] == pytest.approx(np.mean(np.abs(deviations)), rel=1e-4)
    write(tmp_path / "ours", "ann_a", truth[:, :51], "arkit_51", ".json")
    text = (tmp_path / "ours" / "ann_a.json").read_text().replace("jawOpen", "jawOpen2")
    (tmp_path / "ours" / "ann_a.json").write_text(text)
    assert run("evaluate", [str(tmp_path / "ours"), str(tmp_path / "truth"), "--protocol", "facediffuser_beat"]) == 0
    assert "ann_a is left out" in capsys.readouterr().out


def test_mask_and_partner_have_the_stride_of_the_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(4)
    truth, partner = random.uniform(0, 1, (2, 40, 51)).astype(np.float32)
    prediction, speaking = random.uniform(0, 1, (20, 51)).astype(np.float32), random.random(40) < 0.5
    for folder, values, rate in (("truth", truth, 50.0), ("truth/partner", partner, 50.0), ("ours", prediction, 25.0)):
        (tmp_path / folder).mkdir()
        clip = ParameterClip("ann_a", values, layout("arkit_51"), rate, layout="arkit_51")
        write_parameters(tmp_path / folder / "ann_a.json", clip)
    (tmp_path / "truth" / "speaking").mkdir()
    np.save(tmp_path / "truth" / "speaking" / "ann_a.npy", speaking)
    words = [tmp_path / "ours", tmp_path / "truth", "--truth-stride", 2, "--protocol", "facediffuser_beat"]
    words += ["--metric", "s_channel_variance", "--metric", "residual_partner_correlation"]
    found = scores(capsys, *words)
    assert found["s_channel_variance"] == pytest.approx(prediction[speaking[::2]].var(0).mean(), rel=1e-4)
    both = [np.corrcoef(side.ravel(), partner[::2].ravel())[0, 1] for side in (prediction, truth[::2])]
    assert found["residual_partner_correlation"] == pytest.approx(abs(both[1] - both[0]), rel=1e-4)
