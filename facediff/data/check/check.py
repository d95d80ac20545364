"""The doctor: what a corpus folder is, what is there, what is missing and what is wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from facediff.data.check import findings as facts
from facediff.data.check.clip import LENGTHS, Array, ClipFacts, ClipFiles, Rules, examine, is_about
from facediff.data.check.findings import FEW, Finding, Report, by_severity, counted, few, guarded, number
from facediff.data.check.layouts import (
    MANIFEST,
    SPLITS,
    STATE,
    Folder,
    View,
    check_account,
    check_ended,
    check_files,
    facexhubert_names,
    identify,
    is_rate,
    list_folder,
    read_record,
)
from facediff.data.check.templates import check_areas, check_mesh, check_pairs, check_regions, check_templates
from facediff.errors import FaceDiffError, MissingExtraError
from facediff.utils.jobs import WorkerDied, processors, run_tasks

if TYPE_CHECKING:
    from facediff.data.corpus import Clip, Corpus


# Counting: clips, frames and seconds by split and by subject, and what is missing.

REFERENCES = "none"
"""The split of clips that give style references only."""


def count_splits(
    view: View, clips: Mapping[str, Clip], frames: Mapping[str, int], findings: list[Finding]
) -> list[dict[str, Any]]:
    """One row for each split of each of the ways in which a corpus is split.

    Args:
        view: the corpus.
        clips: the clips that training reads, by name.
        frames: their frames at the frame rate that models see; those that cannot be read are left out.
        findings: what is missing is added here.
    """
    rows: list[dict[str, Any]] = []
    for way, split_of in view.split_of.items():
        members: dict[str, list[str]] = {split: [] for split in (*SPLITS, REFERENCES)}
        for name, clip in clips.items():
            members.setdefault(split_of(clip) or REFERENCES, []).append(name)
        for split, names in members.items():
            wanted = view.expected.get(split)
            if not names and not wanted:
                continue
            rows.append(_row(way, split, names, wanted, frames, view.frame_rate))
    if clips:  # a folder without clips has been told of already
        if not any(row["split"] == "train" and row["present"] for row in rows):
            message = "no clip of it is there, so nothing can be trained; get the missing clips"
            findings.append(Finding("error", "no_training_clip", "split train", message))
        _tell_missing(view, clips, findings)
        _tell_check_figure(view, rows, findings)
    return rows


def _row(
    way: str | None, split: str, names: list[str], wanted: list[str] | None, frames: Mapping[str, int], rate: float
) -> dict[str, Any]:
    total = sum(frames.get(name, 0) for name in names)
    lacking = sorted(set(wanted or ()) - set(names))
    return {
        "way": way,
        "split": split,
        "expected": None if wanted is None else len(wanted),
        "present": len(names),
        "missing": None if wanted is None else len(lacking),
        "frames": total,
        "seconds": round(total / rate, 3),
        "missing_clips": lacking,
    }


def _tell_missing(view: View, clips: Mapping[str, Clip], findings: list[Finding]) -> None:
    lacks = False
    for split, names in view.expected.items():
        missing = [name for name in names if name not in clips]
        if not missing:
            continue
        told = f"{counted(len(missing), 'clip')} of {number(len(names))} not there: {few(missing)}"
        told += " (--json lists all)" if len(missing) > FEW else ""
        where = f"split {split}"
        if view.corpus in facts.INCOMPLETE and len(missing) <= facts.NEVER_RECORDED * len(names):
            findings.append(Finding("note", "clips_missing", where, f"{told}; some were never recorded"))
        else:
            lacks = True
            message = f"{told}; scores go with published ones only if all are there"
            findings.append(Finding("warning", "clips_missing", where, message))
    if lacks and view.obtain:
        findings.append(Finding("note", "obtain", view.corpus, view.obtain))


def _tell_check_figure(view: View, rows: Iterable[Mapping[str, Any]], findings: list[Finding]) -> None:
    figure = facts.CHECK_FIGURES.get(view.corpus)
    if figure is None:
        return
    row = next((row for row in rows if row["split"] == figure.split), {"present": 0, "frames": 0})
    published = f"{counted(figure.clips, 'sequence')} and {counted(figure.frames, 'frame')}"
    where = f"split {figure.split}"
    if (row["present"], row["frames"]) == (figure.clips, figure.frames):
        message = f"agrees with the check figure of published work, {published}"
        findings.append(Finding("note", "check_figure_agrees", where, message))
    else:
        found = f"{counted(row['present'], 'sequence')} and {counted(row['frames'], 'frame')}"
        message = (
            f"differs from the check figure of published work: {found} instead of {published}; scores on it cannot be "
            f"held against published ones until clips are complete and cut alike"
        )
        findings.append(Finding("warning", "check_figure_differs", where, message))


def count_subjects(
    view: View, clips: Mapping[str, Clip], frames: Mapping[str, int], templates: Iterable[str]
) -> list[dict[str, Any]]:
    """One row for each subject that has clips or a template: those that are trained on first, in their order."""
    have = set(templates)
    of: dict[str, list[str]] = {}
    for name, clip in clips.items():
        of.setdefault(clip.identity, []).append(name)
    everybody = [*view.identities, *sorted({*of, *have} - set(view.identities))]
    return [
        {
            "subject": subject,
            "trained_on": subject in view.identities,
            "clips": len(of.get(subject, [])),
            "frames": sum(frames.get(name, 0) for name in of.get(subject, [])),
            "seconds": round(sum(frames.get(name, 0) for name in of.get(subject, [])) / view.frame_rate, 3),
            "template": subject in have,
        }
        for subject in everybody
    ]


def unseen(view: View, clips: Mapping[str, Clip]) -> list[str]:
    """Clips of subjects that none of the corpus's splits knows."""
    known = set(view.identities)
    known |= {clip.identity for names in view.expected.values() for name in names if (clip := view.parse(name))}
    for clip in clips.values():
        if any(split_of(clip) is not None for split_of in view.split_of.values()):
            known.add(clip.identity)
    return [name for name, clip in clips.items() if clip.identity not in known]


# Remarks that take all clips together: names, pairs of files, rates, copies.


def check_names(view: View, folder: Folder, clips: Mapping[str, Clip], findings: list[Finding]) -> None:
    """Names that are none of the corpus's, subjects that no split knows, files that nobody reads."""
    odd = [name for name in folder.names if view.parse(name) is None]
    hubert = facexhubert_names(odd) if view.corpus == "biwi" else []
    if hubert:
        message = (
            f"{counted(len(hubert), 'clip')} with names in the manner of FaceXHuBERT ({few(hubert)}): NN is a neutral "
            f"sequence and NN + 40 the emotional eNN, and its vertices are scaled axis by axis. Renaming would not "
            f"make them comparable; prepare the folder anew from the raw files (`facediff data prepare biwi RAW OUT`)"
        )
        findings.append(Finding("error", "facexhubert_names", "vertices_npy", message))
    unknown = [name for name in odd if name not in set(hubert)]
    if unknown:
        message = f"{counted(len(unknown), 'name')} not of {view.corpus}'s form, so not read: {few(unknown)}"
        findings.append(Finding("warning", "unknown_name", "wav, vertices_npy", message))
    foreign = unseen(view, clips)
    if foreign:
        people = dict.fromkeys(clips[name].identity for name in foreign)
        message = (
            f"{counted(len(foreign), 'clip')} of subjects that no split of {view.corpus} knows ({few(people)}), so not "
            f"trained or scored on: {few(foreign)}"
        )
        findings.append(Finding("warning", "unknown_subject", "wav, vertices_npy", message))
    if folder.leftovers:
        message = f"{counted(len(folder.leftovers), 'file')} half-written by a program that was stopped; remove them"
        findings.append(Finding("warning", "leftover", folder.leftovers[0], message))
    if folder.strays:
        message = (
            f"{counted(len(folder.strays), 'file')} that nobody reads (expected .wav and .npy): {few(folder.strays)}"
        )
        findings.append(Finding("note", "stray_file", folder.strays[0], message))


def check_pairs_of_files(view: View, folder: Folder, findings: list[Finding]) -> None:
    """Speech without motion and motion without speech."""
    for files, others, what, kind in (
        (folder.sounds, folder.motions, "speech without motion", "motion_missing"),
        (folder.motions, folder.sounds, "motion without speech", "sound_missing"),
    ):
        alone = [name for name in files if name not in others and view.parse(name) is not None]
        findings.extend(
            Finding("warning", kind, name, f"{what}, so not used; get the other file or remove this one")
            for name in sorted(alone)
        )


def check_vertex_counts(facts: Iterable[ClipFacts], findings: list[Finding]) -> None:
    """Motions of several topologies in one folder."""
    counts = Counter(clip.n_vertices for clip in facts if clip.n_vertices is not None)
    if len(counts) > 1:
        told = ", ".join(f"{number(count)} ({counted(clips, 'clip')})" for count, clips in counts.most_common())
        message = f"motions of several topologies are mixed: vertices {told}; keep one corpus to a folder"
        findings.append(Finding("error", "mixed_vertex_counts", "vertices_npy", message))


def check_sounds(facts: Iterable[ClipFacts], findings: list[Finding]) -> None:
    """Say how the speech is stored where that is not how the models hear it."""
    forms = Counter((clip.sample_rate, clip.channels) for clip in facts if clip.sample_rate is not None)
    for (rate, channels), count in forms.most_common():
        if (rate, channels) != (16_000, 1):
            form = f"{number(rate or 0)} Hz, {counted(channels or 0, 'channel')}"
            message = f"{counted(count, 'file')} with {form}; heard as 16 000 Hz mono, decoded once, then cached"
            findings.append(Finding("note", "sound_form", "wav", message))


def check_frame_rate(
    view: View, stored: float, facts: Sequence[ClipFacts], findings: list[Finding], *, recorded: bool
) -> bool:
    """Whether the lengths of the speech agree with the frame rate; if most clips say another, tell that once.

    Args:
        view: the corpus.
        stored: motion frames a second on disk, as they are read.
        facts: what the clips hold.
        findings: what is wrong is added here.
        recorded: whether ``manifest.json`` says the frame rate.
    """
    rates = [clip.frames / clip.seconds for clip in facts if clip.frames is not None and clip.seconds]
    if not rates:
        return True
    found = median(rates)
    other = next((factor * stored for factor in (2.0, 0.5) if is_about(found, factor * stored)), None)
    if other is None:
        return True
    multiple = other / view.frame_rate
    remedy = (
        f'write {{"frame_rate": {other:g}}} into manifest.json'
        if multiple >= 1 and multiple == round(multiple)
        else "prepare it anew"
    )
    said = "manifest.json says" if recorded else f"copies of {view.corpus} have"
    message = (
        f"there are about {other:g} motion frames for each second of speech, but {said} {stored:g}: motion would run "
        f"at {stored / other:g} times its speed; {remedy}"
    )
    findings.append(Finding("error", "frame_rate", "vertices_npy", message))
    return False


def check_copies(facts: Iterable[ClipFacts], findings: list[Finding]) -> None:
    """Files with the same content under several names."""
    names: dict[str, list[str]] = {}
    for clip in facts:
        for where, digest in clip.hashes.items():
            names.setdefault(f"{digest}{where[-4:]}", []).append(where)
    for where, *others in names.values():
        if not others:
            continue
        told = ", ".join(others[:FEW]) + (" …" if len(others) > FEW else "")
        if where.endswith(".npy"):
            message = (
                f"holds the same bytes as {told}: one of them is a copy under a wrong name; get it anew or remove it"
            )
            findings.append(Finding("error", "motion_copied", where, message))
        else:
            message = f"holds the same bytes as {told}: one of them may bear a wrong name; compare it with its source"
            findings.append(Finding("warning", "sound_copied", where, message))


WORTH_IT = 64 << 20
"""Bytes of motion from which on starting processes pays."""


def check(
    root: Path | str,
    corpus: str | None = None,
    *,
    split: str | None = None,
    quick: bool = False,
    workers: int | None = None,
    progress: bool = False,
) -> Report:
    """Look at a corpus folder; nothing in it is changed, trusted or run.

    Args:
        root: the folder.
        corpus: name of the corpus (``biwi``), or import path of its data module; found out by itself if None.
        split: only the totals of this way to split the corpus (3DMEAD: ``sentence``, ``identity``).
        quick: read headers only: no NaN, no comparison with templates, no copies; files are compared by size.
        workers: processes; if None, as many as processors where there is much to read.
        progress: show a progress bar on standard error.

    Raises:
        FaceDiffError: if there is no such folder, corpus or split. What is wrong in the folder is in the report.
        MissingExtraError: if soundfile or trimesh is not installed.
    """
    root = Path(root).expanduser()
    if not root.is_dir():
        raise FaceDiffError(f"{root}: no such folder; expected a corpus with wav/, vertices_npy/ and templates.pkl")
    if workers is not None and workers < 1:
        raise FaceDiffError(f"--workers: is {workers}; expected 1 or more")
    from facediff.data.corpus import MOTION_FOLDERS

    report = Report(root, quick)
    findings = report.findings
    manifest = read_record(root, MANIFEST, findings)
    state = read_record(root, STATE, findings)
    folder = list_folder(root, MOTION_FOLDERS)
    said = manifest.get("corpus", state.get("corpus"))
    view = identify(report, folder, said, corpus, split, manifest)
    report.manifest = {
        "there": (root / MANIFEST).is_file(),
        "ended": check_ended(root, said if isinstance(said, str) else None, findings),
        "facediff": str(manifest["facediff"]) if "facediff" in manifest else None,
        "changed": [],
        "missing": [],
    }
    if view is not None:
        processes = workers or _workers(folder, quick=quick)
        _check_corpus(report, view, folder, manifest, partial(_examine_all, workers=processes, progress=progress))
    report.findings = by_severity(findings)
    return report


def _check_corpus(
    report: Report,
    view: View,
    folder: Folder,
    manifest: dict[str, Any],
    examine_all: Callable[[Rules, View, Folder], list[ClipFacts]],
) -> None:
    root, findings = folder.root, report.findings
    report.corpus, report.data_module = view.corpus, view.data_module
    report.frame_rate, report.n_vertices = view.frame_rate, view.n_vertices
    opened: Corpus | None = None
    # Whoever opens the folder stumbles over these again.
    if not any(found.where == MANIFEST or found.kind == "unfinished" for found in findings):
        with guarded(findings, "frame_rate", root / MANIFEST, root):
            opened = view.open(root)
    stored = _stored_rate(manifest, view)
    report.stored_frame_rate = stored
    templates, report.templates = check_templates(root, view, findings)
    faces, report.mesh = check_mesh(root, view, findings)
    if faces is not None:
        report.templates["areas"] = check_areas(view, manifest.get("unit"), templates, faces, findings)
    report.regions = check_regions(root, view, findings)
    if opened is not None:
        check_pairs(opened, findings)
    clips = _clips(opened, view, folder, findings)
    check_names(view, folder, clips, findings)
    check_pairs_of_files(view, folder, findings)
    if not clips and not any(finding.kind == "facexhubert_names" for finding in findings):
        message = f"no clip of {view.corpus} with both wav/<clip>.wav and vertices_npy/<clip>.npy; put them there"
        findings.append(Finding("error", "no_clip", "wav, vertices_npy", message))
    facts = examine_all(Rules(root, view.n_vertices, stored, templates, report.quick), view, folder)
    _tell_clips(view, stored, facts, findings, recorded="frame_rate" in manifest)
    _tell_subjects(clips, templates, report, findings)
    hashes = {where: digest for clip in facts for where, digest in clip.hashes.items()}
    report.manifest |= check_files(root, manifest, hashes, findings, quick=report.quick)
    check_account(manifest, findings)
    stride = max(1, round(stored / view.frame_rate))
    frames = {clip.name: -(-clip.frames // stride) for clip in facts if clip.frames is not None}
    report.splits = count_splits(view, clips, frames, findings)
    report.subjects = count_subjects(view, clips, frames, templates)


def _stored_rate(manifest: dict[str, Any], view: View) -> float:
    said = manifest.get("frame_rate")
    return said if is_rate(said) else view.stored_frame_rate


def _clips(opened: Corpus | None, view: View, folder: Folder, findings: list[Finding]) -> dict[str, Clip]:
    """The clips that training would read; by their names alone if the folder cannot be opened."""
    names = [name for name in folder.names if name in folder.motions and name in folder.sounds]
    plain = {name: clip for name in names if (clip := view.parse(name)) is not None}
    if opened is None or not plain:
        return plain
    with guarded(findings, "clips_table", folder.root / "clips.csv", folder.root):
        read = opened.clips
        plain = {name: read.get(name, clip) for name, clip in plain.items()}
    return plain


def _examine_all(rules: Rules, view: View, folder: Folder, *, workers: int, progress: bool) -> list[ClipFacts]:
    try:
        import soundfile  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("soundfile", "audio", "checking speech") from error
    tasks = [
        ClipFiles(name, clip.identity, folder.motions.get(name), folder.sounds.get(name))
        for name in folder.names
        if (clip := view.parse(name)) is not None
    ]
    done: dict[str, ClipFacts] = {}
    results = run_tasks(partial(examine, rules), tasks, workers=workers, progress="clips" if progress else "")
    with closing(results):
        for task, result in results:
            if isinstance(result, WorkerDied):
                message = "killed the process that read it: badly damaged, or memory is short; get its files anew"
                result = ClipFacts(task.name, findings=[Finding("error", "clip_unreadable", task.name, message)])
            done[task.name] = result
    return [done[task.name] for task in tasks]


def _tell_clips(view: View, stored: float, facts: list[ClipFacts], findings: list[Finding], *, recorded: bool) -> None:
    right = check_frame_rate(view, stored, facts, findings, recorded=recorded)
    for clip in facts:
        # Where the frame rate is wrong, every clip has the wrong length: once is enough.
        findings += [finding for finding in clip.findings if right or finding.kind not in LENGTHS]
    check_vertex_counts(facts, findings)
    check_sounds(facts, findings)
    check_copies(facts, findings)


def _tell_subjects(
    clips: dict[str, Clip], templates: dict[str, Array], report: Report, findings: list[Finding]
) -> None:
    lacking: dict[str, list[str]] = {}
    for name, clip in clips.items():
        if report.templates["file"] and clip.identity not in {*templates, *report.templates["broken"]}:
            lacking.setdefault(clip.identity, []).append(name)
    for subject, names in lacking.items():
        message = f"no template of {subject}, needed by {counted(len(names), 'clip')} ({few(names)}); get the file anew"
        findings.append(Finding("error", "template_missing", "templates.pkl", message))


def _workers(folder: Folder, *, quick: bool) -> int:
    if quick:
        return 1
    size = 0
    for path in folder.motions.values():
        size += path.stat().st_size if path.is_file() else 0
    return processors() if size > WORTH_IT else 1
