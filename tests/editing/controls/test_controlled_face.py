"""Animation controls from the command line to the changed animation."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.animation.options import AnimationControls
from facediff.editing.controls.controlled_face import apply_controls
from facediff.editing.controls.direction import MOODS, Direction, Key, read_direction
from facediff.editing.controls.eyelids import Eyes
from facediff.errors import FaceDiffError
from facediff.synthetic.known_faces import built_in_rig
from tests.fakes.single_controls import add_blinks, add_gaze, add_sway, parsed, scale_regions


def test_editing_is_imported_only_where_it_is_asked_for() -> None:
    program = (
        "import sys, facediff.pipelines.folder, facediff.export\n"
        "from facediff.editing.controls import AnimationControls\n"
        "assert AnimationControls().is_off\n"
        "print(*(name for name in sys.modules if name.startswith('facediff.editing.')))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert run.stdout.split() == ["facediff.editing.controls"]


def test_all_options_in_their_order(make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    animation = make_animation(200, jawOpen=0.4, eyeBlink=0.1)
    controls = parsed("--expressiveness", "upper_face=1.5", "--blinks", "20", "--gaze", "--sway", "3")
    made = apply_controls(animation, controls, seed=7)
    by_hand = scale_regions(animation, {"upper_face": 1.5}, eyes)
    by_hand = add_blinks(add_gaze(by_hand, eyes, degrees=4, seed=7), eyes, rate=20, seed=7)
    by_hand = add_sway(by_hand, degrees=3, seed=7)
    np.testing.assert_allclose(made.vertices, by_hand.vertices, atol=1e-6)
    assert (
        made.metadata
        == by_hand.metadata
        == {
            "identity": "F1",
            "edited": "expressiveness (upper_face 1.5)",
            "procedural": "gaze (4 degrees, seed 7); blinks (20 a minute, seed 7); head sway (3 degrees, seed 7)",
        }
    )
    own = apply_controls(animation, parsed("--blinks", "--controls-seed", "3"), seed=7)
    assert own.metadata["procedural"] == "blinks (17 a minute, seed 3)"
    assert apply_controls(animation, parsed("--sway"), seed=9).metadata["procedural"] == "head sway (2 degrees, seed 9)"
    with pytest.raises(FaceDiffError, match="F1: its head moves already"):
        apply_controls(made, parsed("--blinks"))


def test_what_keys_stand_for_is_refused_beside_them(make_animation: Callable[..., Animation], tmp_path: Path) -> None:
    both = Direction([Key(0, "lids", 0.5)], instead_of=("acting", "blinks")).save(tmp_path / "both.json")
    blinks = Direction([Key(0, "lids", 0.5)], instead_of=("blinks",)).save(tmp_path / "blinks.json")
    for path, option, *value in ((both, "acting", "prosody"), (both, "blinks"), (blinks, "blinks")):
        with pytest.raises(FaceDiffError, match=f"{path.name}: instead_of: .*--{option}"):
            parsed("--direction", str(path), f"--{option}", *value)
    parsed("--direction", str(blinks), "--acting", "prosody", "--sway")
    # The animation goes on saying so, with the keys of both if it is changed twice.
    made = apply_controls(make_animation(2), parsed("--direction", str(blinks)))
    later = Direction([Key(0, "brows", 1.0)], instead_of=("acting",))
    again = apply_controls(made, AnimationControls(direction=later))
    assert Direction.parse(again.metadata["direction"], "again").instead_of == ("blinks", "acting")
    # Nor is it done again in an animation that it is part of already.
    blinking = apply_controls(make_animation(2), parsed("--blinks"))
    with pytest.raises(FaceDiffError, match="blinks.json: .*instead_of.*as it was before"):
        apply_controls(blinking, parsed("--direction", str(blinks)))
    apply_controls(blinking, AnimationControls(direction=later))
    others = Direction([Key(1, "lids", 0.2)], "others", instead_of=("blinks",))
    with pytest.raises(FaceDiffError, match="others: .*instead_of.*as it was before"):
        apply_controls(again, AnimationControls(direction=others))


def test_keys_are_not_applied_twice(make_animation: Callable[..., Animation]) -> None:
    keys = Direction([Key(0, "shape.jawOpen", 0.5), Key(1, "brows", 1.0)], "keys")
    moved = apply_controls(make_animation(2), AnimationControls(direction=keys))
    with pytest.raises(FaceDiffError, match="keys: F1 has these keys already"):
        apply_controls(moved, AnimationControls(direction=Direction(keys.keys[:1], "keys")))


def test_shape_keys_add_their_displacements(make_animation: Callable[..., Animation]) -> None:
    animation = make_animation(3, frame_rate=2.0)
    keys = [Key(0, "shape.jawOpen", 0.0, "linear"), Key(1, "shape.jawOpen", 1.0), Key(0, "shape.mouthSmileLeft", -0.5)]
    moved = apply_controls(animation, AnimationControls(direction=Direction(keys))).vertices
    rig = built_in_rig("F1")
    jaw, smile = (rig.deltas[rig.names.index(name)] for name in ("jawOpen", "mouthSmileLeft"))
    np.testing.assert_allclose(moved - animation.vertices, [t * jaw - 0.5 * smile for t in (0, 0.5, 1)], atol=1e-7)
    with pytest.raises(FaceDiffError, match="shape"):
        apply_controls(replace(animation, faces=None), AnimationControls(direction=Direction(keys)))


@pytest.mark.parametrize("mood", MOODS)
def test_moods_are_keys_that_finished_motion_takes(mood: str, make_animation: Callable[..., Animation]) -> None:
    animation = make_animation(2)
    moved = apply_controls(animation, AnimationControls(direction=mood))
    assert read_direction(mood).rows() == Direction.parse(moved.metadata["direction"], mood).rows()
    assert np.isfinite(moved.vertices).all()
