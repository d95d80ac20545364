"""``facediff evaluate``: the scores of anybody's files, with what each number means and how certain it is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from facediff.cli.options import (
    File,
    FileOrList,
    Folder,
    FrameRate,
    Scheduler,
    Seed,
    Workers,
    check_folders,
    named_folders,
)
from facediff.cli.parsing import refuse_idle
from facediff.cli.process import confirm_cost, tell
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.jobs import check_scheduler
from facediff.utils.option import Option

LEVEL = 0.95
DRAW_SECONDS = 4e-8  # What a resample takes for each clip


def evaluate(
    predictions: Annotated[str, Option(metavar="PREDICTIONS", reads=True)],
    truth: Annotated[Path, Option(metavar="TRUTH", reads=True)],
    *,
    method: Annotated[list[str] | None, Option(metavar="NAME=FOLDER", reads=True)] = None,
    protocol: Annotated[list[str] | None, Option(metavar="NAME")] = None,
    metric: Annotated[list[str] | None, Option(metavar="NAME[:OPTION=VALUE,…]")] = None,
    templates: File = None,
    regions: Folder = None,
    lips: FileOrList = None,
    upper_face: FileOrList = None,
    lip_pairs: FileOrList = None,
    eyelid_pairs: FileOrList = None,
    by: Annotated[Sequence[str] | None, Option(metavar="NAME,…")] = None,
    frame_rate: FrameRate = None,
    topology: Annotated[str | None, Option(metavar="NAME")] = None,
    n_vertices: Annotated[ranges.Vertices | None, Option(metavar="V")] = None,
    layout: Annotated[str | None, Option(metavar="NAME")] = None,
    truth_layout: Annotated[str | None, Option(metavar="NAME")] = None,
    rig: Annotated[Path | None, Option(metavar="FILE", reads=True)] = None,
    unit: Annotated[str | None, Option(metavar="UNIT")] = None,
    file_unit: Annotated[str | None, Option(metavar="UNIT")] = None,
    render: Annotated[list[str] | None, Option(metavar="NAME:OPTION=VALUE,…")] = None,
    mesh: Annotated[Path | None, Option(metavar="FILE", reads=True)] = None,
    pattern: Annotated[list[str] | None, Option(metavar="PATTERN")] = None,
    truth_pattern: Annotated[str | None, Option(metavar="PATTERN")] = None,
    identity: Annotated[str, Option(metavar="NAME")] = "own",
    truth_stride: Annotated[ranges.Stride, Option(metavar="N")] = 1,
    bootstrap: Annotated[ranges.Resamples, Option(metavar="N")] = 1000,
    level: Annotated[ranges.Level, Option(metavar="P")] = LEVEL,
    seed: Seed = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    json: Annotated[str | None, Option(metavar="FILE", writes="file", dash=True)] = None,
    csv: Annotated[Path | None, Option(metavar="FILE", writes="file")] = None,
    quiet: bool = False,
    yes: bool = False,
) -> None:
    """Score predictions against the truth by one or several protocols and metrics, with confidence intervals.

    PREDICTIONS and TRUTH are folders of .npy files of absolute vertices, (frames, V, 3) or (frames, 3V), of any
    floating-point type. TRUTH may also be a corpus folder: then its vertices_npy, templates.pkl and regions are used.
    Or both hold parameters: .csv of Live Link Face or Audio2Face, .json of BEAT, or .npy and .npz in a --layout.
    Exit status: 0 scored, 2 something to put right.

    Args:
        predictions: folder of predictions, or NAME=FOLDER
        truth: folder of truths, or a corpus folder
        method: a further method, compared with the first; repeatable
        protocol: definition of the scores, repeatable (default: paper)
        metric: a further metric with its options, such as temporal_misalignment:at=path; repeatable
        templates: templates.pkl, each speaker's neutral face
        regions: folder with lve.txt and fdd.txt, or with FLAME_masks.pkl
        lips: the lips: index file, FLAME_masks.pkl:lips, weights.txt>0.1, or all
        upper_face: the upper face, from the same kinds of source
        lip_pairs: pairs of inner-lip vertices: a file, or 3531-3504,… (default: the corpus's)
        eyelid_pairs: pairs of eyelid vertices, for blinks, as --lip-pairs
        by: group scores by attributes of clips too: columns of the corpus's clips.csv, such as emotion,intensity
        frame_rate: frames per second of the predictions (default: as the corpus's manifest.json says)
        topology: biwi, vocaset, mead3d or multiface: unusual regions are pointed out
        n_vertices: vertices of the mesh (default: as the templates have)
        layout: layout of arrays of parameters, such as flame_artalk or arkit
        truth_layout: the same of the truth's (default: as --layout)
        rig: what decodes parameters to vertices, the head at rest: a .glb, a folder of shapes, or FLAME's model file
        unit: unit of lengths of the scores: m, cm or mm (default: the protocol's, or the files')
        render: score renders too, by networks of your own, such as onnx:graph=net.onnx; repeatable
        mesh: mesh file whose triangles are rendered (default: the rig's)
        file_unit: unit of the files' vertices (default: as the rig or the corpus's manifest.json says)
        pattern: how predictions are named, repeatable (default: see the manual)
        truth_pattern: how truths are named (default: {subject}_{sentence})
        identity: which conditions are scored: own, all, or an identity's name
        truth_stride: use every N-th frame of the truth (VOCASET: 2)
        bootstrap: resamples for intervals; 0: none
        level: of the intervals
        seed: of the resamples
        workers: clips scored at a time (default: as many as processors)
        scheduler: where tasks run: processes, threads, tcp://HOST:PORT of a Dask cluster, or slurm (docs/cluster.md)
        json: write everything as JSON; - prints it instead of the table
        csv: write one row for each sequence and method
        quiet: no progress bar
        yes: start without a question, however long it takes
    """
    if not bootstrap:
        refuse_idle("is for intervals, of which --bootstrap 0 makes none", level=level != LEVEL, seed=seed != 0)
    if not metric:
        idle = {
            "lip_pairs": lip_pairs is not None,
            "eyelid_pairs": eyelid_pairs is not None,
            "frame_rate": frame_rate is not None and not render,
        }
        refuse_idle("is for further metrics, chosen with --metric", **idle)
    if not render:
        refuse_idle("is for --render", mesh=mesh is not None)
    if layout is None:
        refuse_idle("goes with --layout, that of the predictions", truth_layout=truth_layout is not None)
    methods = named_folders([predictions, *(method or [])])
    check_folders(methods)
    if not truth.is_dir():
        raise FaceDiffError(f"{truth}: no such folder; expected truths, or a corpus folder")
    check_scheduler(scheduler)
    from facediff.utils.files import atomic
    from facediff.utils.plain_files import json_text, write_rows

    json_file = Path(json) if json and json != "-" else None
    from facediff.data.corpus import read_templates
    from facediff.evaluation import DEFAULT_PATTERNS, TRUTH_PATTERN, read_region, text
    from facediff.evaluation import evaluate as score
    from facediff.evaluation.evaluator import find_protocols, needs_upper_face
    from facediff.evaluation.files import count_vertices, find_truths, read_pairs
    from facediff.evaluation.parameters import ParameterFiles, holds_parameters
    from facediff.mesh.files import read_mesh
    from facediff.metrics import EyelidPairs

    protocols, metrics = find_protocols(protocol or ["paper"], topology), metric or []
    files = None
    corpus: Path | None = truth
    if layout is not None or holds_parameters(truth):
        files = ParameterFiles.begin(truth, (layout, truth_layout or layout), rig, truth_stride)
    else:
        refuse_idle("is for motion in parameters, which TRUTH has not", rig=rig is not None)
        truth, corpus = find_truths(truth)
    if corpus is not None:
        if templates is None and (corpus / "templates.pkl").is_file():
            templates = corpus / "templates.pkl"
        if regions is None and (corpus / "regions").is_dir():
            regions = corpus / "regions"
    n_vertices = n_vertices or (count_vertices(topology, templates, truth) if files is None else files.n_points)
    own = files.regions(lips=lips or regions, upper_face=upper_face or regions) if files is not None else {}
    upper = None
    if needs_upper_face(protocols, metrics):
        upper = own.get("upper_face") or read_region("upper_face", n_vertices, folder=regions, source=upper_face)
    clips = sum(1 for path in truth.iterdir() if path.suffix in (".npy", ".npz", ".csv", ".json"))
    seconds = DRAW_SECONDS * bootstrap * clips * (2 * len(methods) - 1) * len(protocols)
    confirm_cost(yes, "--bootstrap", seconds=seconds)
    report = score(
        methods,
        truth,
        lips=own.get("lips") or read_region("lips", n_vertices, folder=regions, source=lips),
        upper_face=upper,
        templates=None if templates is None else read_templates(templates, n_vertices),
        n_vertices=n_vertices,
        protocols=protocols,
        metrics=metrics,
        lip_pairs=None if lip_pairs is None else read_pairs(lip_pairs, corpus, n_vertices),
        eyelid_pairs=None if eyelid_pairs is None else read_pairs(eyelid_pairs, corpus, n_vertices, EyelidPairs),
        corpus=corpus,
        by=by or (),
        frame_rate=frame_rate,
        files=files,
        unit=unit,
        file_unit=file_unit,
        renders=render or (),
        faces=read_mesh(mesh).faces if mesh is not None else None if files is None else files.faces,
        patterns=pattern or DEFAULT_PATTERNS,
        truth_pattern=truth_pattern or TRUTH_PATTERN,
        identity=identity,
        truth_stride=truth_stride,
        bootstrap=bootstrap,
        level=level,
        seed=seed,
        workers=workers,
        scheduler=scheduler,
        progress=not quiet,
    )
    everything = json_text(f"--json {json}", report.as_dict(), indent=2, ensure_ascii=True)
    if json_file is not None:
        with atomic(json_file) as temporary:
            temporary.write_text(everything + "\n", encoding="utf-8")
    if csv is not None:
        # Each row also says over which regions its numbers were taken.
        facts = {
            f"{part}_{key}": region[key]
            for part, region in report.regions().items()
            for key in ("name", "count", "hash")
        }
        write_rows(csv, [row | facts for row in report.rows()])
    if json == "-":
        tell(*everything.split("\n"))
        return
    tell(*text(report).split("\n"))
