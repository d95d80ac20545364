"""Scoring several methods' files against the truth, one clip at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from facediff.errors import FaceDiffError
from facediff.evaluation.files import (
    DEFAULT_PATTERNS,
    OWN,
    TRUTH_PATTERN,
    NamePattern,
    Pairing,
    index_truths,
    list_names,
    pair_up,
)
from facediff.evaluation.report import Bootstrap, MethodTable, Report
from facediff.evaluation.scoring import Scorer, score_all
from facediff.metrics import Protocol, Region, protocol


def evaluate(
    methods: Mapping[str, str | Path],
    truth: str | Path,
    *,
    lips: Region,
    upper_face: Region | None = None,
    templates: Mapping[str, Tensor] | None = None,
    n_vertices: int,
    protocols: Sequence[str | Protocol] = ("paper",),
    topology: str | None = None,
    patterns: Sequence[str] = DEFAULT_PATTERNS,
    truth_pattern: str = TRUTH_PATTERN,
    identity: str = OWN,
    truth_stride: int = 1,
    bootstrap: int = 1000,
    level: float = 0.95,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = False,
) -> Report:
    """Score the files of one or several methods against the truth.

    Files hold absolute vertices, (T, V, 3) or (T, 3V), of any floating-point type. They are memory-mapped, and of each
    clip only its scores are kept. The scores are those of :class:`facediff.metrics.ProtocolMetrics` over all clips.

    Args:
        methods: folder of predictions by method; the first is what the others are compared with.
        truth: folder of truths.
        lips: lip vertices.
        upper_face: upper-face vertices; needed if a protocol has FDD.
        templates: neutral face (V, 3) by subject; needed if a protocol has FDD.
        n_vertices: vertices V of the mesh.
        protocols: names of protocols, or protocols of one's own.
        topology: name of the mesh (``biwi``, ``vocaset`` …), to have unusual regions pointed out.
        patterns: how predictions may be named; see :class:`facediff.evaluation.files.NamePattern`.
        truth_pattern: how truths are named.
        identity: which predictions of a clip are scored where several were conditioned on different identities:
            ``own`` takes the one conditioned on the clip's own subject (or whose name has no condition), ``all`` the
            mean over conditions, as DiffSpeaker does; anything else is the identity's name.
        truth_stride: 2 takes every second frame of the truth, for VOCASET's truth at 60 frames a second.
        bootstrap: resamples of the sequences for confidence intervals; 0 for none.
        level: share of the resamples inside an interval.
        seed: of the resamples.
        workers: clips that are scored at a time; as many as processors if None. Digits do not depend on it.
        progress: whether to show a progress bar on standard error, if it is a terminal.

    Raises:
        FaceDiffError: if an argument does not fit, a method has nothing that can be scored, a clip holds NaN or
            infinity, or a protocol refuses a clip's length.
    """
    if not methods or not protocols or truth_stride < 1:
        raise FaceDiffError("expected at least one method, at least one protocol and a truth_stride of at least 1")
    settings = find_protocols(protocols, topology)
    sampling = Bootstrap(bootstrap, level, seed)
    scorer = Scorer(
        settings,
        lips=lips,
        upper_face=upper_face,
        templates=templates or {},
        n_vertices=n_vertices,
        truth_stride=truth_stride,
    )
    names, unnamed_truths = list_names(Path(truth), [NamePattern(truth_pattern, templates or ())])
    truths = index_truths(names)
    readers = [NamePattern(pattern, templates or ()) for pattern in patterns]
    pairings: dict[str, Pairing] = {}
    for method, folder in methods.items():
        files, unnamed = list_names(Path(folder), readers)
        pairings[method] = pair_up(files, truths, identity)
        pairings[method].unnamed = unnamed
    jobs = [(method, pair) for method, pairing in pairings.items() for pair in pairing.pairs]
    found = score_all(scorer, jobs, workers, progress=progress)
    tables = [
        MethodTable(method, str(methods[method]), pairing, found.get(method, {}), scorer.columns)
        for method, pairing in pairings.items()
    ]
    return Report(
        truth=str(truth),
        lips=lips,
        upper_face=upper_face if any(setting.fdd for setting in settings) else None,
        n_vertices=n_vertices,
        protocols={setting.name: setting.describe() for setting in settings},
        identity=identity,
        truth_stride=truth_stride,
        resamples=bootstrap,
        level=level,
        seed=seed,
        methods=[table.result(sampling) for table in tables],
        comparisons=[row for table in tables[1:] for row in table.compare(tables[0], sampling)],
        unnamed_truths=unnamed_truths,
        remarks=scorer.remarks,
    )


def find_protocols(wanted: Sequence[str | Protocol], topology: str | None = None) -> list[Protocol]:
    """Protocols by name, or one's own; each once.

    Raises:
        FaceDiffError: if there is no protocol or topology of that name, or two protocols share a name.
    """
    found: dict[str, Protocol] = {}
    for each in wanted:
        try:
            setting = protocol(each) if isinstance(each, str) else each
            setting = setting if topology is None else replace(setting, topology=topology)
        except ValueError as error:
            raise FaceDiffError(str(error)) from error
        if found.setdefault(setting.name, setting) != setting:
            raise FaceDiffError(f"two different protocols are called {setting.name}; give one another name")
    return list(found.values())
