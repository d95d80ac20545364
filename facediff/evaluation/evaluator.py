"""Score several methods' files against the truth, one clip at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from facediff.data.conversations import CONVERSATION, channel_regions, conversation_file
from facediff.data.corpus import ALL, EYELID_PAIRS, LIP_PAIRS, read_manifest
from facediff.errors import FaceDiffError
from facediff.evaluation.file_pairs import (
    DEFAULT_PATTERNS,
    OWN,
    TRUTH_PATTERN,
    NamePattern,
    Pair,
    Truth,
    errors_of,
    index_truths,
    list_names,
    pair_up,
    read_pairs,
)
from facediff.evaluation.groups import attributes_of
from facediff.evaluation.parameters import ParameterFiles, refuse_vertex_protocols
from facediff.evaluation.report import EvaluationReport, MethodTable
from facediff.evaluation.scoring import METRICS, Scorer, score_all
from facediff.metrics import Context, EyelidPairs, LipPairs, Protocol, Region, protocol
from facediff.metrics.by_name import parse_all
from facediff.reporting.statistics import Bootstrap
from facediff.spaces.files.reading import SUFFIXES
from facediff.spaces.space import metres_per_unit
from facediff.speech.audio import SAMPLE_RATE, read_speech
from facediff.speech.phonemes import closures, phonemes_file, read_phonemes
from facediff.utils import ranges
from facediff.utils.paths import find_file, from_home, name_of_file


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """How files are scored.

    Attributes:
        lips: lip vertices.
        upper_face: upper-face vertices; needed if a protocol has FDD.
        templates: neutral face (V, 3) by identity; needed if a protocol has FDD.
        n_vertices: vertices V of the mesh.
        protocols: names of protocols, or your own protocols.
        metrics: further metrics, each the name of a registered one, which may be followed by options:
            ``temporal_misalignment:at=path,smoothing=1.5``. Their further inputs come from ``corpus``.
        lip_pairs: pairs of inner-lip vertices; the corpus's if None.
        eyelid_pairs: pairs of eyelid vertices, by which blinks are seen; the corpus's if None.
        corpus: corpus folder of the truth, whose ``wav``, ``phonemes``, ``regions/inner_lip_pairs.txt`` and
            ``manifest.json`` are used where a metric needs them.
        by: attributes of clips, columns of the corpus's ``clips.csv``, by which scores are grouped too.
        frame_rate: frames per second of the predictions; from the corpus's ``manifest.json`` if None.
        topology: name of the mesh (``biwi``, ``vocaset`` …), for a remark on unusual regions.
        files: how files of parameters are read; None for files of vertices.
        unit: unit of lengths of the scores of vertices; each protocol's, or the vertices', if None.
        file_unit: unit of the vertices; as the rig or the corpus's ``manifest.json`` says if None.
        patterns: how predictions may be named; see :class:`facediff.evaluation.file_pairs.NamePattern`.
        truth_pattern: how truths are named.
        identity: which predictions of a clip are scored where several were conditioned on different identities:
            ``own`` takes the one conditioned on the clip's own speaker (or whose name has no condition), ``all`` the
            mean over conditions, as DiffSpeaker does; anything else is the identity's name.
        truth_stride: 2 takes every second frame of the truth, for VOCASET's truth at 60 frames a second.
        bootstrap: resamples of the sequences for confidence intervals; 0 for none.
        level: share of the resamples inside an interval.
        seed: of the resamples.
        workers: clips that are scored at a time; as many as processors if None. Digits do not depend on it.
        scheduler: where clips are scored; see :func:`facediff.utils.jobs.run_tasks`. Nor on this.
        progress: whether to show a progress bar on standard error, if it is a terminal.
    """

    lips: Region
    upper_face: Region | None = None
    templates: Mapping[str, Tensor] | None = None
    n_vertices: ranges.Vertices
    protocols: Sequence[str | Protocol] = ("paper",)
    metrics: Sequence[str] = ()
    lip_pairs: LipPairs | None = None
    eyelid_pairs: LipPairs | None = None
    corpus: Path | None = None
    by: Sequence[str] = ()
    frame_rate: ranges.FrameRate | None = None
    topology: str | None = None
    files: ParameterFiles | None = None
    unit: str | None = None
    file_unit: str | None = None
    patterns: Sequence[str] = DEFAULT_PATTERNS
    truth_pattern: str = TRUTH_PATTERN
    identity: str = OWN
    truth_stride: ranges.Stride = 1
    bootstrap: ranges.Resamples = 1000
    level: ranges.Level = 0.95
    seed: ranges.Seed = 0
    workers: ranges.Workers | None = None
    scheduler: str | None = ""
    progress: bool = False

    def __post_init__(self) -> None:
        ranges.check_options(self)

    def completed(self, needed: Set[str], *, rate: bool, methods: Mapping[str, str | Path]) -> EvaluationOptions:
        """The options with the corpus's frame rate, if one is needed, and its pairs for metrics."""
        changes: dict[str, Any] = {}
        if self.files is not None:
            files = replace(self.files, predictions=tuple(map(Path, methods.values())))
            changes = {"files": files, "frame_rate": files.frame_rate}
        elif self.frame_rate is None and rate and self.corpus is not None:
            stored = read_manifest(self.corpus).get("frame_rate")
            if isinstance(stored, int | float) and stored > 0:
                changes["frame_rate"] = stored / self.truth_stride
        for field, need, file, kind in (
            ("lip_pairs", "lip_pairs", LIP_PAIRS, LipPairs),
            ("eyelid_pairs", "lid_pairs", EYELID_PAIRS, EyelidPairs),
        ):
            if getattr(self, field) is None and need in needed and self.corpus and (self.corpus / file).is_file():
                changes[field] = read_pairs(None, self.corpus, self.n_vertices, kind)
        return replace(self, **changes)


def evaluate(methods: Mapping[str, str | Path], truth: str | Path, **options: Any) -> EvaluationReport:  # noqa: ANN401
    """Score the files of one or several methods against the truth.

    Files hold absolute vertices, (T, V, 3) or (T, 3V), of any floating-point type. They are memory-mapped, and of each
    clip only its scores are kept. The scores equal :class:`facediff.metrics.ProtocolMetrics` over all clips.

    Args:
        methods: folder of predictions by method; the others are compared with the first.
        truth: folder of truths.
        options: the fields of :class:`EvaluationOptions`, of which ``lips`` and ``n_vertices`` are needed.
    """
    scoring, truth = EvaluationOptions(**options), from_home(truth)
    methods = {name: from_home(folder) for name, folder in methods.items()}
    protocols = find_protocols(scoring.protocols, scoring.topology)
    sampling = Bootstrap(scoring.bootstrap, scoring.level, scoring.seed)
    source = source_unit(protocols, scoring)
    scales = {protocol.name: scale_of(source, scoring.unit or protocol.unit) for protocol in protocols}
    requests = {request.text: request.scaled(scale_of(source, scoring.unit)) for request in parse_all(scoring.metrics)}
    of_protocols = [
        (protocol.name, label, request)
        for protocol in protocols
        for label, request in protocol.further(scales[protocol.name]).items()
    ]
    requests |= {f"{owner}/{label}": request for owner, label, request in of_protocols}
    needed = {need for request in requests.values() for need in request.needs}
    scoring = scoring.completed(needed, rate=bool(requests), methods=methods)
    suffixes = (".npy",) if scoring.files is None else SUFFIXES
    names, unnamed_truths = list_names(
        Path(truth), [NamePattern(scoring.truth_pattern, scoring.templates or ())], suffixes
    )
    truths = index_truths(names)
    if scoring.files is not None and scoring.files.rig is None:
        refuse_vertex_protocols(protocols)
    material = CorpusInputs(scoring, sorted({name.subject for name in names.values()}))
    context = material.context()
    metrics = {name: request.build(context) for name, request in requests.items()}
    scorer = Scorer(
        protocols,
        lips=scoring.lips,
        upper_face=scoring.upper_face,
        templates=scoring.templates or {},
        n_vertices=scoring.n_vertices,
        truth_stride=scoring.truth_stride,
        metrics=metrics,
        inputs=partial(material.inputs, needed=needed),
        moments={name: request.moment for name, request in requests.items()},
        owners={f"{owner}/{label}": (owner, label) for owner, label, _ in of_protocols},
        read=None if scoring.files is None else scoring.files.read,
        channels=None if scoring.files is None else channel_regions(scoring.files.space),
        scales=scales,
    )
    tables = score_methods(methods, Path(truth), truths, scorer, scoring, suffixes)
    clips = {name_of_file(pair.truth.path) for table in tables for pair, _ in table.rows}
    attributes = attributes_of(scoring.corpus, clips, scoring.by) if scoring.by else {}
    by_name = {request.text: metrics[request.text] for request in parse_all(scoring.metrics)}
    return EvaluationReport(
        truth=str(truth),
        lips=scoring.lips,
        upper_face=scoring.upper_face if needs_upper_face(protocols, scoring.metrics) else None,
        n_vertices=scoring.n_vertices,
        protocols={protocol.name: protocol.describe() for protocol in protocols} | definitions(by_name),
        identity=scoring.identity,
        truth_stride=scoring.truth_stride,
        resamples=scoring.bootstrap,
        level=scoring.level,
        seed=scoring.seed,
        methods=[table.result(sampling, attributes) for table in tables],
        groups=[group for table in tables for group in table.groups(attributes)],
        comparisons=[row for table in tables[1:] for row in table.compare(tables[0], sampling)],
        unnamed_truths=unnamed_truths,
        remarks=scorer.remarks,
        points="channels" if scoring.files is not None and scoring.files.rig is None else "vertices",
    )


def definitions(metrics: Mapping[str, object]) -> dict[str, str]:
    """The definitions of metrics chosen by name."""
    lines = [f"  {name}: {getattr(metric, 'definition', type(metric).__doc__)}" for name, metric in metrics.items()]
    return {METRICS: "\n".join(["further metrics", *lines])} if lines else {}


def score_methods(
    methods: Mapping[str, str | Path],
    truth: Path,
    truths: Mapping[str, Truth],
    scorer: Scorer,
    options: EvaluationOptions,
    suffixes: Sequence[str],
) -> list[MethodTable]:
    """Pair each method's files with the truths, and score all clips together."""
    readers = [NamePattern(pattern, options.templates or ()) for pattern in options.patterns]
    paired = {}
    for method, folder in methods.items():
        predictions, unnamed = list_names(Path(folder), readers, suffixes)
        pairs, unscored = pair_up(predictions, truths, options.identity)
        paired[method] = pairs, replace(unscored, unnamed=unnamed)
    jobs = [(method, pair) for method, (pairs, _) in paired.items() for pair in pairs]
    reads = [truth, *map(Path, methods.values()), *([] if options.corpus is None else [options.corpus])]
    scores = score_all(
        scorer, jobs, options.workers, scheduler=options.scheduler, reads=reads, progress=options.progress
    )
    return [
        MethodTable(method, str(methods[method]), pairs, unscored, scores.get(method, {}), scorer.columns)
        for method, (pairs, unscored) in paired.items()
    ]


def needs_upper_face(protocols: Sequence[Protocol], metrics: Sequence[str]) -> bool:
    """Whether a protocol or a metric chosen by name reads the upper-face vertices."""
    requests = [*parse_all(metrics), *(request for one in protocols for request in one.further().values())]
    return any(setting.fdd and not setting.channels for setting in protocols) or any(
        "upper_face" in (*request.needs, request.options.get("region"))
        for request in requests
        if not request.of_channels
    )


@dataclass(frozen=True)
class CorpusInputs:
    """Inputs of metrics besides motion, from the corpus."""

    options: EvaluationOptions
    identities: Sequence[str]  # names of all speakers

    def context(self) -> Context:
        """The inputs that metrics can have, and how to provide the others."""
        options = self.options
        has: dict[str, dict[str, Any]] = {
            "lips": {"lips": options.lips},
            "identities": {"n_identities": len(self.identities)},
        }
        rates = {"sample_rate": SAMPLE_RATE, "frames_per_second": options.frame_rate}
        lids = {"pairs": options.eyelid_pairs, "frames_per_second": options.frame_rate}
        needs: list[tuple[str, bool, dict[str, Any]]] = [
            ("upper_face", options.upper_face is not None, {"upper": options.upper_face}),
            ("lip_pairs", options.lip_pairs is not None, {"pairs": options.lip_pairs}),
            ("lid_pairs", options.eyelid_pairs is not None, lids),
            ("template", bool(options.templates) or options.files is not None, {}),
            ("closures", options.frame_rate is not None and self._has("phonemes"), {}),
            ("speech", options.frame_rate is not None and self._has("wav"), rates),
            ("conditions", options.identity == ALL, {}),
            ("channels", options.files is not None, {}),
            *((need, self._has(need), {}) for need in CONVERSATION),
        ]
        has |= {need: arguments for need, is_there, arguments in needs if is_there}
        rate = "" if options.frame_rate else " and give --frame-rate"
        in_test = "is known to `facediff test --model.metrics=[…]` only"
        are_known = in_test.replace("is", "are", 1)
        return Context(
            has,
            {
                "upper_face": "give --upper-face FILE, or --regions FOLDER with fdd.txt",
                "lip_pairs": "give --lip-pairs FILE",
                "lid_pairs": "give --eyelid-pairs FILE",
                "channels": "these are files of vertices",
                "partner": "no partner: score against a folder with partner/, one file of parameters for each truth",
                "speaking": "score against a folder with speaking/<clip>.npy, a boolean for each frame",
                "gallery": f"recordings outside the test splits {are_known}",
                "template": "give --templates FILE",
                "closures": f"score against a corpus folder with phonemes/{rate}",
                "speech": f"score against a corpus folder with wav/{rate}",
                "conditions": "choose --identity all",
                "samples": f"a folder holds one sample of each clip; the number of samples {in_test}",
                "time": f"the time that inference takes {in_test}",
            },
            {} if options.files is None else channel_regions(options.files.space),
        )

    def _has(self, folder: str) -> bool:
        return self.options.corpus is not None and (self.options.corpus / folder).is_dir()

    def inputs(self, pair: Pair, needed: Set[str]) -> dict[str, Any]:
        """The inputs of one clip, by the names of the metrics' arguments."""
        inputs: dict[str, Any] = {}
        corpus, rate, stride = self.options.corpus, self.options.frame_rate, self.options.truth_stride
        clip = name_of_file(pair.truth.path)
        if "identities" in needed:
            inputs["identities"] = [self.identities.index(pair.truth.name.subject)]
        if corpus is None:
            return inputs
        if "speech" in needed:
            inputs["waveform"] = torch.from_numpy(read_speech(find_file(corpus / "wav" / f"{clip}.wav")))
        if "closures" in needed and rate is not None:
            file = phonemes_file(corpus, clip)
            inputs["closures"] = [] if file is None else closures(read_phonemes(file), rate)
        if "speaking" in needed:
            inputs["speaking"] = [torch.from_numpy(conversation_file(corpus, "speaking", clip, stride))]
        if "partner" in needed and self.options.files is not None:
            path = corpus / "partner" / pair.truth.path.name
            inputs["partner"] = replace(self.options.files, truth=path.parent, rig=None).read(path, stride).channels
        return inputs


def source_unit(protocols: Sequence[Protocol], options: EvaluationOptions) -> str | None:
    """The unit of the scored vertices; None where no score needs it."""
    with_unit = next((protocol.name for protocol in protocols if protocol.unit is not None), None)
    if options.unit is None and with_unit is None:
        return None
    source = options.file_unit or (options.files.unit if options.files is not None else None)
    if not source and options.corpus is not None:
        source = str(read_manifest(options.corpus).get("unit") or "")
    if not source and (options.files is None or options.files.rig is not None):
        reason = f"--unit {options.unit}" if options.unit is not None else f"protocol {with_unit}"
        raise FaceDiffError(f"{reason}: needs the unit of the files; give --file-unit")
    return source or None


def scale_of(source: str | None, target: str | None) -> float:
    """The factor of lengths from one unit to another; 1 without one of them."""
    return 1.0 if source is None or target is None else metres_per_unit(source) / metres_per_unit(target)


def find_protocols(protocols: Sequence[str | Protocol], topology: str | None = None) -> list[Protocol]:
    """Protocols by name, or your own; each once."""
    settings: dict[str, Protocol] = {}
    for name in protocols:
        with errors_of("protocols"):
            setting = protocol(name) if isinstance(name, str) else name
            setting = setting if topology is None else replace(setting, topology=topology)
        if settings.setdefault(setting.name, setting) != setting:
            raise FaceDiffError(f"two different protocols are called {setting.name}; give one another name")
    return list(settings.values())
