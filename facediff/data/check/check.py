"""Checking a corpus folder: contents, missing clips and defects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from facediff.data.check.clip import LENGTHS, ClipFiles, ClipInfo, Rules, examine, is_about
from facediff.data.check.findings import FEW, CheckReport, Findings, few
from facediff.data.check.layouts import (
    MANIFEST,
    SPLITS,
    STATE,
    CorpusFolder,
    CorpusView,
    identify,
    is_rate,
    list_folder,
    list_packed,
    manifest_in,
)
from facediff.data.check.packed import check_packed, examine_packed
from facediff.data.check.recordings import check_recordings, parametric_module, refuse_layout
from facediff.data.check.shared import (
    check_account,
    check_areas,
    check_ended,
    check_files,
    check_mesh,
    check_pairs,
    check_regions,
    check_templates,
)
from facediff.data.packed.stores import is_packed
from facediff.errors import FaceDiffError, counted, number
from facediff.utils.jobs import is_cluster, run_tasks
from facediff.utils.workers import WorkerDied, processors

if TYPE_CHECKING:
    from facediff.data.corpus import Clip, Corpus

WORTH_IT = 64 << 20
"""From so many bytes of motion on, starting processes pays."""
REFERENCES = "none"
"""The split of clips that give style references only."""


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
    packed = None
    if is_packed(root):
        from facediff.data.packed.reader import PackedCorpus

        packed = PackedCorpus(root)
    source: Path | str = Path(root).expanduser() if packed is None else packed.source
    root = Path(root).expanduser() if packed is None else packed.folder
    if not root.is_dir():
        raise FaceDiffError(f"{root}: no such folder; expected a corpus with wav/, vertices_npy/ and templates.pkl")
    from facediff.data.corpus import MOTION_FOLDERS

    report = CheckReport(source, quick)
    manifest = manifest_in(root, MANIFEST, report.findings)
    state = manifest_in(root, STATE, report.findings)
    refuse_layout(corpus)
    module = parametric_module(root, corpus, manifest) if packed is None else None
    if module is not None:
        check_recordings(report, root, module, corpus)
        report.sort()
        return report
    folder = list_folder(root, MOTION_FOLDERS) if packed is None else list_packed(packed)
    recorded = manifest.get("corpus", state.get("corpus") if packed is None else packed.record.corpus)
    view = identify(folder, recorded, corpus, manifest, report.findings)
    report.manifest = {
        "there": (root / MANIFEST).is_file(),
        "ended": check_ended(root, recorded if isinstance(recorded, str) else None, report.findings),
        "facediff": str(manifest["facediff"]) if "facediff" in manifest else None,
        "changed": [],
        "missing": [],
    }
    if view is not None:
        if packed is None:
            size = sum(path.stat().st_size for path in folder.motions.values() if path.is_file())
        else:
            size = sum(sum(array.shards) for array in packed.record.arrays.values())
        if not is_cluster(scheduler):
            workers = workers or (1 if quick or size <= WORTH_IT else processors())
        examine_all = partial(_examine_all, workers=workers, scheduler=scheduler, progress=progress)
        _check_corpus(report, view, folder, manifest, examine_all)
    report.sort()
    return report


def _check_corpus(
    report: CheckReport,
    view: CorpusView,
    folder: CorpusFolder,
    manifest: dict[str, Any],
    examine_all: Callable[[Rules, CorpusView, CorpusFolder], list[ClipInfo]],
) -> None:
    from facediff.data.corpus import Corpus

    root, findings = folder.root, report.findings
    report.corpus, report.data_module = view.corpus, view.data_module
    report.frame_rate, report.n_vertices = view.frame_rate, view.n_vertices
    opened: Corpus | None = None
    # Opening the folder would fail for these reasons again.
    if not any(finding.where == MANIFEST or finding.kind == "unfinished" for finding in findings):
        with findings.guard("frame_rate", root / MANIFEST, root):
            opened = Corpus(
                root,
                view.n_vertices,
                view.frame_rate,
                stored_frame_rate=view.stored_frame_rate,
                parse=view.parse,
                storage=folder.packed,
            )
    rate = manifest.get("frame_rate")
    stored = report.stored_frame_rate = rate if is_rate(rate) else view.stored_frame_rate
    templates, report.templates = check_templates(root, view, findings)
    faces, report.mesh = check_mesh(root, view, findings)
    if faces is not None:
        report.templates["areas"] = check_areas(view, manifest.get("unit"), templates, faces, findings)
    report.regions = check_regions(root, view, findings)
    if opened is not None:
        check_pairs(opened, findings)
    clips = _clips(opened, view, folder, findings)
    _check_names(view, folder, clips, findings)
    _check_both_files(view, folder, findings)
    if not clips:
        message = f"no clip of {view.corpus} with both wav/<clip>.wav and vertices_npy/<clip>.npy; put them there"
        findings.error("no_clip", "wav, vertices_npy", message)

    facts = examine_all(Rules(root, view.n_vertices, stored, templates, report.quick), view, folder)
    rate_fits = _check_frame_rate(view, stored, facts, findings, recorded="frame_rate" in manifest)
    for clip in facts:
        # Where the frame rate is wrong, every clip has the wrong length: one finding is enough.
        findings += [finding for finding in clip.findings if rate_fits or finding.kind not in LENGTHS]
    _check_vertex_counts(facts, findings)
    _check_sound_forms(facts, findings)
    _check_copies(facts, findings)
    if report.templates["file"]:
        _check_subjects(clips, {*templates, *report.templates["broken"]}, findings)
    if folder.packed is not None:
        check_packed(folder.packed, view.n_vertices, templates, findings)
        files = manifest.get("files")
        if isinstance(files, dict):  # of which motion and speech are no files any more
            manifest = {
                **manifest,
                "files": {name: files[name] for name in files if name in folder.packed.record.files},
            }
    hashes = {where: digest for clip in facts for where, digest in clip.hashes.items()}
    report.manifest |= check_files(root, manifest, hashes, findings, quick=report.quick)
    check_account(manifest, findings)
    stride = max(1, round(stored / view.frame_rate))
    frames = {clip.name: -(-clip.frames // stride) for clip in facts if clip.frames is not None}
    report.splits = _count_splits(view, clips, frames, findings)
    report.subjects = _count_subjects(view, clips, frames, templates)


def _clips(opened: Corpus | None, view: CorpusView, folder: CorpusFolder, findings: Findings) -> dict[str, Clip]:
    """The clips that training would read; by their names alone if the folder cannot be opened."""
    names = [name for name in folder.names if name in folder.motions and name in folder.sounds]
    clips = {name: clip for name in names if (clip := view.parse(name)) is not None}
    if opened is not None and clips:
        with findings.guard("clips_table", folder.root / "clips.csv", folder.root):
            read = opened.clips
            clips = {name: read.get(name, clip) for name, clip in clips.items()}
            from facediff.data.corpus import read_clip_table

            if unknown := sorted(set(read_clip_table(folder.root)) - set(folder.names)):
                message = f"has rows of clips that are not here: {few(unknown)}; a misspelt name loses its attributes"
                findings.note("clips_table", "clips.csv", message)
    return clips


def _examine_all(
    rules: Rules, view: CorpusView, folder: CorpusFolder, *, workers: int | None, scheduler: str | None, progress: bool
) -> list[ClipInfo]:
    tasks = [
        ClipFiles(name, clip.identity, folder.motions.get(name), folder.sounds.get(name))
        for name in folder.names
        if (clip := view.parse(name)) is not None
    ]
    examined: dict[str, ClipInfo] = {}
    work: Any = partial(examine, rules) if folder.packed is None else partial(examine_packed, rules, folder.packed)
    results = run_tasks(
        work,
        tasks,
        workers=workers,
        scheduler=scheduler,
        reads=[folder.root] if folder.packed is None else folder.packed.folders,
        progress="clips" if progress else "",
    )
    with closing(results):
        for task, facts in results:
            if isinstance(facts, WorkerDied):
                facts = ClipInfo(task.name)
                message = "killed the process that read it: badly damaged, or too little memory; get its files again"
                facts.findings.error("clip_unreadable", task.name, message)
            examined[task.name] = facts
    return [examined[task.name] for task in tasks]


# Findings about names and pairs of files.


def _check_names(view: CorpusView, folder: CorpusFolder, clips: Mapping[str, Clip], findings: Findings) -> None:
    """Report names not of the corpus's form, subjects in no split, and files that are not read."""
    unknown = [name for name in folder.names if view.parse(name) is None]
    if unknown:
        message = f"{counted(len(unknown), 'name')} not of {view.corpus}'s form, so not read: {few(unknown)}"
        findings.warning("unknown_name", "wav, vertices_npy", message)
    if foreign := _without_split(view, clips):
        subjects = dict.fromkeys(clips[name].identity for name in foreign)
        message = (
            f"{counted(len(foreign), 'clip')} of subjects in no split of {view.corpus} ({few(subjects)}), so "
            f"not trained or scored on: {few(foreign)}"
        )
        findings.warning("unknown_subject", "wav, vertices_npy", message)
    if folder.leftovers:
        message = f"{counted(len(folder.leftovers), 'file')} half-written by a program that was stopped; remove them"
        findings.warning("leftover", folder.leftovers[0], message)


def _without_split(view: CorpusView, clips: Mapping[str, Clip]) -> list[str]:
    """Clips of subjects that are in none of the corpus's splits."""
    identities = set(view.identities)
    identities |= {clip.identity for names in view.expected.values() for name in names if (clip := view.parse(name))}
    for clip in clips.values():
        if any(split_of(clip) is not None for split_of in view.split_of.values()):
            identities.add(clip.identity)
    return [name for name, clip in clips.items() if clip.identity not in identities]


def _check_both_files(view: CorpusView, folder: CorpusFolder, findings: Findings) -> None:
    for files, partners, fault, kind in (
        (folder.sounds, folder.motions, "speech without motion", "motion_missing"),
        (folder.motions, folder.sounds, "motion without speech", "sound_missing"),
    ):
        for name in sorted(name for name in files if name not in partners and view.parse(name) is not None):
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


# Findings about all clips together: topology, form of the speech, frame rate, copies.


def _check_vertex_counts(facts: Iterable[ClipInfo], findings: Findings) -> None:
    counts = Counter(clip.n_vertices for clip in facts if clip.n_vertices is not None)
    if len(counts) > 1:
        numbers = ", ".join(f"{number(count)} ({counted(clips, 'clip')})" for count, clips in counts.most_common())
        message = f"motions of several topologies are mixed: vertices {numbers}; keep one corpus to a folder"
        findings.error("mixed_vertex_counts", "vertices_npy", message)


def _check_sound_forms(facts: Iterable[ClipInfo], findings: Findings) -> None:
    forms = Counter((clip.sample_rate, clip.channels) for clip in facts if clip.sample_rate is not None)
    for (rate, channels), count in forms.most_common():
        if (rate, channels) != (16_000, 1):
            form = f"{number(rate or 0)} Hz, {counted(channels or 0, 'channel')}"
            message = f"{counted(count, 'file')} with {form}; read as 16 000 Hz mono, decoded once, then cached"
            findings.note("sound_form", "wav", message)


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
        same = f"holds the same bytes as {', '.join(copies[:FEW])}{' …' if len(copies) > FEW else ''}: one of them"
        if copies and where.endswith(".npy"):
            message = f"{same} is a copy under a wrong name; get it again or remove it"
            findings.error("motion_copied", where, message)
        elif copies:
            message = f"{same} may have a wrong name; compare it with its source"
            findings.warning("sound_copied", where, message)


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
