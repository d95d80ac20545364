"""Acting from the melody of speech: when it moves, how far, and that it is the same in pieces and by seed."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.editing.acting import Acting, acted, read_acting
from facediff.editing.controls.controlled_face import ACTED
from tests.speech.test_prosody import RATE, SECONDS, SILENCE, voice

FRAMES = 100
ACCENT = 2.0


@pytest.fixture(scope="module")
def speech() -> np.ndarray:
    """Half a second of silence, three of a voice whose pitch rises at 2 s, and silence."""
    pitch = 120 * 2 ** (6 / 12 * np.exp(-(((SECONDS - ACCENT + 0.5) / 0.1) ** 2)))
    return np.concatenate([SILENCE, voice(pitch), SILENCE])


def moves(
    speech: np.ndarray, kind: Acting | None = None, *, rate: float = 25.0, seed: int = 0
) -> dict[str, np.ndarray]:
    frames = round(len(speech) / RATE * rate)
    return dict(zip(ACTED, acted(kind or read_acting("prosody"), speech, frames, rate, seed).T, strict=True))


def test_brows_rise_at_the_accent_and_rest_elsewhere(speech: np.ndarray) -> None:
    raised = [seed for seed in range(12) if moves(speech, seed=seed)["brows"].any()]
    assert 5 < len(raised) < 12, "three of four accents are acted"
    brows = moves(speech, seed=raised[0])["brows"]
    times = np.arange(FRAMES) / 25
    assert abs(times[brows.argmax()] - ACCENT) < 0.12
    assert 1.5 < brows.max() <= 4
    np.testing.assert_array_equal(brows[np.abs(times - ACCENT) > 0.7], 0)


def test_lids_shut_where_the_phrase_ends(speech: np.ndarray) -> None:
    lids = [moves(speech, seed=seed)["lids"] for seed in range(10)]
    blinking = [curve for curve in lids if curve.any()]
    assert 2 < len(blinking) < 10
    for curve in blinking:
        assert 3.4 < curve.argmax() / 25 < 3.8
        assert curve.max() > 0.9


def test_amplitudes_stay_within_their_bounds(speech: np.ndarray) -> None:
    loud = np.concatenate([speech * 8, speech, speech * 3])
    kind = read_acting("prosody:strength=2,brows=3,nods=4,drift=1")
    found = moves(loud, kind, seed=3)
    assert 0 <= found["brows"].min() <= found["brows"].max() <= 6
    assert max(np.abs(found[f"head.{name}"]).max() for name in ("pitch", "yaw", "roll")) <= 2 * (4 + 1)
    assert found["head.pitch"].max() > 4, "nods go down"
    off = moves(speech, read_acting("prosody:strength=0,blinks=0"))
    assert not any(values.any() for values in off.values())


def test_silence_is_rest_to_the_last_bit() -> None:
    assert not any(values.any() for values in moves(np.zeros(2 * RATE)).values())


@pytest.mark.parametrize("rate", [25.0, 60.0])
def test_nothing_pops(speech: np.ndarray, rate: float) -> None:
    """The quickest gesture is a quintic over 0.16 s: its third derivative is at most 60 / 0.16³ of its size."""
    found = moves(speech, rate=rate)
    for name, size in (("brows", 4), ("head.pitch", 3 + 1.5), ("head.yaw", 3), ("head.roll", 3)):
        jerk = np.abs(np.diff(found[name], 3)).max() * rate**3
        assert jerk < 2 * size * 60 / 0.16**3


def test_what_is_acted_does_not_depend_on_the_pieces_and_changes_with_the_seed(speech: np.ndarray) -> None:
    kind = read_acting("prosody")
    whole = acted(kind, speech, FRAMES, 25.0, 5)
    performer = kind.performer(25.0, 5)
    parts = [performer.feed(piece) for piece in np.array_split(speech, 41)]
    assert sum(map(len, parts)) > 50, "frames come before the speech has ended"
    np.testing.assert_array_equal(np.concatenate([*parts, performer.finish(FRAMES)]), whole)
    assert not np.array_equal(acted(kind, speech, FRAMES, 25.0, 6), whole)


def test_the_head_drifts_from_the_beginning_of_a_long_recording(speech: np.ndarray) -> None:
    long = np.concatenate([speech, np.zeros(3 * RATE)])
    assert acted(read_acting("prosody"), long, 2 * FRAMES, 25.0, 0)[:25, ACTED.index("head.yaw")].any()


def test_frames_do_not_depend_on_speech_long_after_them(speech: np.ndarray) -> None:
    kind, cut = read_acting("prosody"), 2 * RATE
    other = np.concatenate([speech[:cut], speech[: len(speech) - cut]])
    before = round((cut / RATE - 1.5) * 25)
    np.testing.assert_array_equal(
        acted(kind, speech, FRAMES, 25.0, 0)[:before], acted(kind, other, FRAMES, 25.0, 0)[:before]
    )
