"""``--target-mesh``: a take on another mesh, for every command that has one."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.animation import Animation
    from facediff.animation.files import Surroundings
    from facediff.data import Assets
    from facediff.editing.correspondence import Correspondence
    from facediff.editing.eyes import Eyes


# The options by which a command gets a take: a motion file, and what the file does not say.


def add_animation_options(parser: argparse.ArgumentParser) -> None:
    """Add what completes a motion file; the file's own argument is the command's."""
    group = parser.add_argument_group("what a bare .npy does not say (an .npz of `facediff animate` says it all)")
    group.add_argument("--mesh", type=Path, metavar="FILE", help="neutral face with triangles: .ply, .obj, .glb …")
    group.add_argument("--checkpoint", type=Path, metavar="C", help="what is still missing, from a checkpoint")
    group.add_argument(
        "--identity", metavar="NAME", help="whose face in the checkpoint; the first trained on if absent"
    )
    group.add_argument("--speech", type=Path, metavar="WAV", help="the recording that the motion belongs to")
    group.add_argument("--frame-rate", type=float, metavar="F", help="frames a second")
    group.add_argument("--unit", metavar="U", help="unit of length: m, cm, mm, in, or a number of metres")


def animation_of(path: Path, args: argparse.Namespace) -> Animation:
    """The take in a file, completed by the options; every frame has been looked at.

    Raises:
        FaceDiffError: if a file is unreadable, something needed is not said, or the parts do not fit one another.
    """
    from facediff.animation import read_animation

    animation = read_animation(path, *surroundings(args))
    animation.refuse_not_finite()
    return animation


def surroundings(args: argparse.Namespace) -> tuple[Surroundings, Surroundings | None]:
    """What the options say, which goes before a file; and what a checkpoint lends where nothing else says it."""
    import numpy as np

    from facediff.animation.files import Surroundings
    from facediff.mesh import read_mesh

    given: dict[str, Any] = {}
    lent = None
    if args.checkpoint is not None:
        lent = Surroundings(**facts_of(assets_of(args.checkpoint), args.identity))
        if args.identity is not None:
            given["template"] = lent.template
    elif args.identity is not None:
        raise FaceDiffError("--identity: names a face of a checkpoint; give --checkpoint as well")
    if args.mesh is not None:
        mesh = read_mesh(args.mesh)
        given |= {"template": mesh.vertices.astype(np.float32), "faces": mesh.faces}
        given |= {} if mesh.colours is None else {"colours": mesh.colours}
    if args.speech is not None:
        from facediff.data.audio import SAMPLE_RATE, read_speech

        given |= {"speech": read_speech(args.speech), "sample_rate": SAMPLE_RATE}
    if args.frame_rate is not None:
        given["frame_rate"] = args.frame_rate
    if args.unit is not None:
        given["unit"] = args.unit
    return Surroundings(**given), lent


def told_apart(takes: Sequence[Animation], paths: Sequence[Path]) -> list[Animation]:
    """The takes under their own names; where those are alike, as of one recording, under their files' names."""
    alike = len({animation.name for animation in takes}) < len(takes)
    return [
        replace(animation, name=path.stem if alike else animation.name)
        for animation, path in zip(takes, paths, strict=True)
    ]


def assets_of(checkpoint: Path) -> Assets:
    """The assets in a checkpoint, without building its model."""
    from facediff.models.checkpoint import read_assets

    return read_assets(checkpoint)


def facts_of(assets: Assets, identity: str | None) -> dict[str, Any]:
    """Assets as :class:`facediff.animation.Animation` and :class:`facediff.animation.files.Surroundings` take them."""
    import numpy as np

    def array(value: object, kind: type) -> object:
        return None if value is None else np.asarray(value, kind)

    return {
        "template": array(assets.template(identity or assets.identities[0]), np.float32),
        "faces": array(assets.faces, np.int32),
        "frame_rate": assets.frame_rate,
        "unit": assets.unit,
        "colours": array(assets.colours, np.uint8),
        "regions": {name: np.asarray(indices, np.int64) for name, indices in assets.regions.items()},
        "inner_lip_pairs": array(assets.inner_lip_pairs, np.int64),
    }


# The options by which a command changes a finished take: expressiveness, and procedural blinks, gaze and sway.

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
    from facediff.editing.expressiveness import check_factors, read_factors
    from facediff.editing.procedural import blink_curve, gaze_curve, sway_curve

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


def directed(animation: Animation, args: argparse.Namespace, *, seed: int | None = None) -> Animation:
    """The take as the options want it; the very same take if they want nothing.

    Expressiveness comes first, then gaze, blinks, and last the head, which takes everything along.

    Args:
        animation: a finished take.
        args: with the options of :func:`add_directing_options`.
        seed: goes before the options' seed, for takes that shall differ.

    Raises:
        FaceDiffError: naming the option, or if the take's head sways already.
    """
    from facediff.editing.expressiveness import read_factors, scale_regions
    from facediff.editing.procedural import PROCEDURAL, SWAYS, add_blinks, add_gaze, add_sway

    blinks, gaze, sway = (number(f"--{name}", getattr(args, name)) for name in ("blinks", "gaze", "sway"))
    if args.expressiveness is None and blinks is None and gaze is None and sway is None:
        return animation
    if SWAYS in animation.metadata.get(PROCEDURAL, ""):
        raise FaceDiffError(f"{animation.name}: its head sways already; direct the animation as it was before")
    seed = seed_of(args) if seed is None else seed
    eyes = needed_eyes(animation.template, animation.faces, args)
    if args.expressiveness is not None:
        animation = scale_regions(animation, read_factors(args.expressiveness), eyes)
    if gaze is not None and eyes is not None:
        animation = add_gaze(animation, eyes, degrees=gaze, seed=seed)
    if blinks is not None and eyes is not None:
        animation = add_blinks(animation, eyes, rate=blinks, seed=seed)
    if sway is not None:
        animation = add_sway(animation, degrees=sway, seed=seed)
    return animation


def needed_eyes(
    template: npt.NDArray[np.floating], faces: npt.NDArray[np.integer] | None, args: argparse.Namespace
) -> Eyes | None:
    """The face's eyes, if anything asks for them and they are known; expressiveness only does better with them.

    Raises:
        FaceDiffError: if blinks or gaze are asked for and nothing says where the eyes are.
    """
    from facediff.editing.eyes import eyes_for

    asking = next((f"--{name}" for name in ("blinks", "gaze") if getattr(args, name) is not None), None)
    if asking is None and args.expressiveness is None:
        return None
    eyes = eyes_for(template, faces, args.eyes)
    if asking is None:
        return eyes
    if eyes is None:
        from facediff.editing.eyes import GIVE

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


def carried(animation: Animation, mesh_path: Path, correspondence_path: Path | None = None) -> Animation:
    """A take on the mesh in a file.

    Args:
        animation: the performance, with triangles.
        mesh_path: the other face at rest.
        correspondence_path: used if it is there, else written; None for neither.

    Raises:
        FaceDiffError: if a file is unreadable, or a mesh is not the correspondence's or has its vertices in another
            order.
    """
    return carried_with(animation, mesh_path, correspondence_path)[0]


def carried_with(
    animation: Animation, mesh_path: Path, correspondence_path: Path | None = None, landmarks_path: Path | None = None
) -> tuple[Animation, Correspondence]:
    """A take on the mesh in a file, and the correspondence; arguments and errors as :func:`carried`.

    Args:
        animation: the performance.
        mesh_path: the other face at rest.
        correspondence_path: used if it is there, else written.
        landmarks_path: CSV of vertex pairs, for a correspondence that is not there yet.
    """
    from facediff.editing.correspondence import correspond, refuse_other_mesh
    from facediff.editing.retargeting import carry, load_correspondence, read_landmarks, save_correspondence
    from facediff.mesh import read_mesh
    from facediff.utils.files import check_writable

    triangles = animation.triangles  # what it lacks is not the other mesh's fault
    mesh = read_mesh(mesh_path)
    if correspondence_path is not None and correspondence_path.exists():
        if landmarks_path is not None:
            raise FaceDiffError(
                f"--landmarks {landmarks_path}: {correspondence_path} is there already and would be used without them; "
                f"remove it, or leave the landmarks away"
            )
        found = load_correspondence(correspondence_path)
        refuse_other_mesh(str(mesh_path), mesh.vertices, mesh.faces, found.target_vertices, found.target_faces)
        return carry(animation, found, mesh), found
    if correspondence_path is not None:
        if correspondence_path.suffix != ".npz":
            raise FaceDiffError(f"--correspondence {correspondence_path}: expected a name that ends in .npz")
        check_writable(correspondence_path)
    landmarks = None if landmarks_path is None else read_landmarks(landmarks_path)
    try:
        found = correspond(animation.template, triangles, mesh.vertices, mesh.faces, landmarks=landmarks)
    except FaceDiffError as error:
        raise FaceDiffError(f"{mesh_path}: {error}") from error
    made = carry(animation, found, mesh)
    if correspondence_path is not None:
        save_correspondence(correspondence_path, found)
    return made, found
