"""Score several methods' files against the truth, one clip at a time, with what metrics read of the corpus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff.data.conversations import CONVERSATION, channel_regions, conversation_file
from facediff.data.corpus import ALL, EYELID_PAIRS, LIP_PAIRS, read_manifest
from facediff.errors import FaceDiffError
from facediff.evaluation.files import (
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
from facediff.evaluation.renders import RenderScorer, means, read_render_metrics
from facediff.evaluation.report import EvaluationReport, MethodTable, runs_of
from facediff.evaluation.scoring import METRICS, Scorer, score_all
from facediff.metrics import Context, EyelidPairs, LipPairs, Protocol, Region, protocol
from facediff.metrics.by_name import parse_all
from facediff.reporting.statistics import Bootstrap
from facediff.spaces.files.reading import SUFFIXES
from facediff.spaces.space import metres_per_unit
from facediff.speech.audio import SAMPLE_RATE, read_speech
from facediff.speech.phonemes import closures, phonemes_file, read_phonemes
from facediff.utils import ranges


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """How files are scored.

    Attributes:
        lips: lip vertices.
        upper_face: upper-face vertices; needed if a protocol has FDD.
        templates: neutral face (V, 3) by identity; needed if a protocol has FDD.
        n_vertices: vertices V of the mesh.
        protocols: names of protocols, or protocols of one's own.
        metrics: further metrics, each the name of a registered one, which may be followed by options:
            ``temporal_misalignment:at=path,smoothing=1.5``. What they need in addition is found in ``corpus``.
        lip_pairs: pairs of inner-lip vertices; those of the corpus if None.
        eyelid_pairs: pairs of eyelid vertices, by which blinks are seen; those of the corpus if None.
        corpus: corpus folder of the truth, whose ``wav``, ``phonemes``, ``regions/inner_lip_pairs.txt`` and
            ``manifest.json`` are used where a metric needs them.
        by: attributes of clips, columns of the corpus's ``clips.csv``, by which scores are grouped too.
        frame_rate: frames per second of the predictions; that of the corpus's ``manifest.json`` if None.
        topology: name of the mesh (``biwi``, ``vocaset`` …), to have unusual regions pointed out.
        files: how files of parameters are read; None for files of vertices.
        unit: unit of lengths of the scores of vertices; that of each protocol, or of the vertices, if None.
        file_unit: unit of the vertices; as the rig or the corpus's ``manifest.json`` says if None.
        renders: render metrics by name with options; see :mod:`facediff.evaluation.renders`.
        faces: (F, 3) triangles, by which motion is rendered; those of the rig if None.
        patterns: how predictions may be named; see :class:`facediff.evaluation.files.NamePattern`.
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
    renders: Sequence[str] = ()
    faces: npt.NDArray[np.integer] | None = None
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

    @property
    def regions(self) -> dict[str, tuple[int, ...]]:
        """Vertices of the lips and, if known, of the upper face."""
        parts = {"lips": self.lips, "upper_face": self.upper_face}
        return {name: region.indices for name, region in parts.items() if region is not None}

    def completed(self, needed: Set[str], *, rate: bool, methods: Mapping[str, str | Path]) -> EvaluationOptions:
        """The options with what the corpus says: the frame rate, if it is wanted, and pairs that metrics need."""
        found: dict[str, Any] = {}
        if self.files is not None:
            files = replace(self.files, predictions=tuple(map(Path, methods.values())))
            found = {"files": files, "frame_rate": files.frame_rate}
        elif self.frame_rate is None and rate and self.corpus is not None:
            stored = read_manifest(self.corpus).get("frame_rate")
            if isinstance(stored, int | float) and stored > 0:
                found["frame_rate"] = stored / self.truth_stride
        for field, need, file, kind in (
            ("lip_pairs", "lip_pairs", LIP_PAIRS, LipPairs),
            ("eyelid_pairs", "lid_pairs", EYELID_PAIRS, EyelidPairs),
        ):
            if getattr(self, field) is None and need in needed and self.corpus and (self.corpus / file).is_file():
                found[field] = read_pairs(None, self.corpus, self.n_vertices, kind)
        return replace(self, **found)


def evaluate(methods: Mapping[str, str | Path], truth: str | Path, **options: Any) -> EvaluationReport:  # noqa: ANN401
    """Score the files of one or several methods against the truth.

    Files hold absolute vertices, (T, V, 3) or (T, 3V), of any floating-point type. They are memory-mapped, and of each
    clip only its scores are kept. The scores are those of :class:`facediff.metrics.ProtocolMetrics` over all clips.

    Args:
        methods: folder of predictions by method; the first is what the others are compared with.
        truth: folder of truths.
        options: the fields of :class:`EvaluationOptions`, of which ``lips`` and ``n_vertices`` are needed.
    """
    given = EvaluationOptions(**options)
    if not methods or not given.protocols:
        raise FaceDiffError("expected at least one method and at least one protocol")
    settings = find_protocols(given.protocols, given.topology)
    sampling = Bootstrap(given.bootstrap, given.level, given.seed)
    source = source_unit(settings, given)
    scales = {setting.name: scale_of(source, given.unit or setting.unit) for setting in settings}
    requests = {request.text: request.scaled(scale_of(source, given.unit)) for request in parse_all(given.metrics)}
    further = [
        (setting.name, label, request)
        for setting in settings
        for label, request in setting.further(scales[setting.name]).items()
    ]
    requests |= {f"{owner}/{label}": request for owner, label, request in further}
    needed = {need for request in requests.values() for need in request.needs}
    given = given.completed(needed, rate=bool(requests or given.renders), methods=methods)
    suffixes = (".npy",) if given.files is None else SUFFIXES
    names, unnamed_truths = list_names(Path(truth), [NamePattern(given.truth_pattern, given.templates or ())], suffixes)
    truths = index_truths(names)
    if given.files is not None and given.files.rig is None:
        refuse_vertex_protocols(settings)
    material = CorpusInputs(given, sorted({name.subject for name in names.values()}))
    context = material.context()
    metrics = {name: request.build(context) for name, request in requests.items()}
    scorer = Scorer(
        settings,
        lips=given.lips,
        upper_face=given.upper_face,
        templates=given.templates or {},
        n_vertices=given.n_vertices,
        truth_stride=given.truth_stride,
        metrics=metrics,
        inputs=partial(material.inputs, needed=needed),
        moments={name: request.moment for name, request in requests.items()},
        owners={f"{owner}/{label}": (owner, label) for owner, label, _ in further},
        read=None if given.files is None else given.files.read,
        channels=None if given.files is None else channel_regions(given.files.space),
        scales=scales,
    )
    tables = score_methods(methods, Path(truth), truths, scorer, given, suffixes)
    clips = {pair.truth.path.stem for table in tables for pair, _ in table.rows}
    attributes = attributes_of(given.corpus, clips, given.by) if given.by else {}
    chosen = {request.text: metrics[request.text] for request in parse_all(given.metrics)}
    results = [table.result(sampling, attributes) for table in tables]
    return EvaluationReport(
        truth=str(truth),
        lips=given.lips,
        upper_face=given.upper_face if needs_upper_face(settings, given.metrics) else None,
        n_vertices=given.n_vertices,
        protocols={setting.name: setting.describe() for setting in settings} | definitions(chosen),
        identity=given.identity,
        truth_stride=given.truth_stride,
        resamples=given.bootstrap,
        level=given.level,
        seed=given.seed,
        methods=results,
        runs=runs_of(results),
        groups=[group for table in tables for group in table.groups(attributes)],
        comparisons=[row for table in tables[1:] for row in table.compare(tables[0], sampling)],
        unnamed_truths=unnamed_truths,
        remarks=scorer.remarks,
        renders=score_renders(tables, scorer, given),
        points="channels" if given.files is not None and given.files.rig is None else "vertices",
    )


def definitions(metrics: Mapping[str, object]) -> dict[str, str]:
    """What metrics chosen by name are, as the definition of a protocol of their own."""
    lines = [f"  {name}: {getattr(metric, 'definition', type(metric).__doc__)}" for name, metric in metrics.items()]
    return {METRICS: "\n".join(["further metrics", *lines])} if lines else {}


def score_methods(
    methods: Mapping[str, str | Path],
    truth: Path,
    truths: Mapping[str, Truth],
    scorer: Scorer,
    given: EvaluationOptions,
    suffixes: Sequence[str],
) -> list[MethodTable]:
    """Pair each method's files with the truths, and score all clips together."""
    readers = [NamePattern(pattern, given.templates or ()) for pattern in given.patterns]
    paired = {}
    for method, folder in methods.items():
        predictions, unnamed = list_names(Path(folder), readers, suffixes)
        pairs, missing = pair_up(predictions, truths, given.identity)
        paired[method] = pairs, replace(missing, unnamed=unnamed)
    jobs = [(method, pair) for method, (pairs, _) in paired.items() for pair in pairs]
    reads = [truth, *map(Path, methods.values()), *([] if given.corpus is None else [given.corpus])]
    scores = score_all(scorer, jobs, given.workers, scheduler=given.scheduler, reads=reads, progress=given.progress)
    return [
        MethodTable(method, str(methods[method]), pairs, missing, scores.get(method, {}), scorer.columns)
        for method, (pairs, missing) in paired.items()
    ]


def score_renders(
    tables: Sequence[MethodTable], scorer: Scorer, given: EvaluationOptions
) -> dict[str, dict[str, float]]:
    """Means over clips of the scores on renders, of every method and of the truth; empty if none are asked for."""
    if not given.renders:
        return {}
    metrics = read_render_metrics(given.renders)
    if given.faces is None or given.frame_rate is None:
        lacking = "triangles (--mesh FILE)" if given.faces is None else "the frame rate (--frame-rate)"
        raise FaceDiffError(f"--render draws motion, and lacks {lacking}; give it")

    def speech(clip: str) -> npt.NDArray[np.float32]:
        path = None if given.corpus is None else given.corpus / "wav" / f"{clip}.wav"
        return read_speech(path) if path is not None and path.is_file() else np.zeros(0, np.float32)

    drawing = RenderScorer(
        metrics=metrics, faces=given.faces, regions=given.regions, frame_rate=given.frame_rate, speech=speech
    )
    rows: dict[str, dict[str, dict[str, float]]] = {}
    for table in tables:
        for pair, _ in table.rows:
            truth = scorer.read(pair.truth.path, scorer.truth_stride)
            vertices = truth.get(channels=False)
            known = scorer.templates.get(pair.truth.name.subject, truth.template)
            template = (vertices.double().mean(0) if known is None else known.double()).numpy()
            clip = pair.truth.path.stem
            files = [scorer.read(path, 1).get(channels=False) for path in pair.predictions.values()]
            drawn = [drawing.score(clip, motion.double().numpy(), template) for motion in files]
            rows.setdefault(table.name, {})[clip] = means(drawn)
            if clip not in rows.setdefault("truth", {}):
                rows["truth"][clip] = drawing.score(clip, vertices.double().numpy(), template)
    return {method: means([*clips.values()]) for method, clips in rows.items()}


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
    """What metrics may read of a corpus in addition to motion."""

    given: EvaluationOptions
    identities: Sequence[str]  # names of all speakers

    def context(self) -> Context:
        """What there is for metrics, and how to get what is missing."""
        given = self.given
        has: dict[str, dict[str, Any]] = {
            "lips": {"lips": given.lips},
            "identities": {"n_identities": len(self.identities)},
        }
        rates = {"sample_rate": SAMPLE_RATE, "frames_per_second": given.frame_rate}
        lids = {"pairs": given.eyelid_pairs, "frames_per_second": given.frame_rate}
        needs: list[tuple[str, bool, dict[str, Any]]] = [
            ("upper_face", given.upper_face is not None, {"upper": given.upper_face}),
            ("lip_pairs", given.lip_pairs is not None, {"pairs": given.lip_pairs}),
            ("lid_pairs", given.eyelid_pairs is not None, lids),
            ("template", bool(given.templates) or given.files is not None, {}),
            ("closures", given.frame_rate is not None and self._has("phonemes"), {}),
            ("speech", given.frame_rate is not None and self._has("wav"), rates),
            ("conditions", given.identity == ALL, {}),
            ("channels", given.files is not None, {}),
            *((need, self._has(need), {}) for need in CONVERSATION),
        ]
        has |= {need: arguments for need, there, arguments in needs if there}
        rate = "" if given.frame_rate else " and give --frame-rate"
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
                "style": f"a model's style encoder {in_test}",
                "time": f"the time that inference takes {in_test}",
            },
            {} if given.files is None else channel_regions(given.files.space),
        )

    def _has(self, folder: str) -> bool:
        return self.given.corpus is not None and (self.given.corpus / folder).is_dir()

    def inputs(self, pair: Pair, needed: Set[str]) -> dict[str, Any]:
        """What the needs mean for one clip, by the name under which metrics take it."""
        inputs: dict[str, Any] = {}
        corpus, rate, stride = self.given.corpus, self.given.frame_rate, self.given.truth_stride
        clip = pair.truth.path.stem
        if "identities" in needed:
            inputs["identities"] = [self.identities.index(pair.truth.name.subject)]
        if corpus is None:
            return inputs
        if "speech" in needed:
            inputs["waveform"] = torch.from_numpy(read_speech(corpus / "wav" / f"{clip}.wav"))
        if "closures" in needed and rate is not None:
            file = phonemes_file(corpus, clip)
            inputs["closures"] = [] if file is None else closures(read_phonemes(file), rate)
        if "speaking" in needed:
            inputs["speaking"] = [torch.from_numpy(conversation_file(corpus, "speaking", clip, stride))]
        if "partner" in needed and self.given.files is not None:
            path = corpus / "partner" / pair.truth.path.name
            inputs["partner"] = replace(self.given.files, truth=path.parent, rig=None).read(path, stride).channels
        return inputs


def source_unit(protocols: Sequence[Protocol], given: EvaluationOptions) -> str | None:
    """The unit of the vertices that are scored; None where no score needs it."""
    named = next((one.name for one in protocols if one.unit is not None), None)
    if given.unit is None and named is None:
        return None
    source = given.file_unit or (given.files.unit if given.files is not None else None)
    if not source and given.corpus is not None:
        source = str(read_manifest(given.corpus).get("unit") or "")
    if not source and (given.files is None or given.files.rig is not None):
        asked = f"--unit {given.unit}" if given.unit is not None else f"protocol {named}"
        raise FaceDiffError(f"{asked}: the scores' unit is known, that of the files is not; give --file-unit")
    return source or None


def scale_of(source: str | None, target: str | None) -> float:
    """The factor of lengths from one unit to another; 1 where either is not asked for."""
    return 1.0 if source is None or target is None else metres_per_unit(source) / metres_per_unit(target)


def find_protocols(protocols: Sequence[str | Protocol], topology: str | None = None) -> list[Protocol]:
    """Protocols by name, or one's own; each once."""
    settings: dict[str, Protocol] = {}
    for name in protocols:
        with errors_of("protocols"):
            setting = protocol(name) if isinstance(name, str) else name
            setting = setting if topology is None else replace(setting, topology=topology)
        if settings.setdefault(setting.name, setting) != setting:
            raise FaceDiffError(f"two different protocols are called {setting.name}; give one another name")
    return list(settings.values())
