"""``facediff data import-person``: a reconstructed video of one person becomes a corpus entry."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff data import-person",
        description="Turn the 3D reconstruction of one person's video into a corpus entry that any data module takes "
        "beside its own people (--data.people) and that `facediff animate --style` takes a style from.",
    )
    made.add_argument(
        "motion",
        type=Path,
        metavar="MOTION",
        help="folder of .obj or .ply files, one a frame; .npy of (frames, vertices, 3) or (frames, 3 vertices); or "
        "FLAME parameters: shape_pose_cam.hdf5, or .npy of (1, frames, 403)",
    )
    made.add_argument("--audio", type=Path, required=True, metavar="FILE", help="the video, or its sound")
    made.add_argument("--name", required=True, help="the person's name: letters, digits, dashes")
    made.add_argument(
        "--corpus", type=Path, required=True, metavar="ROOT", help="corpus of other people with the same topology"
    )
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder to make")
    made.add_argument("--frame-rate", type=float, required=True, metavar="N", help="frames a second of MOTION")
    made.add_argument(
        "--corpus-frame-rate",
        type=float,
        metavar="N",
        help="frames a second of the corpus; needed if ROOT has no manifest.json that tells",
    )
    made.add_argument(
        "--template",
        type=Path,
        metavar="FILE",
        help="neutral face (.obj, .ply, .npy) in MOTION's unit; without it, found where the person is silent and still",
    )
    made.add_argument(
        "--stable",
        metavar="FILE",
        help="text file with the indices of vertices that move with the skull only, or FLAME_masks.pkl:scalp+forehead; "
        "without it, the vertices that are found to move least",
    )
    made.add_argument("--flame", type=Path, metavar="MODEL", help="your FLAME model file, for FLAME parameters")
    made.add_argument(
        "--scale",
        type=float,
        metavar="FACTOR",
        help="corpus units to a unit of MOTION, e.g. 0.001; measured by default",
    )
    made.add_argument(
        "--clip-seconds", type=float, default=8.0, metavar="S", help="length of a clip, about (default: 8)"
    )
    made.add_argument("--quiet", action="store_true", help="no progress bar")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Import a person and print what was done; warnings go to standard error."""
    args = parser().parse_args(list(arguments))

    from facediff.data.corpus import read_manifest
    from facediff.person import import_person

    report = import_person(
        args.motion,
        audio=args.audio,
        name=args.name,
        corpus=args.corpus,
        output=args.output,
        frame_rate=args.frame_rate,
        corpus_frame_rate=args.corpus_frame_rate,
        template=args.template,
        stable=args.stable,
        flame=args.flame,
        scale=args.scale,
        clip_seconds=args.clip_seconds,
        progress=not args.quiet and sys.stderr.isatty(),
    )
    unit = read_manifest(args.output).get("unit")
    print(f"{args.output}: {report.name}")
    print("\n".join(report.lines(unit)))
    return 0
