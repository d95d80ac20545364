"""Counting: clips, frames and seconds by split and by subject, and what is missing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from facediff.doctor import facts
from facediff.doctor.findings import FEW, Finding, counted, few, number
from facediff.doctor.view import SPLITS, View

if TYPE_CHECKING:
    from facediff.data.corpus import Clip

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
        of.setdefault(clip.subject, []).append(name)
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


def strangers(view: View, clips: Mapping[str, Clip]) -> list[str]:
    """Clips of subjects that none of the corpus's splits knows."""
    known = set(view.identities)
    known |= {clip.subject for names in view.expected.values() for name in names if (clip := view.parse(name))}
    for clip in clips.values():
        if any(split_of(clip) is not None for split_of in view.split_of.values()):
            known.add(clip.subject)
    return [name for name, clip in clips.items() if clip.subject not in known]
