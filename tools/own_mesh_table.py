"""Carry a speaking face to a family of other heads, without landmarks, and print what the check measures of each.

    python tools/own_mesh_table.py [--pictures FOLDER] [NAME ...]

The heads are made by ``tests/fakes/heads.py``. Seconds are of one processor.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from facediff.editing.correspondence import correspond
from facediff.editing.fit_check import check_fit
from facediff.editing.retargeting import carry
from facediff.export.pictures import draw_correspondence
from facediff.mesh import Mesh
from tests.fakes.heads import FAMILY, talking


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    animation = talking()
    print("| mesh | vertices | lips at rest / widest | opening kept | triangles that fold | seconds | result |")
    print("|---|---|---|---|---|---|---|")
    for name in options.names or FAMILY:
        head = FAMILY[name]()
        start = time.process_time()
        found = correspond(animation.template, animation.triangles, head.vertices, head.faces)
        seconds = time.process_time() - start
        made = carry(animation, found, Mesh(head.vertices, head.faces.astype(np.int32)))
        report = check_fit(animation, made, found)
        lips = "–" if report.lip_ratio is None else f"{report.lip_ratio:.2f}"
        kept = "–" if report.opened is None else f"{report.opened:.0%}"
        print(
            f"| {name} | {len(head.vertices)} | {lips} | {kept} | {report.folded:.1%} | {seconds:.0f} | "
            f"{'good' if report.good else 'refused'} |",
            flush=True,
        )
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            draw_correspondence(options.pictures / f"{name.replace(' ', '_')}.png", animation, made, found)


if __name__ == "__main__":
    main()
