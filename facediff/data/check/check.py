"""Checking a corpus folder: contents, missing clips and defects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from facediff.data.check.clip import LENGTHS, ClipInfo, Rules, examine, is_about
from facediff.data.check.findings import FEW, CheckReport, Findings, few
from facediff.data.check.layouts import MANIFEST, CorpusFolder, CorpusView, identify, list_folder, list_packed
from facediff.data.check.recordings import check_recordings, parametric_module, refuse_layout
from facediff.data.check.shared import check_areas, check_files, check_mesh, check_regions, check_templates
from facediff.data.manifest import read_manifest
from facediff.data.packed.stores import is_packed
from facediff.data.storage import ClipFolder
from facediff.errors import FaceDiffError, counted, number
from facediff.utils.jobs import is_cluster, run_tasks
from facediff.utils.workers import WorkerDied, processors

if TYPE_CHECKING:
    from facediff.data.corpus import Clip
    from facediff.data.packed.reader import PackedCorpus

WORTH_IT = 64 << 20
"""From so many bytes of motion on, starting processes pays."""
REFERENCES = "none"
"""The split of clips that give style references only."""
SPLITS = ("train", "val", "test_a", "test_b", "test_c")
NEVER_RECORDED = 0.05
"""Share of a split that may be missing of these without a warning; the true number is not published."""


def check(
    root: Path | str,
    corpus: str | None = None,
    *,
    quick: bool = False,
    workers: int | None = None,
    scheduler: str | None = "",
    progress: bool = False,
) -> CheckReport:
    """Check a corpus folder; nothing in it is changed, trusted or run.

    Args:
        root: the folder; or a packed corpus, its folder or its address.
        corpus: name of the corpus (``biwi``), or import path of its data module; found out if None.
        quick: read headers only: no NaN, no comparison with templates, no copies; files are compared by size.
        workers: clips at a time; if None, as many as processors where there is much to read, or all of a cluster.
        scheduler: where clips are read; see :func:`facediff.utils.jobs.run_tasks`.
        progress: show a progress bar on standard error.
    """
    packed: PackedCorpus | None = None
    if is_packed(root):
        from facediff.data.packed.reader import PackedCorpus

        packed = PackedCorpus(root)
    folder = Path(root).expanduser() if packed is None else packed.folder
    if not folder.is_dir():
        raise FaceDiffError(f"{folder}: no such folder; expected a corpus with wav/, vertices_npy/ and templates.pkl")
    refuse_layout(corpus)
    report = CheckReport(folder if packed is None else packed.source, quick)
    manifest: dict[str, Any] = {}
    with report.findings.guard("manifest_unreadable", folder / MANIFEST, folder):
        manifest = read_manifest(folder)
    if report.findings:
        return report
    module = parametric_module(folder, corpus, manifest) if packed is None else None
    if module is not None:
        check_recordings(report, folder, module, corpus)
        return report.sorted()
    listed = list_folder(folder) if packed is None else list_packed(packed)
    view: CorpusView | None = None
    # A corpus that the user names and that is not known is wrong usage, and no finding.
    with report.findings.guard("unrecognised", folder, folder) if corpus is None else nullcontext():
        recorded = manifest.get("corpus") or (None if packed is None else packed.record.corpus)
        view = identify(listed, {**manifest, "corpus": recorded}, corpus)
    if view is not None:
        options = {"workers": workers, "scheduler": scheduler, "progress": "clips" if progress else ""}
        _check_corpus(report, view, listed, manifest, packed, options)
    return report.sorted()


def _check_corpus(
    report: CheckReport,
    view: CorpusView,
    folder: CorpusFolder,
    manifest: dict[str, Any],
    packed: PackedCorpus | None,
    options: dict[str, Any],
) -> None:
    from facediff.data.corpus import EYELID_PAIRS, LIP_PAIRS, Corpus, read_clip_table

    root, findings = folder.root, report.findings
    report.corpus, report.data_module = view.corpus, view.data_module
    report.frame_rate, report.n_vertices = view.frame_rate, view.n_vertices
    stored = report.stored_frame_rate = float(manifest.get("frame_rate") or view.stored_frame_rate)
    there, writer = (root / MANIFEST).is_file(), manifest.get("facediff")
    ended = there or not (root / "prepare.json").is_file()
    report.manifest |= {"there": there, "ended": ended, "facediff": None if writer is None else str(writer)}
    opened: Any = None  # where the folder cannot be opened
    with findings.guard("frame_rate" if ended else "unfinished", root / MANIFEST, root):
        arguments: dict[str, Any] = {"stored_frame_rate": view.stored_frame_rate, "parse": view.parse}
        opened = Corpus(root, view.n_vertices, view.frame_rate, storage=packed, **arguments)
    if opened is None:
        return
    templates, report.templates = check_templates(root, view, findings)
    faces, report.mesh = check_mesh(opened, view, findings)
    if faces is not None:
        report.templates["areas"] = check_areas(view, manifest.get("unit"), templates, faces, findings)
    report.regions = check_regions(root, view, findings)
    for file in (LIP_PAIRS, EYELID_PAIRS):
        with findings.guard("region_broken", root / file, root):
            opened.read_pairs(file)
    clips: dict[str, Clip] = {}
    with findings.guard("clips_table", root / "clips.csv", root):
        rows = read_clip_table(root)
        if unknown := sorted(rows.keys() - set(folder.names)):
            message = f"has rows of clips that are not here: {few(unknown)}; a misspelt name loses its attributes"
            findings.note("clips_table", "clips.csv", message)
        with findings.guard("no_clip", root, root):
            clips = opened.clips
    _check_names(view, folder, clips, findings)
    if report.templates["file"]:
        _check_subjects(clips, {*templates, *report.templates["broken"]}, findings)
    storage = packed or ClipFolder(root, view.n_vertices)
    rules = Rules(root, storage, view.n_vertices, stored, templates, report.quick)
    fits = packed is None or _check_packed(packed, rules, findings)
    facts = _examine_all(rules, folder, clips.values(), **options) if fits else []
    rate_fits = _check_frame_rate(view, stored, facts, findings, recorded="frame_rate" in manifest)
    for clip in facts:
        # Where the frame rate is wrong, every clip has the wrong length: one finding is enough.
        findings += [finding for finding in clip.findings if rate_fits or finding.kind not in LENGTHS]
    _check_copies(facts, findings)
    files = manifest.get("files", {})
    if packed is not None:  # motion and speech are no files any more
        files = {name: files[name] for name in files if name in packed.record.files}
    hashes = {where: digest for clip in facts for where, digest in clip.hashes.items()}
    report.manifest |= check_files(root, files, hashes, findings, quick=report.quick)
    if failed := manifest.get("failed"):
        name, reason = next(iter(failed.items()))
        message = f"{counted(len(failed), 'clip')} could not be prepared, the first: {name}: {reason}"
        findings.warning("prepare_failed", MANIFEST, message)
    stride = max(1, round(stored / view.frame_rate))
    frames = {clip.name: -(-clip.frames // stride) for clip in facts if clip.frames is not None}
    report.splits = _count_splits(view, clips, frames, findings)
    report.subjects = _count_subjects(view, clips, frames, templates)


def _check_packed(packed: PackedCorpus, rules: Rules, findings: Findings) -> bool:
    """Whether a packed corpus has the recognised topology; compares its templates with ``templates.pkl``."""
    record = packed.record
    if record.n_vertices != rules.n_vertices:
        message = f"was packed with {record.n_vertices} vertices, expected {rules.n_vertices}; give --corpus"
        findings.error("motion_shape", packed.source, message)
        return False
    with findings.guard("templates_unreadable", Path("templates"), Path(packed.source)):
        for name, face in packed.templates().items():
            if name in rules.templates and not np.array_equal(face, rules.templates[name]):
                message = f"the packed face of {name} differs from templates.pkl; pack the corpus again"
                findings.error("template_differs", f"templates:{name}", message)
        quality = "lossless" if not record.tolerance else f"coordinates within {record.tolerance:g} mm"
        findings.note("packed", packed.source, f"is packed, {quality}; made by facediff {record.made_by}")
    return True


def _examine_all(
    rules: Rules,
    folder: CorpusFolder,
    clips: Iterable[Clip],
    *,
    workers: int | None,
    scheduler: str | None,
    progress: str,
) -> list[ClipInfo]:
    reads = [folder.root]
    if isinstance(rules.storage, ClipFolder):
        size = sum(path.stat().st_size for path in folder.motions.values())
    else:
        reads, size = rules.storage.folders, sum(sum(array.shards) for array in rules.storage.record.arrays.values())
    if not is_cluster(scheduler):
        workers = workers or (1 if rules.quick or size <= WORTH_IT else processors())
    tasks = [(clip.name, clip.identity) for clip in clips]
    examined: dict[str, ClipInfo] = {}
    work = partial(examine, rules)
    with closing(
        run_tasks(work, tasks, workers=workers, scheduler=scheduler, reads=reads, progress=progress)
    ) as results:
        for (name, _), facts in results:
            if isinstance(facts, WorkerDied):
                facts = ClipInfo(name)
                message = "killed the process that read it: badly damaged, or too little memory; get its files again"
                facts.findings.error("clip_unreadable", name, message)
            examined[name] = facts
    return [examined[name] for name, _ in tasks]


# Findings about names and pairs of files.


def _check_names(view: CorpusView, folder: CorpusFolder, clips: Mapping[str, Clip], findings: Findings) -> None:
    """Report names not of the corpus's form, subjects in no split, and files without their partner."""
    unknown = [name for name in folder.names if view.parse(name) is None]
    if unknown:
        message = f"{counted(len(unknown), 'name')} not of {view.corpus}'s form, so not read: {few(unknown)}"
        findings.warning("unknown_name", "wav, vertices_npy", message)
    identities = set(view.identities)
    identities |= {clip.identity for names in view.expected.values() for name in names if (clip := view.parse(name))}
    identities |= {c.identity for c in clips.values() if any(split_of(c) for split_of in view.split_of.values())}
    if foreign := [name for name, clip in clips.items() if clip.identity not in identities]:
        subjects = dict.fromkeys(clips[name].identity for name in foreign)
        message = (
            f"{counted(len(foreign), 'clip')} of subjects in no split of {view.corpus} ({few(subjects)}), so "
            f"not trained or scored on: {few(foreign)}"
        )
        findings.warning("unknown_subject", "wav, vertices_npy", message)
    for files, partners, fault, kind in (
        (folder.sounds, folder.motions, "speech without motion", "motion_missing"),
        (folder.motions, folder.sounds, "motion without speech", "sound_missing"),
    ):
        for name in sorted(files.keys() - partners.keys() - set(unknown)):
            findings.warning(kind, name, f"{fault}, so not used; get the other file or remove this one")


def _check_subjects(clips: Mapping[str, Clip], with_template: set[str], findings: Findings) -> None:
    lacking: dict[str, list[str]] = {}
    for name, clip in clips.items():
        if clip.identity not in with_template:
            lacking.setdefault(clip.identity, []).append(name)
    for subject, names in lacking.items():
        message = (
            f"no template of {subject}, needed by {counted(len(names), 'clip')} ({few(names)}); get the file again"
        )
        findings.error("template_missing", "templates.pkl", message)


# Findings about all clips together: frame rate, copies.


def _check_frame_rate(
    view: CorpusView, stored: float, facts: Sequence[ClipInfo], findings: Findings, *, recorded: bool
) -> bool:
    """Whether the lengths of the speech agree with the frame rate; one finding if most clips disagree."""
    rates = [clip.frames / clip.seconds for clip in facts if clip.frames is not None and clip.seconds]
    # Only twice and half the rate are recognised: other ratios come from clips that are cut differently.
    measured = median(rates) if rates else stored
    rate = next((factor * stored for factor in (2.0, 0.5) if is_about(measured, factor * stored)), None)
    if rate is None:
        return True
    readable = rate >= view.frame_rate and (rate / view.frame_rate).is_integer()
    remedy = f'write {{"frame_rate": {rate:g}}} into manifest.json' if readable else "prepare it again"
    source = "manifest.json says" if recorded else f"copies of {view.corpus} have"
    message = (
        f"there are about {rate:g} motion frames for each second of speech, but {source} {stored:g}: motion would run "
        f"at {stored / rate:g} times its speed; {remedy}"
    )
    findings.error("frame_rate", "vertices_npy", message)
    return False


def _check_copies(facts: Iterable[ClipInfo], findings: Findings) -> None:
    names: dict[str, list[str]] = {}
    for clip in facts:
        for where, digest in clip.hashes.items():
            names.setdefault(f"{digest}{where[-4:]}", []).append(where)
    for where, *copies in names.values():
        if copies:
            same = f"{', '.join(copies[:FEW])}{' …' if len(copies) > FEW else ''}"
            message = f"holds the same bytes as {same}: one of them has a wrong name; get it again or remove it"
            (findings.error if where.endswith(".npy") else findings.warning)("copy", where, message)


# Counting clips, frames and seconds by split and by subject, and missing clips.


def _count_splits(
    view: CorpusView, clips: Mapping[str, Clip], frames: Mapping[str, int], findings: Findings
) -> list[dict[str, Any]]:
    """One row for each split of each of the ways in which a corpus is split."""
    rows: list[dict[str, Any]] = []
    for way, split_of in view.split_of.items():
        members: dict[str, list[str]] = {split: [] for split in (*SPLITS, REFERENCES)}
        for name, clip in clips.items():
            members.setdefault(split_of(clip) or REFERENCES, []).append(name)
        for split, names in members.items():
            expected = view.expected.get(split)
            if names or expected:
                gaps = sorted(set(expected or ()) - set(names))
                row = {
                    "way": way,
                    "split": split,
                    "expected": None if expected is None else len(expected),
                    "present": len(names),
                    "missing": None if expected is None else len(gaps),
                    **_amount(view, names, frames),
                    "missing_clips": gaps,
                }
                rows.append(row)
    if clips:  # a folder without clips has been reported already
        if not any(row["split"] == "train" and row["present"] for row in rows):
            message = "no clip of it is there, so nothing can be trained; get the missing clips"
            findings.error("no_training_clip", "split train", message)
        _report_missing(view, clips, findings)
        _compare_check_figure(view, rows, findings)
    return rows


def _amount(view: CorpusView, names: Iterable[str], frames: Mapping[str, int]) -> dict[str, Any]:
    total = sum(frames.get(name, 0) for name in names)
    return {"frames": total, "seconds": round(total / view.frame_rate, 3)}


def _report_missing(view: CorpusView, clips: Mapping[str, Clip], findings: Findings) -> None:
    lacking = False
    for split, names in view.expected.items():
        gaps = [name for name in names if name not in clips]
        if not gaps:
            continue
        message = f"{counted(len(gaps), 'clip')} of {number(len(names))} not there: {few(gaps)}"
        message += " (--json lists all)" if len(gaps) > FEW else ""
        incomplete = view.circulating is not None and view.circulating.incomplete
        if incomplete and len(gaps) <= NEVER_RECORDED * len(names):
            findings.note("clips_missing", f"split {split}", f"{message}; some were never recorded")
        else:
            lacking = True
            message = f"{message}; scores are comparable with published ones only if all are there"
            findings.warning("clips_missing", f"split {split}", message)
    if lacking and view.obtain:
        findings.note("obtain", view.corpus, view.obtain)


def _compare_check_figure(view: CorpusView, rows: Iterable[Mapping[str, Any]], findings: Findings) -> None:
    if view.circulating is None or view.circulating.counts is None:
        return
    split, *figure = view.circulating.counts

    def words(clips: int, frames: int) -> str:
        return f"{counted(clips, 'sequence')} and {counted(frames, 'frame')}"

    row = next((row for row in rows if row["split"] == split), {"present": 0, "frames": 0})
    where, counts, published = f"split {split}", words(row["present"], row["frames"]), words(*figure)
    if counts == published:
        message = f"agrees with the check figure of published work, {published}"
        findings.note("check_figure_agrees", where, message)
    else:
        message = (
            f"differs from the check figure of published work: {counts} instead of {published}; "
            f"scores on it are not comparable with published ones until clips are complete and cut alike"
        )
        findings.warning("check_figure_differs", where, message)


def _count_subjects(
    view: CorpusView, clips: Mapping[str, Clip], frames: Mapping[str, int], templates: Mapping[str, object]
) -> list[dict[str, Any]]:
    """One row for each subject that has clips or a template: those that are trained on first, in their order."""
    names_of: dict[str, list[str]] = {}
    for name, clip in clips.items():
        names_of.setdefault(clip.identity, []).append(name)
    untrained = sorted({*names_of, *templates} - set(view.identities))
    return [
        {
            "subject": subject,
            "trained_on": subject in view.identities,
            "clips": len(names_of.get(subject, [])),
            **_amount(view, names_of.get(subject, []), frames),
            "template": subject in templates,
        }
        for subject in [*view.identities, *untrained]
    ]
