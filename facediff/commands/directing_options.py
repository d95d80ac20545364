"""The options by which a command changes a finished take: expressiveness, and procedural blinks, gaze and sway."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.data import Assets
    from facediff.directing import Eyes
    from facediff.takes import Take

NEEDS = "needs to know where lids and eyeballs are, which is known for the built-in puppet only"


def add_directing_options(parser: argparse.ArgumentParser) -> None:
    """Add the options; all of them are off by default."""
    group = parser.add_argument_group(
        "directing (blinks, gaze and sway are procedural: made by rules, not learnt, and named so in the metadata)"
    )
    group.add_argument(
        "--expressiveness",
        metavar="FACTORS",
        help="scale the motion: 1.2, or by region, upper_face=1.5,lips=0.9,all=1.1 (all: what no other name covers)",
    )
    # Numbers are read later: a word that was taken for one by mistake then gets a sentence of its own.
    group.add_argument("--blinks", nargs="?", const="17", metavar="RATE", help="blinks a minute (17 if no number)")
    group.add_argument(
        "--gaze", nargs="?", const="4", metavar="DEGREES", help="eyes that wander by so much at most (4 if no number)"
    )
    group.add_argument(
        "--sway", nargs="?", const="2", metavar="DEGREES", help="a head that sways by so much at most (2 if no number)"
    )
    group.add_argument(
        "--eyes",
        type=Path,
        metavar="FILE",
        help="where lids and eyeballs are (.json or .npz, see docs/directing.md); the built-in puppet needs none",
    )
    group.add_argument(
        "--directing-seed", type=int, metavar="N", help="seed of blinks, gaze and sway (default: --seed, or 0)"
    )


def check_directing(args: argparse.Namespace, assets: Assets | None = None) -> None:
    """Refuse what cannot work before anything is sampled.

    Args:
        args: with the options of :func:`add_directing_options`.
        assets: of the checkpoint whose faces will be directed; without them only the words are looked at.

    Raises:
        FaceDiffError: naming the option.
    """
    from facediff.directing import blink_curve, gaze_curve, read_factors, sway_curve
    from facediff.directing.expressiveness import check_factors

    factors = read_factors(args.expressiveness) if args.expressiveness is not None else {}
    # Each refuses what it cannot do, also for a take without frames.
    if (value := number("--blinks", args.blinks)) is not None:
        blink_curve(0, 25.0, rate=value)
    if (value := number("--gaze", args.gaze)) is not None:
        gaze_curve(0, 25.0, degrees=value)
    if (value := number("--sway", args.sway)) is not None:
        sway_curve(0, 25.0, degrees=value)
    seed_of(args)
    if args.eyes is not None and not args.eyes.is_file():
        raise FaceDiffError(f"--eyes {args.eyes}: no such file; expected .json or .npz (see docs/directing.md)")
    if assets is None:
        return
    check_factors(factors, assets.regions, f"the checkpoint's corpus {assets.corpus}")
    import numpy as np

    template = assets.template(getattr(args, "identity", None) or assets.identities[0]).numpy()
    faces = None if assets.faces is None else np.asarray(assets.faces)
    needed_eyes(template, faces, args)


def directed(take: Take, args: argparse.Namespace, *, seed: int | None = None) -> Take:
    """The take as the options want it; the very same take if they want nothing.

    Expressiveness comes first, then gaze, blinks, and last the head, which takes everything along.

    Args:
        take: a finished take.
        args: with the options of :func:`add_directing_options`.
        seed: goes before the options' seed, for takes that shall differ.

    Raises:
        FaceDiffError: naming the option, or if the take's head sways already.
    """
    from facediff.directing import add_blinks, add_gaze, add_sway, read_factors, scale_regions
    from facediff.directing.layers import PROCEDURAL, SWAYS

    blinks, gaze, sway = (number(f"--{name}", getattr(args, name)) for name in ("blinks", "gaze", "sway"))
    if args.expressiveness is None and blinks is None and gaze is None and sway is None:
        return take
    if SWAYS in take.metadata.get(PROCEDURAL, ""):
        raise FaceDiffError(f"{take.name}: its head sways already; direct the take as it was before")
    seed = seed_of(args) if seed is None else seed
    eyes = needed_eyes(take.template, take.faces, args)
    if args.expressiveness is not None:
        take = scale_regions(take, read_factors(args.expressiveness), eyes)
    if gaze is not None and eyes is not None:
        take = add_gaze(take, eyes, degrees=gaze, seed=seed)
    if blinks is not None and eyes is not None:
        take = add_blinks(take, eyes, rate=blinks, seed=seed)
    if sway is not None:
        take = add_sway(take, degrees=sway, seed=seed)
    return take


def needed_eyes(
    template: npt.NDArray[np.floating], faces: npt.NDArray[np.integer] | None, args: argparse.Namespace
) -> Eyes | None:
    """The face's eyes, if anything asks for them and they are known; expressiveness only does better with them.

    Raises:
        FaceDiffError: if blinks or gaze are asked for and nothing says where the eyes are.
    """
    from facediff.commands.eyes_files import eyes_for

    asking = next((f"--{name}" for name in ("blinks", "gaze") if getattr(args, name) is not None), None)
    if asking is None and args.expressiveness is None:
        return None
    eyes = eyes_for(template, faces, args.eyes)
    if asking is None:
        return eyes
    if eyes is None:
        from facediff.directing.eyes import GIVE

        raise FaceDiffError(f"{asking}: {NEEDS}; {GIVE}")
    if args.blinks is not None:
        eyes.lids()
    if args.gaze is not None and not eyes.eyeballs:
        raise FaceDiffError(f"--gaze: {eyes.source} does not say which vertices are the eyeballs; add them")
    return eyes


def number(option: str, word: str | None) -> float | None:
    """What stands behind an option that may stand alone."""
    if word is None:
        return None
    try:
        return float(word)
    except ValueError as error:
        raise FaceDiffError(
            f"{option} {word}: expected a number; where {option} shall stand alone, put it at the end"
        ) from error


def seed_of(args: argparse.Namespace) -> int:
    """The seed of what is procedural: its own, else the command's.

    Raises:
        FaceDiffError: if it is negative.
    """
    given = args.directing_seed
    seed = int(getattr(args, "seed", None) or 0) if given is None else given
    if seed < 0:
        raise FaceDiffError(f"--{'seed' if given is None else 'directing-seed'} {seed}: expected 0 or more")
    return int(seed)
