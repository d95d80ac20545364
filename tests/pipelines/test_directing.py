"""Keys over time and acting, from options to frames: plain options to the last bit, formulas, streams and batches."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import facediff
from facediff.cli.app import main
from facediff.editing.controls.direction import CHANNELS, ENDED, METADATA, Direction, Key, read_direction, text_shares
from facediff.editing.controls.eyelids import puppet_eyes
from facediff.errors import FaceDiffError
from facediff.speech.audio import read_speech

QUICK = {"identity": "F1", "steps": 2, "voice_gate": "off"}


@pytest.fixture
def speech(puppet_corpus: Path) -> np.ndarray:
    return read_speech(puppet_corpus / "wav" / "F1_t01.wav")


def rows(channel: str, *values: float | str, kind: str = "smooth") -> list[dict[str, object]]:
    return [
        {"time": 0.8 * index, "channel": channel, "value": value, "interpolation": kind}
        for index, value in enumerate(values)
    ]


@pytest.mark.parametrize(
    ("channel", "value", "options"),
    [
        ("style", "M2_e05", {"style": "M2_e05"}),
        ("style", "F1_e03:0.3,M2_e05:0.7", {"style": "F1_e03:0.3,M2_e05:0.7"}),
        ("expressiveness", 1.3, {"expressiveness": 1.3}),
        ("expressiveness.upper_face", 1.7, {"expressiveness": "upper_face=1.7"}),
        ("blinks", 30.0, {"blinks": 30.0}),
        ("gaze", 5.0, {"gaze": 5.0}),
        ("sway", 3.0, {"sway": 3.0}),
    ],
)
def test_keys_that_never_change_are_the_plain_option(
    model: facediff.Animator, speech: np.ndarray, channel: str, value: float | str, options: dict[str, object]
) -> None:
    made = model.animate(speech, 16_000, direction=rows(channel, value, value, value), **QUICK)
    plain = model.animate(speech, 16_000, **QUICK, **options)
    np.testing.assert_array_equal(made.vertices, plain.vertices)
    if "procedural" in plain.metadata:
        assert made.metadata["procedural"] == plain.metadata["procedural"]


def test_style_crossfades_between_the_plain_styles(model: facediff.Animator, speech: np.ndarray) -> None:
    direction = Direction([Key(0.4, "style", "F1_e03"), Key(1.2, "style", "M2_e05", "step"), Key(2, "style", "F1_e03")])
    made = model.animate(speech, 16_000, direction=direction, **QUICK)
    plain = {name: model.animate(speech, 16_000, style=name, **QUICK).vertices for name in ("F1_e03", "M2_e05")}
    shares = text_shares(direction.keys, np.arange(len(made.vertices)) / 25, eased=True)
    expected = sum(shares[name][:, None, None] * plain[name] for name in plain)
    np.testing.assert_allclose(made.vertices, expected, atol=1e-6)
    alone = shares["F1_e03"] == 1
    assert 0 < alone.sum() < len(alone)
    np.testing.assert_array_equal(made.vertices[alone], plain["F1_e03"][alone])
    assert not np.array_equal(plain["F1_e03"], plain["M2_e05"])


def test_expressiveness_scales_each_frame_by_its_curve(model: facediff.Animator, speech: np.ndarray) -> None:
    keys = rows("expressiveness", 0.5, 2.0, 1.0)
    made = model.animate(speech, 16_000, direction=keys, **QUICK)
    plain = model.animate(speech, 16_000, **QUICK)
    factor = Direction.parse(keys, "keys").at(np.arange(len(plain.vertices)) / 25)["expressiveness"]
    still = np.abs(plain.vertices - plain.template).max(axis=(0, 2)) > 0
    lips = np.intersect1d(plain.regions["lips"], np.flatnonzero(still))
    expected = plain.template[lips] + factor[:, None, None] * (plain.vertices - plain.template)[:, lips]
    np.testing.assert_allclose(made.vertices[:, lips], expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["step", "smooth"])
def test_nothing_pops(model: facediff.Animator, kind: str) -> None:
    """The third difference of every vertex is bounded by that of the parts and of the curve between them."""
    speech = np.zeros(48_000, np.float32)
    keys = rows("head.yaw", 0, 10, 0, kind=kind) + rows("brows", 0, 4, 0, kind=kind)
    made = model.animate(speech, 16_000, direction=keys, **QUICK).vertices
    plain = model.animate(speech, 16_000, **QUICK).vertices
    jerk, own = (np.abs(np.diff(each, 3, axis=0)).max() for each in (made, plain))
    reach = 0.15 * np.deg2rad(10) + 0.004  # metres that a vertex is moved by at most
    seconds = 0.2 if kind == "step" else 0.8
    assert jerk < own + 12 * reach * (0.04 / seconds) ** 2 * 2


def test_head_keys_turn_the_head_by_their_angles(model: facediff.Animator, speech: np.ndarray) -> None:
    keys = [*rows("head.pitch", 0, 8), *rows("head.yaw", 0, -5)]
    made = model.animate(speech, 16_000, direction=keys, **QUICK)
    plain = model.animate(speech, 16_000, **QUICK)
    first, last = (each.vertices[-1].astype(float) - each.vertices[-1].mean(0) for each in (plain, made))
    u, _, v = np.linalg.svd(last.T @ first)
    turn = u @ v
    angle = np.degrees(np.arccos((np.trace(turn) - 1) / 2))
    assert angle == pytest.approx(np.hypot(8, 5), abs=1e-3)
    assert turn[1, 2] < 0, "what points forwards points down"
    assert turn[0, 2] < 0, "and to the face's right"
    with pytest.raises(FaceDiffError, match="head moves already"):
        made.control(blinks=True)


def test_brows_go_up_by_millimetres_and_down(model: facediff.Animator, speech: np.ndarray) -> None:
    plain = model.animate(speech, 16_000, **QUICK)
    for value in (4.0, -3.0):
        made = model.animate(speech, 16_000, direction=rows("brows", value), **QUICK)
        moved = made.vertices - plain.vertices
        size = np.linalg.norm(moved, axis=-1)
        assert size.max() == pytest.approx(abs(value) / 1000, abs=1e-6)
        highest = size[0].argmax()
        assert np.sign(moved[0, highest, 1]) == np.sign(value)
        np.testing.assert_array_equal(moved[:, made.regions["lips"]], 0)


def test_lids_shut_by_their_share(model: facediff.Animator) -> None:
    template = model.module.assets.template("F1").numpy()
    faces = np.asarray(model.module.assets.faces, np.int32)
    still = facediff.Animation("still", np.stack([template] * 3), template, 25.0, faces)
    eyes = puppet_eyes(template, faces)
    assert eyes is not None
    lids, closing = eyes.lids()
    for share in (1.0, 0.25):
        made = still.control(direction=rows("lids", share))
        np.testing.assert_allclose(made.vertices[:, lids] - template[lids], share * np.stack([closing] * 3), atol=1e-7)


FULL = [
    *rows("style", "F1_e03", "M2_e05"),
    *rows("expressiveness.upper_face", 1, 2, 1, kind="step"),
    *rows("head.pitch", 0, 5, 0),
    *rows("brows", 0, 2, 0),
    *rows("acting", 0, 1),
]


def test_stream_is_the_file_however_it_is_cut(model: facediff.Animator, speech: np.ndarray) -> None:
    model.module.windows = facediff.models.inference.WindowPlan(seconds=1.0, overlap=0.2, above=0.0)
    options = {**QUICK, "voice_gate": "energy", "direction": FULL, "acting": "prosody", "seed": 2}
    whole = model.animate(speech, 16_000, **options).vertices
    for pieces in (1, 37):
        parts = list(model.stream(np.array_split(speech, pieces), **options))
        np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert len(parts) > 1
    heads = []
    with model.backend.open(model._options(None, **options)) as pipeline:
        stream = pipeline.stream()
        for piece in np.array_split(speech, 5):
            stream.feed(piece)
            heads.append(stream.heads)
        stream.finish()
    turned = np.concatenate([part for part in [*heads, stream.heads] if part is not None])
    np.testing.assert_array_equal(turned, model.animate(speech, 16_000, **options).head)
    for channel in ("blinks", "expressivity"):
        with pytest.raises(FaceDiffError, match=channel):
            model.stream([], direction=rows(channel, 2))


def test_a_take_is_repeated_from_its_metadata(model: facediff.Animator, speech: np.ndarray, tmp_path: Path) -> None:
    options = {**QUICK, "acting": "prosody", "seed": 5}
    made = model.animate(speech, 16_000, direction=FULL, **options)
    (path,) = made.save(tmp_path / "take.npz")
    assert read_direction(path).keys == Direction.parse(FULL, "keys").keys
    assert "head acting" in made.metadata["procedural"]
    again = model.animate(speech, 16_000, direction=path, **options)
    np.testing.assert_array_equal(again.vertices, made.vertices)


def test_finished_animations_follow_what_needs_no_model(model: facediff.Animator, speech: np.ndarray) -> None:
    keys = [*rows("expressiveness", 1, 2), *rows("head.roll", 0, 3), *rows("acting", 1, 0)]
    within = model.animate(speech, 16_000, direction=keys, acting="prosody", **QUICK)
    after = model.animate(speech, 16_000, **QUICK).control(direction=keys, acting="prosody")
    np.testing.assert_array_equal(after.vertices, within.vertices)
    assert after.metadata[METADATA] == within.metadata[METADATA]


def test_acting_is_off_unless_it_is_asked_for_and_rests_in_silence(model: facediff.Animator) -> None:
    silence = np.zeros(48_000, np.float32)
    plain = model.animate(silence, 16_000, **QUICK)
    acted = model.animate(silence, 16_000, acting="prosody", **QUICK)
    np.testing.assert_array_equal(acted.vertices, plain.vertices)
    with pytest.raises(FaceDiffError, match="speech"):
        facediff.Animation("x", plain.vertices, plain.template, 25.0, plain.faces).control(acting="prosody")


def test_command_names_what_is_wrong_and_writes_nothing(workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("keys.json").write_text(json.dumps({"keys": rows("brows", "high")}))
    command = ["animate", "speech.wav", "--checkpoint", "demo/puppet.ckpt", "-o", "b.npz", "--direction"]
    for given, named in (("keys.json", "keys.json: row 1: value"), ("none.json", "--direction none.json")):
        assert main([*command, given]) == 2
        assert named in capsys.readouterr().err
    assert not Path("b.npz").exists()


def test_directions_add_up_in_the_metadata(model: facediff.Animator, speech: np.ndarray) -> None:
    first, second = rows("style", "F1_e03", "M2_e05"), rows("brows", 0, 2)
    made = model.animate(speech, 16_000, direction=first, **QUICK)
    both = made.control(direction=second)
    assert {*Direction.parse(both.metadata[METADATA], "m").channels} == {"style", "brows"}
    with pytest.raises(FaceDiffError, match="has these keys already"):  # the motion would add up, and they would not
        both.control(direction=second)


PAGE = (Path(__file__).parents[2] / "docs" / "animation_controls.md").read_text(encoding="utf-8")


def test_the_page_shows_one_direction_in_two_ways(tmp_path: Path) -> None:
    files = {suffix: tmp_path / f"keys.{suffix}" for suffix in ("json", "csv")}
    for suffix, path in files.items():
        blocks = re.findall(rf"```{suffix}\n(.*?)```", PAGE, re.DOTALL)
        (block,) = (block for block in blocks if "channel" in block)
        path.write_text(block)
    one, other = (read_direction(path) for path in files.values())
    assert one.keys == other.keys
    for name in CHANNELS.keys() - ENDED:
        assert f"`{name}" in PAGE


def test_the_blocks_of_the_page_run(model: facediff.Animator, workplace: Path) -> None:
    model.animate("speech.wav", steps=1).save("plain.npz")
    (block,) = (block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "Direction(" in block)
    names: dict[str, object] = {}
    exec(compile(block, "docs/animation_controls.md", "exec"), names)  # noqa: S102 - our own page
    assert names["direction"].at([0.0, 0.5, 1.2])["head.yaw"].tolist() == [0, 3, 6]  # type: ignore[attr-defined]
    assert Path("directed.npz").is_file()
