"""The numbers behind figures against plain NumPy, and what makes them refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from facediff.errors import FaceDiffError
from facediff.evaluation.figures import (
    FigureData,
    Moment,
    choose_scalars,
    error_maps,
    find_clips,
    find_metrics,
    find_phoneme,
    frame_at,
    motion_maps,
    opening_curves,
    pick_frames,
    read_curves,
    read_pairs,
    read_phonemes,
    smooth,
)
from facediff.evaluation.figures import material as material_module
from facediff.evaluation.figures.lips import envelope
from facediff.metrics import mouth_opening_difference
from facediff.utils.pickles import load_pickle
from tests.fakes.tiny import RATE, VERTICES

CLIPS = ["A_e06", "A_e07", "B_e06"]
Array = NDArray[np.float64]
Read = Callable[[str, str], Array]
NAMES = ["truth", "ours", "theirs"]


@pytest.fixture(params=[2**20, 100], ids=["whole clips", "single frames"])
def chunk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(material_module, "CHUNK", request.param)


@pytest.mark.usefixtures("chunk")
def test_motion_maps_are_distances_from_the_identitys_template(
    own_material: FigureData, read: Read, tiny_root: Path
) -> None:
    templates = load_pickle(tiny_root / "templates.pkl")
    maps, notes = motion_maps(own_material, own_material.choose())
    assert own_material.choose() == CLIPS
    assert list(maps) == NAMES
    assert notes == []
    for name, found in maps.items():
        far = np.concatenate(
            [np.sqrt(((read(name, clip) - np.float32(templates[clip[0]])) ** 2).sum(2)) for clip in CLIPS]
        )
        np.testing.assert_allclose(found.mean, far.mean(0), rtol=1e-9)
        np.testing.assert_allclose(found.deviation, far.std(0), rtol=1e-9)
        np.testing.assert_allclose(found.maximum, far.max(0), rtol=1e-12)
        assert found.frames == len(far)


@pytest.mark.usefixtures("chunk")
def test_error_maps_are_distances_from_the_truth(own_material: FigureData, read: Read) -> None:
    maps, _ = error_maps(own_material, ["A_e07", "B_e06"])
    assert list(maps) == NAMES[1:]
    for name, found in maps.items():
        far = np.concatenate(
            [np.sqrt(((read(name, clip) - read("truth", clip)) ** 2).sum(2)) for clip in ("A_e07", "B_e06")]
        )
        np.testing.assert_allclose(found.mean, far.mean(0), rtol=1e-9)
        np.testing.assert_allclose(found.maximum, far.max(0), rtol=1e-12)
        np.testing.assert_allclose(found.deviation, far.std(0), rtol=1e-9)


@pytest.mark.usefixtures("chunk")
def test_opening_curves_are_those_of_the_metrics(own_material: FigureData, read: Read, tiny_root: Path) -> None:
    pairs = read_pairs(None, tiny_root, VERTICES)
    curves, note = opening_curves(own_material, "A_e06", pairs)
    assert note is None
    for name, found in curves.openings.items():
        each = [
            np.linalg.norm(read(name, "A_e06")[:, a] - read(name, "A_e06")[:, b], axis=1) for a, b in [(0, 6), (1, 7)]
        ]
        np.testing.assert_allclose(found, np.mean(each, axis=0), rtol=1e-12)
    np.testing.assert_allclose(curves.times, (np.arange(len(curves.times)) + 0.5) / RATE)
    apart = mouth_opening_difference(torch.tensor(read("ours", "A_e06")), torch.tensor(read("truth", "A_e06")), pairs)
    assert np.abs(curves.openings["ours"] - curves.openings["truth"]).mean() == pytest.approx(apart.item())


def test_lengths_are_cut_to_the_shortest_with_a_note(damaged: Callable[..., FigureData], read: Read) -> None:
    whole = read("ours", "A_e06")
    material = damaged(whole[:5])
    maps, notes = error_maps(material, ["A_e06"])
    assert maps["ours"].frames == 5
    assert notes == [f"A_e06: lengths differ (truth {len(whole)}, ours 5 frames): cut to the first 5"]
    assert motion_maps(material, ["A_e06"])[0]["truth"].frames == 5
    curves, note = opening_curves(material, "A_e06", read_pairs("0-6", None, VERTICES))
    assert len(curves.openings["truth"]) == 5
    assert note is not None


def test_a_stride_of_the_truth(own_material: FigureData, read: Read) -> None:
    opened = replace(own_material, truth_stride=2).open("A_e06")
    np.testing.assert_array_equal(opened["truth"].numpy(), read("truth", "A_e06")[::2].astype("f4"))


def test_a_time_picks_the_frame_on_the_screen(own_material: FigureData, read: Read) -> None:
    # At 25 frames a second frame 3 is shown from 0.12 s to 0.16 s.
    assert [frame_at(time, 25) for time in (0.0, 0.0399, 0.04, 0.12, 0.1599, 0.16)] == [0, 0, 1, 3, 3, 4]
    picked = pick_frames(own_material, "A_e06", [Moment(0.13), Moment(0.0)])
    assert list(picked) == NAMES
    for name, faces in picked.items():
        np.testing.assert_array_equal(faces[0], read(name, "A_e06")[3])
        np.testing.assert_array_equal(faces[1], read(name, "A_e06")[0])


TABLE = (
    "start,end,ipa,viseme\n0,0.10,,SIL\n0.10,0.20,m,PP\n0.20,0.30,ˈɑː,AA\n0.30,0.36,f,FF\n"
    "0.36,0.42,ɑ,AA\n0.42,0.5,m,PP\n0.5,0.6,ˌaʊ,AA+UH\n"
)


def test_a_phoneme_is_found_at_its_middle(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text(TABLE, encoding="utf-8")
    phonemes = read_phonemes(tmp_path / "p.csv")
    wanted = {
        "m": 0.15,
        "m:2": 0.46,
        "f": 0.33,
        "ɑː": 0.25,
        "ɑ": 0.39,
        "ˈɑː": 0.25,
        "aʊ": 0.55,
        "FF": 0.33,
        "AA:3": 0.55,
    }
    for name, middle in wanted.items():
        assert find_phoneme(name, phonemes, "A_e06").middle == pytest.approx(middle), name
    with pytest.raises(FaceDiffError, match=r"m 2 times"):
        find_phoneme("m:3", phonemes, "A_e06")
    with pytest.raises(FaceDiffError, match=r'"z": not spoken in clip A_e06: known are m, ɑː, f, ɑ, aʊ'):
        find_phoneme("z", phonemes, "A_e06")
    assert Moment(0.15, phonemes[1]).heading.large == "/m/"
    assert Moment(0.15, replace(phonemes[1], word="map")).heading.large == "/m/ map"


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "start,end,ipa\n", "start,end,ipa\n0,x,m\n", "start,end,ipa\n2,1,m\n"])
def test_damaged_phonemes(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(FaceDiffError, match=r"p\.csv: .*expected"):
        read_phonemes(tmp_path / "p.csv")


def test_unusable_files_are_named(damaged: Callable[..., FigureData], read: Read) -> None:
    whole = read("ours", "A_e06")
    with pytest.raises(FaceDiffError, match=r"ours: .*A_e06.*holds no numbers"):
        damaged(whole[:0]).open("A_e06")
    with pytest.raises(FaceDiffError, match=r"ours: .*all methods of a figure have the truth's mesh of 24 vertices"):
        damaged(whole[:, :20]).open("A_e06")
    whole[2, 3, 1] = np.nan
    material = damaged(whole)
    for compute in (error_maps, motion_maps):
        with pytest.raises(FaceDiffError, match=r"A_e06_condition_A\.npy: frame 2 holds NaN"):
            compute(material, ["A_e06"])
    with pytest.raises(FaceDiffError, match="frame 2 holds NaN"):
        pick_frames(material, "A_e06", [Moment(0.09)])
    assert pick_frames(material, "A_e06", [Moment(0.13)])  # other frames can be shown


@pytest.mark.parametrize("time", [9.0, -0.1, float("nan"), float("inf")])
def test_times_outside_a_motion(own_material: FigureData, time: float) -> None:
    with pytest.raises(FaceDiffError, match=r"has no frame at .* s; truth lasts from 0 to 0\.96 s \(24 frames at 25 a"):
        pick_frames(own_material, "A_e06", [Moment(time)])


def test_a_method_that_ends_early_is_named(damaged: Callable[..., FigureData], read: Read) -> None:
    with pytest.raises(FaceDiffError, match=r"ours lasts from 0 to 0\.2 s"):
        pick_frames(damaged(read("ours", "A_e06")[:5]), "A_e06", [Moment(0.3)])


def test_choosing_clips(own_material: FigureData, tiny_root: Path, methods: dict[str, Path], tmp_path: Path) -> None:
    assert own_material.choose(["B_e06", "B_e06"]) == ["B_e06"]
    with pytest.raises(FaceDiffError, match=r'no clip "A_e66".*did you mean "A_e06"'):
        own_material.choose(["A_e66"])
    with pytest.raises(FaceDiffError, match=r'ours has no prediction of clip "C_e06"'):
        own_material.choose(["C_e06"])
    for other in ({"truth": methods["ours"]}, {"none": tmp_path}, {"gone": tmp_path / "gone"}):
        with pytest.raises(FaceDiffError):
            find_clips(other, tiny_root / "vertices_npy")
    with pytest.raises(FaceDiffError, match="--identity all"):
        find_clips(methods, tiny_root / "vertices_npy", identity="all")
    parted = {name: {clip: Path()} for name, clip in zip(("ours", "theirs"), CLIPS, strict=False)}
    with pytest.raises(FaceDiffError, match="truth and ours and theirs have no clip in common"):
        replace(own_material, methods=parted).choose()


def test_unknown_facts_name_the_option_that_gives_them(own_material: FigureData) -> None:
    with pytest.raises(FaceDiffError, match="--mesh"):
        replace(own_material, faces=None).mesh(["A_e06"])
    with pytest.raises(FaceDiffError, match="--frame-rate"):
        pick_frames(replace(own_material, frame_rate=None), "A_e06", [Moment(0.1)])
    with pytest.raises(FaceDiffError, match="--templates"):
        motion_maps(replace(own_material, templates={}), ["A_e06"])
    np.testing.assert_array_equal(replace(own_material, templates={}).mesh(["A_e06"])[1], own_material.rest)
    assert own_material.scale == (1000.0, "mm")
    assert replace(own_material, unit="normalised (a long story)").scale == (1.0, "normalised")


@pytest.mark.parametrize("source", ["0-0", "0-99", "0-1-2", "gone.txt", "-"])
def test_lip_pairs_are_refused(source: str, tiny_root: Path) -> None:
    with pytest.raises(FaceDiffError, match="--lip-pairs"):
        read_pairs(source, tiny_root, VERTICES)
    with pytest.raises(FaceDiffError, match="--lip-pairs"):
        read_pairs(None, tiny_root / "wav", VERTICES)


def test_the_envelope_holds_every_sample() -> None:
    samples = np.random.default_rng(0).normal(size=1003).astype("f4")
    low, high = envelope(samples, 10)
    assert (len(low), low.min(), high.max()) == (10, samples.min(), samples.max())
    parts = np.split(samples, np.linspace(0, 1003, 11).astype(int)[1:-1])
    np.testing.assert_array_equal(low, [part.min() for part in parts])
    np.testing.assert_array_equal(high, [part.max() for part in parts])
    assert len(envelope(samples[:3], 10)[0]) == 3


CSV = "epoch,lr,step,train/loss,val/lve\n,0.1,0,,\n0,,0,4.0,\n0,,9,2.0,\n0,,9,,0.5\n1,,19,nan,\n1,,19,,0.25\n"


def test_curves_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text(CSV)
    curves = read_curves(find_metrics(tmp_path))
    assert set(curves) == {"lr", "train/loss", "val/lve"}
    np.testing.assert_array_equal(curves["train/loss"].at, [0, 9, 19])
    np.testing.assert_array_equal(curves["train/loss"].values, [4, 2, np.nan])
    np.testing.assert_array_equal(curves["val/lve"].values, [0.5, 0.25])
    by_epoch = read_curves(tmp_path / "metrics.csv", "epoch")
    np.testing.assert_array_equal(by_epoch["val/lve"].at, [0, 1])
    np.testing.assert_array_equal(by_epoch["train/loss"].values, [2, np.nan])  # the epoch's last
    runs = {"one": curves, "two": curves}
    assert choose_scalars(runs, None) == ["train/loss", "val/lve"]
    with pytest.raises(FaceDiffError, match=r'one: logged no scalar "val/lvee": did you mean "val/lve"'):
        choose_scalars(runs, ["val/lvee"])
    with pytest.raises(FaceDiffError, match="choose with --scalar from lr"):
        choose_scalars({"one": {"lr": curves["lr"]}}, None)


def test_runs_without_metrics(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match=r"metrics\.csv: no such file; expected a run folder"):
        find_metrics(tmp_path)
    (tmp_path / "version_3").mkdir()
    (tmp_path / "version_3" / "metrics.csv").write_text("epoch,step,a\n0,0,x\n")
    with pytest.raises(FaceDiffError, match=r"runs below are .*version_3"):
        find_metrics(tmp_path)
    with pytest.raises(FaceDiffError, match="table of numbers"):
        read_curves(find_metrics(tmp_path / "version_3"))
    (tmp_path / "version_3" / "metrics.csv").write_text("epoch,step\n0,0\n")
    with pytest.raises(FaceDiffError, match="holds no scalar"):
        read_curves(find_metrics(tmp_path / "version_3"))


def test_smoothing_is_the_weighted_mean_of_the_past() -> None:
    values = np.array([3.0, 1.0, 4.0, 1.0, 5.0])
    for place, found in enumerate(smooth(values, 0.7)):
        weights = 0.7 ** np.arange(place, -1, -1)
        assert found == pytest.approx((weights * values[: place + 1]).sum() / weights.sum())
    np.testing.assert_array_equal(smooth(values, 0.0), values)
    np.testing.assert_allclose(smooth(np.array([2.0, np.nan, 2.0]), 0.9), [2, np.nan, 2])
