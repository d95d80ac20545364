"""Remarks that take all clips together: names, pairs of files, rates, copies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import TYPE_CHECKING

from facediff.doctor.clip import ClipFacts, is_about
from facediff.doctor.corpora import facexhubert_names
from facediff.doctor.findings import FEW, Finding, counted, few, number
from facediff.doctor.folder import Folder
from facediff.doctor.totals import strangers
from facediff.doctor.view import View

if TYPE_CHECKING:
    from facediff.data.corpus import Clip


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
    foreign = strangers(view, clips)
    if foreign:
        people = dict.fromkeys(clips[name].subject for name in foreign)
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
