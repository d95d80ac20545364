"""``facediff evaluate``: scores of motion files by named protocols, with definitions and confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from facediff.cli.options import (
    File,
    FileOrList,
    Folder,
    Seed,
    Text,
    WorkOptions,
    named_folders,
)
from facediff.cli.process import confirm_cost, tell
from facediff.errors import refuse_idle
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.evaluation import EvaluationReport
    from facediff.evaluation.parameters import ParameterFiles

DRAW_SECONDS = 4e-8  # A resample for each clip


@dataclass(frozen=True)
class ScoreOptions:
    """Scores.

    Attributes:
        protocol: definition of the scores, repeatable (default: paper)
        metric: a further metric with its options, such as temporal_misalignment:at=path; repeatable
        regions: folder with lve.txt and fdd.txt, or with FLAME_masks.pkl
        lips: the lips: index file, FLAME_masks.pkl:lips, weights.txt>0.1, or all
        upper_face: the upper face, from the same kinds of source
        lip_pairs: pairs of inner-lip vertices: a file, or 3531-3504,… (default: the corpus's)
        eyelid_pairs: pairs of eyelid vertices, for blinks, as --lip-pairs
        by: group scores by attributes of clips too: columns of the corpus's clips.csv, such as emotion,intensity
        bootstrap: resamples for intervals; 0: none
        level: of the intervals
        seed: of the resamples
    """

    protocol: Annotated[list[str] | None, Option(metavar="NAME")] = None
    metric: Annotated[list[str] | None, Option(metavar="NAME[:OPTION=VALUE,…]")] = None
    regions: Folder = None
    lips: FileOrList = None
    upper_face: FileOrList = None
    lip_pairs: Annotated[str | None, Option(metavar="FILE", reads=True, needs="metric")] = None
    eyelid_pairs: Annotated[str | None, Option(metavar="FILE", reads=True, needs="metric")] = None
    by: Annotated[Sequence[str] | None, Option(metavar="NAME,…")] = None
    bootstrap: Annotated[ranges.Resamples, Option(metavar="N")] = 1000
    level: Annotated[ranges.Level, Option(metavar="P")] = 0.95
    seed: Seed = 0


@dataclass(frozen=True)
class MotionOptions:
    """Files of motion.

    Attributes:
        templates: templates.pkl, each speaker's neutral face
        frame_rate: frames per second of the predictions (default: as the corpus's manifest.json says)
        topology: biwi, vocaset, mead3d or multiface: unusual regions are pointed out
        n_vertices: vertices of the mesh (default: as the templates have)
        layout: layout of arrays of parameters, such as flame_artalk or arkit
        truth_layout: the same of the truth's (default: as --layout)
        rig: to decode parameters to vertices, the head at rest: a .glb, a folder of shapes, or FLAME's model file
        unit: unit of lengths of the scores: m, cm or mm (default: the protocol's, or the files')
        file_unit: unit of the files' vertices (default: as the rig or the corpus's manifest.json says)
        pattern: how predictions are named, repeatable (default: see the manual)
        truth_pattern: how truths are named (default: {subject}_{sentence})
        identity: which conditions are scored: own, all, or an identity's name
        truth_stride: use every N-th frame of the truth (VOCASET: 2)
    """

    templates: File = None
    frame_rate: Annotated[ranges.FrameRate | None, Option(metavar="F", needs="metric")] = None
    topology: Text = None
    n_vertices: Annotated[ranges.Vertices | None, Option(metavar="V")] = None
    layout: Text = None
    truth_layout: Annotated[str | None, Option(metavar="NAME", needs="layout")] = None
    rig: File = None
    unit: Annotated[str | None, Option(metavar="UNIT")] = None
    file_unit: Annotated[str | None, Option(metavar="UNIT")] = None
    pattern: Annotated[list[str] | None, Option(metavar="PATTERN")] = None
    truth_pattern: Annotated[str | None, Option(metavar="PATTERN")] = None
    identity: Annotated[str, Option(metavar="NAME")] = "own"
    truth_stride: Annotated[ranges.Stride, Option(metavar="N")] = 1


def evaluate(
    predictions: Annotated[str, Option(metavar="PREDICTIONS", reads=True)],
    truth: Annotated[Path, Option(metavar="TRUTH", reads=True, exists="folder")],
    *,
    method: Annotated[list[str] | None, Option(metavar="NAME=FOLDER", reads=True)] = None,
    json: Annotated[str | None, Option(metavar="FILE", writes="file", dash=True)] = None,
    csv: Annotated[Path | None, Option(metavar="FILE", writes="file")] = None,
    yes: bool = False,
    work: WorkOptions,
    scores: ScoreOptions,
    files: MotionOptions,
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
        json: write everything as JSON; - prints it instead of the table
        csv: write one row for each sequence and method
        yes: start without a question, however long it takes
        work: where the work is done
        scores: which scores are computed.
        files: how motion is stored.
    """
    methods = named_folders([predictions, *(method or [])])
    from facediff.evaluation import evaluate as score
    from facediff.evaluation.evaluator import find_protocols
    from facediff.evaluation.file_pairs import find_truths
    from facediff.evaluation.parameters import ParameterFiles, holds_parameters

    protocols = find_protocols(scores.protocol or ["paper"], files.topology)
    parameters: ParameterFiles | None = None
    corpus: Path | None = truth
    if files.layout is not None or holds_parameters(truth):
        layouts = (files.layout, files.truth_layout or files.layout)
        parameters = ParameterFiles.begin(truth, layouts, files.rig, files.truth_stride)
    else:
        refuse_idle("is for motion in parameters, which TRUTH has not", rig=files.rig is not None)
        truth, corpus = find_truths(truth)
    clips = sum(1 for path in truth.iterdir() if path.suffix in (".npy", ".npz", ".csv", ".json"))
    seconds = DRAW_SECONDS * scores.bootstrap * clips * (2 * len(methods) - 1) * len(protocols)
    confirm_cost(yes, "--bootstrap", seconds=seconds)
    options = {name: getattr(files, name) for name in ("frame_rate", "unit", "file_unit", "identity", "truth_stride")}
    options |= {name: getattr(scores, name) for name in ("bootstrap", "level", "seed")}
    options |= {"workers": work.workers, "scheduler": work.scheduler, "progress": not work.quiet}
    report = score(
        methods,
        truth,
        protocols=protocols,
        metrics=scores.metric or [],
        corpus=corpus,
        by=scores.by or (),
        files=parameters,
        **options,
        **faces_of(truth, corpus, parameters, scores, files),
    )
    write(report, json, csv)


def faces_of(
    truth: Path,
    corpus: Path | None,
    parameters: ParameterFiles | None,
    scores: ScoreOptions,
    files: MotionOptions,
) -> dict[str, Any]:
    """Regions, pairs and templates of the face; the corpus's where no option names them."""
    from facediff.data.corpus import read_templates
    from facediff.evaluation import DEFAULT_PATTERNS, TRUTH_PATTERN, read_region
    from facediff.evaluation.evaluator import find_protocols, needs_upper_face
    from facediff.evaluation.file_pairs import count_vertices, read_pairs
    from facediff.metrics import EyelidPairs

    templates, folder = files.templates, scores.regions
    if corpus is not None and templates is None and (corpus / "templates.pkl").is_file():
        templates = corpus / "templates.pkl"
    if corpus is not None and folder is None and (corpus / "regions").is_dir():
        folder = corpus / "regions"
    count = files.n_vertices
    count = count or (count_vertices(files.topology, templates, truth) if parameters is None else parameters.n_points)
    lips, upper = scores.lips, scores.upper_face
    regions = {} if parameters is None else parameters.regions(lips=lips or folder, upper_face=upper or folder)
    upper_face = None
    if needs_upper_face(find_protocols(scores.protocol or ["paper"], files.topology), scores.metric or []):
        upper_face = regions.get("upper_face") or read_region("upper_face", count, folder=folder, source=upper)
    lids = scores.eyelid_pairs
    return {
        "lips": regions.get("lips") or read_region("lips", count, folder=folder, source=lips),
        "upper_face": upper_face,
        "templates": None if templates is None else read_templates(templates, count),
        "n_vertices": count,
        "lip_pairs": None if scores.lip_pairs is None else read_pairs(scores.lip_pairs, corpus, count),
        "eyelid_pairs": None if lids is None else read_pairs(lids, corpus, count, EyelidPairs),
        "patterns": files.pattern or DEFAULT_PATTERNS,
        "truth_pattern": files.truth_pattern or TRUTH_PATTERN,
    }


def write(report: EvaluationReport, json: str | None, csv: Path | None) -> None:
    """Print the table or the JSON, and write the files."""
    from facediff.evaluation import text
    from facediff.utils.plain_files import json_text, write_json, write_rows

    if json not in (None, "-"):
        write_json(Path(str(json)), report.as_dict())
    if csv is not None:
        # Each row also says over which regions its numbers were taken.
        facts = {
            f"{part}_{key}": region[key]
            for part, region in report.regions().items()
            for key in ("name", "count", "hash")
        }
        write_rows(csv, [row | facts for row in report.rows()])
    printed = json_text("--json -", report.as_dict(), ensure_ascii=True) if json == "-" else text(report)
    tell(*printed.split("\n"))
