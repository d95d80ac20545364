"""Carry a speaking face to a family of other heads, without landmarks, and print what the check measures of each.

    python tools/own_mesh_table.py [--edition 2] [--pictures FOLDER] [NAME ...]

The heads are made by ``tests/fakes/heads.py``. Seconds are of one processor. Pictures show the widest mouth, a full
blink and raised brows.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from facediff.editing.correspondence import correspond
from facediff.editing.retargeting import carry_checked
from facediff.export.pictures import draw_correspondence
from facediff.mesh import Mesh
from tests.fakes.heads import FAMILY, talking, talking_second


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--edition", type=int, choices=(1, 2), default=1, help="of the built-in face that speaks")
    options = parser.parse_args()
    animation = talking() if options.edition == 1 else talking_second()
    columns = ["mesh", "vertices", "lips at rest / widest", "opening kept", "eye left open", "lids pass by"]
    columns += ["left against right", "forehead stretches", "triangles that fold", "seconds", "result"]
    print("| " + " | ".join(columns) + " |", "|" + "---|" * len(columns), sep="\n")
    for name in options.names or FAMILY:
        head = FAMILY[name]()
        start = time.process_time()
        fit = correspond(animation.template, animation.triangles, head.vertices, head.faces)
        seconds = time.process_time() - start
        carried, fit, report = carry_checked(animation, fit, Mesh(head.vertices, head.faces.astype(np.int32)))
        eyes = report.eyes
        figures = [
            "–" if report.lip_ratio is None else f"{report.lip_ratio:.2f}",
            percent(report.opened),
            *(
                percent(None if eyes is None else value)
                for value in (
                    eyes and eyes.lid_gap,
                    eyes and eyes.overshoot,
                    eyes and eyes.uneven,
                    eyes and eyes.stretch,
                )
            ),
            f"{report.folded:.1%}",
            f"{seconds:.0f}",
            "refused" if not report.good else "good, lids at rest" if report.remarks else "good",
        ]
        print(f"| {name} | {len(head.vertices)} | " + " | ".join(figures) + " |", flush=True)
        if options.pictures is not None:
            options.pictures.mkdir(parents=True, exist_ok=True)
            draw_correspondence(options.pictures / f"{name.replace(' ', '_')}.png", animation, carried, fit)


def percent(value: float | None) -> str:
    """A share as a cell of the table."""
    return "–" if value is None else f"{value:.0%}"


if __name__ == "__main__":
    main()
