"""``facediff evaluate``: the scores of anyone's files, with what each number means and how sure it is."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError
from facediff.utils.files import atomic, check_writable, write_rows

if TYPE_CHECKING:
    from facediff.evaluation import Report


PROGRAM = "facediff evaluate"
EPILOG = """\
PREDICTIONS and TRUTH are folders of .npy files of absolute vertices, (frames, V, 3) or (frames, 3V), of any
floating-point type. TRUTH may also be a corpus folder: then its vertices_npy, templates.pkl and regions are used.
Exit status: 0 scored, 2 something to put right."""


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        PROGRAM,
        description="Score predictions against the truth by one or several protocols, with confidence intervals.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument("predictions", metavar="PREDICTIONS", help="folder of predictions, or NAME=FOLDER")
    made.add_argument("truth", metavar="TRUTH", type=Path, help="folder of truths, or a corpus folder")
    add = made.add_argument
    add(
        "--method", metavar="NAME=FOLDER", action="append", default=[], help="a further method, compared with the first"
    )
    add("--protocol", metavar="NAME", action="append", help="definition of the scores, repeatable (default: paper)")
    add("--templates", type=Path, metavar="FILE", help="templates.pkl, each subject's neutral face")
    add("--regions", type=Path, metavar="FOLDER", help="folder with lve.txt and fdd.txt, or with FLAME_masks.pkl")
    add("--lips", metavar="FILE", help="the lips: index file, FLAME_masks.pkl:lips, weights.txt>0.1, or all")
    add("--upper-face", metavar="FILE", help="the upper face, likewise")
    add("--topology", metavar="NAME", help="biwi, vocaset, mead3d or multiface: unusual regions are pointed out")
    add("--n-vertices", type=int, metavar="V", help="vertices of the mesh (default: as the templates have)")
    add("--pattern", metavar="PATTERN", action="append", help="how predictions are named (default: see the manual)")
    add("--truth-pattern", metavar="PATTERN", help="how truths are named (default: {subject}_{sentence})")
    add("--identity", default="own", help="which conditions are scored: own (default), all, or an identity's name")
    add("--truth-stride", type=int, default=1, metavar="N", help="take every N-th frame of the truth (VOCASET: 2)")
    add("--bootstrap", type=int, default=1000, metavar="N", help="resamples for intervals (default 1000; 0: none)")
    add("--level", type=float, default=0.95, help="of the intervals (default 0.95)")
    add("--seed", type=int, default=0, help="of the resamples (default 0)")
    add("--workers", type=int, metavar="N", help="clips scored at a time (default: as many as processors)")
    add("--json", metavar="FILE", help="write everything as JSON; - prints it instead of the table")
    add("--csv", type=Path, metavar="FILE", help="write one row for each sequence and method")
    add("--quiet", action="store_true", help="no progress bar")
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Score, print and write.

    Returns:
        0.

    Raises:
        FaceDiffError: for everything that the user can put right.
    """
    args = parser().parse_args(list(arguments))
    methods = _methods([args.predictions, *args.method])
    json_file = Path(args.json) if args.json and args.json != "-" else None
    for path in (json_file, args.csv):
        if path is not None:
            check_writable(path)
    report = _evaluate(args, methods)
    if json_file is not None:
        with atomic(json_file) as temporary:
            temporary.write_text(_json(report) + "\n", encoding="utf-8")
    if args.csv is not None:
        _write_csv(args.csv, report)
    if args.json == "-":
        print(_json(report))
        return 0
    from facediff.evaluation import text

    # A file name may hold letters that the terminal's encoding has not.
    encoding = sys.stdout.encoding or "utf-8"
    print(text(report).encode(encoding, errors="backslashreplace").decode(encoding))
    return 0


def _methods(words: Sequence[str]) -> dict[str, Path]:
    """Folders by name; a folder without a name is called as it is itself."""
    methods: dict[str, Path] = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not equals or Path(word).is_dir():
            name, folder = Path(word).resolve().name, word
        if not name or not folder:
            raise FaceDiffError(f"{word}: expected NAME=FOLDER")
        if name in methods:
            raise FaceDiffError(f'{word}: there is already a method called "{name}"; name it with NAME=FOLDER')
        methods[name] = Path(folder)
    return methods


def _evaluate(args: argparse.Namespace, methods: dict[str, Path]) -> Report:
    """Find what lies beside the files, and score."""
    from facediff.data.corpus import read_templates
    from facediff.evaluation import DEFAULT_PATTERNS, TRUTH_PATTERN, evaluate, read_region
    from facediff.evaluation.evaluator import find_protocols
    from facediff.evaluation.files import count_vertices, find_truths

    for option in ("n_vertices", "workers"):
        if getattr(args, option) is not None and getattr(args, option) < 1:
            raise FaceDiffError(f"--{option.replace('_', '-')} {getattr(args, option)}: expected a number from 1")
    protocols = find_protocols(args.protocol or ["paper"], args.topology)
    truth, corpus = find_truths(args.truth)
    templates_file, regions = args.templates, args.regions
    if corpus is not None:
        if templates_file is None and (corpus / "templates.pkl").is_file():
            templates_file = corpus / "templates.pkl"
        if regions is None and (corpus / "regions").is_dir():
            regions = corpus / "regions"
    n_vertices = args.n_vertices or count_vertices(args.topology, templates_file, truth)
    upper_face = None
    if any(protocol.fdd for protocol in protocols):
        upper_face = read_region("upper_face", n_vertices, folder=regions, source=args.upper_face)
    return evaluate(
        methods,
        truth,
        lips=read_region("lips", n_vertices, folder=regions, source=args.lips),
        upper_face=upper_face,
        templates=None if templates_file is None else read_templates(templates_file, n_vertices),
        n_vertices=n_vertices,
        protocols=protocols,
        patterns=args.pattern or DEFAULT_PATTERNS,
        truth_pattern=args.truth_pattern or TRUTH_PATTERN,
        identity=args.identity,
        truth_stride=args.truth_stride,
        bootstrap=args.bootstrap,
        level=args.level,
        seed=args.seed,
        workers=args.workers,
        progress=not args.quiet,
    )


def _json(report: Report) -> str:
    return json.dumps(report.as_dict(), indent=2, allow_nan=False)


def _write_csv(path: Path, report: Report) -> None:
    """One row for each sequence and method, with the regions that the numbers were taken over."""
    regions = {
        f"{part}_{key}": region[key] for part, region in report.regions().items() for key in ("name", "count", "hash")
    }
    write_rows(path, [row | regions for row in report.rows()])
