"""``facediff style extract``: how a person moves, as one vector."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from facediff.errors import FaceDiffError


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser("facediff style", description="Style vectors of people's motion.")
    made.add_argument(
        "action", choices=["extract"], help="write the style vector of clips, their mean if there are several"
    )
    made.add_argument(
        "clips",
        nargs="+",
        metavar="CLIP",
        help="motion of one person: .npy files of absolute vertices, or names of the corpus's clips (F1_e03)",
    )
    made.add_argument("--checkpoint", type=Path, required=True, metavar="C", help="trained model (.ckpt)")
    made.add_argument(
        "--identity",
        metavar="NAME",
        help="whose motion it is, where the files' names do not tell; the first trained on",
    )
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="vector to write (.npy)")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Extract a style vector."""
    args = parser().parse_args(list(arguments))
    import numpy as np
    import torch

    from facediff.models import Style, load_model
    from facediff.models.styles import read_style
    from facediff.utils.files import atomic, check_writable

    if args.output.suffix != ".npy":
        raise FaceDiffError(f"--output {args.output}: expected a name that ends in .npy")
    check_writable(args.output)
    model = load_model(args.checkpoint)
    identity = args.identity or model.identities[0]
    vectors = []
    for clip in args.clips:
        style = read_style(clip, identity, model)
        if isinstance(style, Style):
            raise FaceDiffError(f"{clip}: is a style vector already; give a motion (frames, vertices, 3)")
        motion = style.motion.float()[None]
        with torch.inference_mode():
            vectors.append(model.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool))[0])
    vector = torch.stack(vectors).mean(0)
    if not len(vector):
        raise FaceDiffError(f"{args.checkpoint}: was trained without a dynamic style, so it has no style vectors")
    with atomic(args.output) as temporary, temporary.open("wb") as stream:
        np.save(stream, vector.numpy(), allow_pickle=False)
    print(
        f"{args.output}: style vector of {len(vector)} numbers from {', '.join(args.clips)}, for this checkpoint only"
    )
    print(f"next: facediff animate speech.wav --checkpoint {args.checkpoint} --style {args.output} -o speech.mp4")
    return 0
