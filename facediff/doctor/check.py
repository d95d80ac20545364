"""The doctor: what a corpus folder is, what is there, what is missing and what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.doctor import corpus as together
from facediff.doctor.clip import LENGTHS, ClipFacts, ClipFiles, Rules, examine
from facediff.doctor.findings import Finding, by_severity, counted, few, guarded
from facediff.doctor.folder import Folder, list_folder
from facediff.doctor.identify import identify
from facediff.doctor.manifest import MANIFEST, STATE, check_account, check_ended, check_files, read_record
from facediff.doctor.motion import Array
from facediff.doctor.pool import Died, run_all, steps
from facediff.doctor.report import Report
from facediff.doctor.templates import check_areas, check_templates
from facediff.doctor.topology import check_mesh, check_pairs, check_regions
from facediff.doctor.totals import count_splits, count_subjects
from facediff.doctor.view import View, is_rate
from facediff.errors import FaceDiffError, MissingExtraError
from facediff.machine import processors

if TYPE_CHECKING:
    from facediff.data.corpus import Clip, Corpus

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
    together.check_names(view, folder, clips, findings)
    together.check_pairs_of_files(view, folder, findings)
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
        ClipFiles(name, clip.subject, folder.motions.get(name), folder.sounds.get(name))
        for name in folder.names
        if (clip := view.parse(name)) is not None
    ]
    done: dict[str, ClipFacts] = {}
    with steps(len(tasks), shown=progress) as step:
        for task, result in run_all(partial(examine, rules), tasks, workers):
            if isinstance(result, Died):
                message = "killed the process that read it: badly damaged, or memory is short; get its files anew"
                result = ClipFacts(task.name, findings=[Finding("error", "clip_unreadable", task.name, message)])
            done[task.name] = result
            step()
    return [done[task.name] for task in tasks]


def _tell_clips(view: View, stored: float, facts: list[ClipFacts], findings: list[Finding], *, recorded: bool) -> None:
    right = together.check_frame_rate(view, stored, facts, findings, recorded=recorded)
    for clip in facts:
        # Where the frame rate is wrong, every clip has the wrong length: once is enough.
        findings += [finding for finding in clip.findings if right or finding.kind not in LENGTHS]
    together.check_vertex_counts(facts, findings)
    together.check_sounds(facts, findings)
    together.check_copies(facts, findings)


def _tell_subjects(
    clips: dict[str, Clip], templates: dict[str, Array], report: Report, findings: list[Finding]
) -> None:
    lacking: dict[str, list[str]] = {}
    for name, clip in clips.items():
        if report.templates["file"] and clip.subject not in {*templates, *report.templates["broken"]}:
            lacking.setdefault(clip.subject, []).append(name)
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
