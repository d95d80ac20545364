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


@ranges.checked
def evaluate(
    methods: Mapping[str, str | Path],
    truth: str | Path,
    *,
    lips: Region,
    upper_face: Region | None = None,
    templates: Mapping[str, Tensor] | None = None,
    n_vertices: ranges.Vertices,
    protocols: Sequence[str | Protocol] = ("paper",),
    metrics: Sequence[str] = (),
    lip_pairs: LipPairs | None = None,
    eyelid_pairs: LipPairs | None = None,
    corpus: Path | None = None,
    by: Sequence[str] = (),
    frame_rate: ranges.FrameRate | None = None,
    topology: str | None = None,
    files: ParameterFiles | None = None,
    unit: str | None = None,
    file_unit: str | None = None,
    renders: Sequence[str] = (),
    faces: npt.NDArray[np.integer] | None = None,
    patterns: Sequence[str] = DEFAULT_PATTERNS,
    truth_pattern: str = TRUTH_PATTERN,
    identity: str = OWN,
    truth_stride: ranges.Stride = 1,
    bootstrap: ranges.Resamples = 1000,
    level: ranges.Level = 0.95,
    seed: ranges.Seed = 0,
    workers: ranges.Workers | None = None,
    scheduler: str | None = "",
    progress: bool = False,
) -> EvaluationReport:
    """Score the files of one or several methods against the truth.

    Files hold absolute vertices, (T, V, 3) or (T, 3V), of any floating-point type. They are memory-mapped, and of each
    clip only its scores are kept. The scores are those of :class:`facediff.metrics.ProtocolMetrics` over all clips.

    Args:
        methods: folder of predictions by method; the first is what the others are compared with.
        truth: folder of truths.
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

    Raises:
        FaceDiffError: if an argument does not fit, a method has nothing that can be scored, a clip holds NaN or
            infinity, or a protocol refuses a clip's length.
    """
    if not methods or not protocols:
        raise FaceDiffError("expected at least one method and at least one protocol")
    settings = find_protocols(protocols, topology)
    sampling = Bootstrap(bootstrap, level, seed)
    source = source_unit(settings, files, corpus, unit, file_unit)
    scales = {setting.name: scale_of(source, unit or setting.unit) for setting in settings}
    requests = {request.text: request.scaled(scale_of(source, unit)) for request in parse_all(metrics)}
    owners: dict[str, tuple[str, str]] = {}
    for setting in settings:
        for label, request in setting.further(scales[setting.name]).items():
            owners[f"{setting.name}/{label}"] = setting.name, label
            requests[f"{setting.name}/{label}"] = request
    suffixes = (".npy",) if files is None else SUFFIXES
    names, unnamed_truths = list_names(Path(truth), [NamePattern(truth_pattern, templates or ())], suffixes)
    truths = index_truths(names)
    if frame_rate is None and (requests or renders) and corpus is not None:
        stored = read_manifest(corpus).get("frame_rate")
        frame_rate = stored / truth_stride if isinstance(stored, int | float) and stored > 0 else None
    if files is not None:
        files = replace(files, predictions=tuple(map(Path, methods.values())))
        frame_rate = files.frame_rate
    needed = {need for request in requests.values() for need in request.needs}
    if lip_pairs is None and "lip_pairs" in needed and corpus is not None and (corpus / LIP_PAIRS).is_file():
        lip_pairs = read_pairs(None, corpus, n_vertices)
    if eyelid_pairs is None and "lid_pairs" in needed and corpus is not None and (corpus / EYELID_PAIRS).is_file():
        eyelid_pairs = read_pairs(None, corpus, n_vertices, EyelidPairs)
    speakers = sorted({name.subject for name in names.values()})
    material = CorpusInputs(corpus if requests else None, frame_rate, speakers, files, truth_stride)
    context = material.context(
        lips,
        upper_face,
        lip_pairs,
        eyelid_pairs,
        templated=bool(templates) or files is not None,
        every_condition=identity == ALL,
    )
    if files is not None and files.rig is None:
        refuse_vertex_protocols(settings)
    chosen = {name: request.build(context) for name, request in requests.items()}
    scorer = Scorer(
        settings,
        lips=lips,
        upper_face=upper_face,
        templates=templates or {},
        n_vertices=n_vertices,
        truth_stride=truth_stride,
        metrics=chosen,
        inputs=partial(material.inputs, needed=needed),
        moments={name: request.moment for name, request in requests.items()},
        owners=owners,
        read=None if files is None else files.read,
        channels=None if files is None else channel_regions(files.space),
        scales=scales,
    )
    readers = [NamePattern(pattern, templates or ()) for pattern in patterns]
    paired = {}
    for method, folder in methods.items():
        predictions, unnamed = list_names(Path(folder), readers, suffixes)
        pairs, missing = pair_up(predictions, truths, identity)
        paired[method] = pairs, replace(missing, unnamed=unnamed)
    jobs = [(method, pair) for method, (pairs, _) in paired.items() for pair in pairs]
    reads = [Path(truth), *map(Path, methods.values()), *([] if corpus is None else [corpus])]
    scores_by_method = score_all(scorer, jobs, workers, scheduler=scheduler, reads=reads, progress=progress)
    tables = [
        MethodTable(method, str(methods[method]), pairs, missing, scores_by_method.get(method, {}), scorer.columns)
        for method, (pairs, missing) in paired.items()
    ]
    attributes = attributes_of(corpus, names_of(paired), by) if by else {}
    definitions = {setting.name: setting.describe() for setting in settings}
    named = {name: metric for name, metric in chosen.items() if name not in owners}
    if named:
        lines = [f"  {name}: {getattr(metric, 'definition', type(metric).__doc__)}" for name, metric in named.items()]
        definitions[METRICS] = "\n".join(["further metrics", *lines])
    rendered = {}
    regions = {"lips": lips.indices} | ({} if upper_face is None else {"upper_face": upper_face.indices})
    if renders:
        usable = {table.name: ([pair for pair, _ in table.rows], table.missing) for table in tables}
        rendered = score_renders(renders, scorer, usable, regions, faces, corpus, frame_rate)
    results = [table.result(sampling, attributes) for table in tables]
    return EvaluationReport(
        truth=str(truth),
        lips=lips,
        upper_face=upper_face if needs_upper_face(settings, metrics) else None,
        n_vertices=n_vertices,
        protocols=definitions,
        identity=identity,
        truth_stride=truth_stride,
        resamples=bootstrap,
        level=level,
        seed=seed,
        methods=results,
        runs=runs_of(results),
        groups=[group for table in tables for group in table.groups(attributes)],
        comparisons=[row for table in tables[1:] for row in table.compare(tables[0], sampling)],
        unnamed_truths=unnamed_truths,
        remarks=scorer.remarks,
        renders=rendered,
        points="channels" if files is not None and files.rig is None else "vertices",
    )


def score_renders(
    renders: Sequence[str],
    scorer: Scorer,
    paired: Mapping[str, tuple[Sequence[Pair], object]],
    regions: Mapping[str, Sequence[int]],
    faces: npt.NDArray[np.integer] | None,
    corpus: Path | None,
    frame_rate: float | None,
) -> dict[str, dict[str, float]]:
    """Means over clips of the scores on renders, of every method and of the truth.

    Raises:
        FaceDiffError: if there are no triangles, no vertices or no frame rate.
    """
    metrics = read_render_metrics(renders)
    if faces is None or frame_rate is None:
        lacking = "triangles (--mesh FILE)" if faces is None else "the frame rate (--frame-rate)"
        raise FaceDiffError(f"--render draws motion, and lacks {lacking}; give it")

    def speech(clip: str) -> npt.NDArray[np.float32]:
        path = None if corpus is None else corpus / "wav" / f"{clip}.wav"
        return read_speech(path) if path is not None and path.is_file() else np.zeros(0, np.float32)

    drawing = RenderScorer(metrics=metrics, faces=faces, regions=regions, frame_rate=frame_rate, speech=speech)
    rows: dict[str, dict[str, list[dict[str, float]]]] = {}
    for method, (pairs, _) in paired.items():
        for pair in pairs:
            truth = scorer.read(pair.truth.path, scorer.truth_stride)
            vertices = truth.get(channels=False)
            known = scorer.templates.get(pair.truth.name.subject, truth.template)
            template = (vertices.double().mean(0) if known is None else known.double()).numpy()
            clip = pair.truth.path.stem
            own = rows.setdefault(method, {})
            own[clip] = [
                drawing.score(clip, scorer.read(path, 1).get(channels=False).double().numpy(), template)
                for path in pair.predictions.values()
            ]
            truths = rows.setdefault("truth", {})
            if clip not in truths:
                truths[clip] = [drawing.score(clip, vertices.double().numpy(), template)]
    return {who: means([means(own) for own in clips.values()]) for who, clips in rows.items()}


def names_of(paired: Mapping[str, tuple[Sequence[Pair], object]]) -> set[str]:
    """Names of the truths' files."""
    return {pair.truth.path.stem for pairs, _ in paired.values() for pair in pairs}


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

    corpus: Path | None
    frame_rate: float | None  # of the predictions, if known
    identities: Sequence[str]  # names of all speakers
    files: ParameterFiles | None = None  # how files of parameters are read
    truth_stride: int = 1  # of what is stored at the frame rate of the truth

    def context(
        self,
        lips: Region,
        upper_face: Region | None,
        lip_pairs: LipPairs | None,
        eyelid_pairs: LipPairs | None,
        *,
        templated: bool,
        every_condition: bool,
    ) -> Context:
        """What there is for metrics, and how to get what is missing."""
        has: dict[str, dict[str, Any]] = {"lips": {"lips": lips}, "identities": {"n_identities": len(self.identities)}}
        rates = {"sample_rate": SAMPLE_RATE, "frames_per_second": self.frame_rate}
        for need, there, arguments in (
            ("upper_face", upper_face is not None, {"upper": upper_face}),
            ("lip_pairs", lip_pairs is not None, {"pairs": lip_pairs}),
            ("lid_pairs", eyelid_pairs is not None, {"pairs": eyelid_pairs, "frames_per_second": self.frame_rate}),
            ("template", templated, {}),
            ("closures", self._has("phonemes"), {}),
            ("speech", self._has("wav"), rates),
            ("conditions", every_condition, {}),
        ):
            if there:
                has[need] = arguments
        if self.files is not None:
            has["channels"] = {}
        has |= {need: {} for need in CONVERSATION if self.corpus is not None and (self.corpus / need).is_dir()}
        rate = "" if self.frame_rate else " and give --frame-rate"
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
            {} if self.files is None else channel_regions(self.files.space),
        )

    def _has(self, folder: str) -> bool:
        return self.corpus is not None and self.frame_rate is not None and (self.corpus / folder).is_dir()

    def inputs(self, pair: Pair, needed: Set[str]) -> dict[str, Any]:
        """What the needs mean for one clip, by the name under which metrics take it."""
        inputs: dict[str, Any] = {}
        if "identities" in needed:
            inputs["identities"] = [self.identities.index(pair.truth.name.subject)]
        clip = pair.truth.path.stem
        if "speech" in needed and self.corpus is not None:
            inputs["waveform"] = torch.from_numpy(read_speech(self.corpus / "wav" / f"{clip}.wav"))
        if "closures" in needed and self.frame_rate is not None:
            file = phonemes_file(self.corpus, clip)
            inputs["closures"] = [] if file is None else closures(read_phonemes(file), self.frame_rate)
        if "speaking" in needed and self.corpus is not None:
            speaking = conversation_file(self.corpus, "speaking", clip, self.truth_stride)
            inputs["speaking"] = [torch.from_numpy(speaking)]
        if "partner" in needed and self.corpus is not None and self.files is not None:
            path = self.corpus / "partner" / pair.truth.path.name
            partner = replace(self.files, truth=path.parent, rig=None)
            inputs["partner"] = partner.read(path, self.truth_stride).channels
        return inputs


def source_unit(
    protocols: Sequence[Protocol],
    files: ParameterFiles | None,
    corpus: Path | None,
    unit: str | None,
    stated: str | None,
) -> str | None:
    """The unit of the vertices that are scored; None where no score needs it.

    Raises:
        FaceDiffError: if a score is in a unit, and nothing says that of the files.
    """
    named = next((one.name for one in protocols if one.unit is not None), None)
    if unit is None and named is None:
        return None
    source = stated or (files.unit if files is not None else None)
    if not source and corpus is not None:
        source = str(read_manifest(corpus).get("unit") or "")
    if not source and (files is None or files.rig is not None):
        asked = f"--unit {unit}" if unit is not None else f"protocol {named}"
        raise FaceDiffError(f"{asked}: the scores' unit is known, that of the files is not; give --file-unit")
    return source or None


def scale_of(source: str | None, target: str | None) -> float:
    """The factor of lengths from one unit to another; 1 where either is not asked for."""
    return 1.0 if source is None or target is None else metres_per_unit(source) / metres_per_unit(target)


def find_protocols(protocols: Sequence[str | Protocol], topology: str | None = None) -> list[Protocol]:
    """Protocols by name, or one's own; each once.

    Raises:
        FaceDiffError: if there is no protocol or topology of that name, or two protocols share a name.
    """
    settings: dict[str, Protocol] = {}
    for name in protocols:
        try:
            setting = protocol(name) if isinstance(name, str) else name
            setting = setting if topology is None else replace(setting, topology=topology)
        except ValueError as error:
            raise FaceDiffError(str(error)) from error
        if settings.setdefault(setting.name, setting) != setting:
            raise FaceDiffError(f"two different protocols are called {setting.name}; give one another name")
    return list(settings.values())
