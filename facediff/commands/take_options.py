"""The options by which a command gets a take: a motion file, and what the file does not say."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.data import Assets
    from facediff.takes import Take
    from facediff.takes.reading import Surroundings


def add_take_options(parser: argparse.ArgumentParser) -> None:
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


def take_of(path: Path, args: argparse.Namespace) -> Take:
    """The take in a file, completed by the options; every frame has been looked at.

    Raises:
        FaceDiffError: if a file is unreadable, something needed is not said, or the parts do not fit one another.
    """
    from facediff.takes import read_take

    take = read_take(path, *surroundings(args))
    take.refuse_not_finite()
    return take


def surroundings(args: argparse.Namespace) -> tuple[Surroundings, Surroundings | None]:
    """What the options say, which goes before a file; and what a checkpoint lends where nothing else says it."""
    import numpy as np

    from facediff.takes.reading import Surroundings
    from facediff.topology import read_mesh

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


def told_apart(takes: Sequence[Take], paths: Sequence[Path]) -> list[Take]:
    """The takes under their own names; where those are alike, as of one recording, under their files' names."""
    alike = len({take.name for take in takes}) < len(takes)
    return [replace(take, name=path.stem if alike else take.name) for take, path in zip(takes, paths, strict=True)]


def assets_of(checkpoint: Path) -> Assets:
    """The assets in a checkpoint, without building its system."""
    from facediff.systems.checkpoint import read_assets

    return read_assets(checkpoint)


def facts_of(assets: Assets, identity: str | None) -> dict[str, Any]:
    """Assets as :class:`facediff.takes.Take` and :class:`facediff.takes.reading.Surroundings` take them."""
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
