"""Checking a packed corpus: every chunk of motion and every stream of speech is decoded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facediff.data.check.clip import Array, ClipFiles, ClipInfo, Rules, check_vertices, compare_lengths
from facediff.data.check.findings import Findings

if TYPE_CHECKING:
    from facediff.data.packed.reader import PackedCorpus


def check_packed(packed: PackedCorpus, n_vertices: int, templates: Mapping[str, Array], findings: Findings) -> None:
    """Compare the record with the recognised corpus, and the packed templates with ``templates.pkl``."""
    record = packed.record
    if record.n_vertices != n_vertices:
        message = f"was packed with {record.n_vertices} vertices, expected {n_vertices}; name the corpus with --corpus"
        findings.error("motion_shape", packed.source, message)
        return
    with findings.guard("templates_unreadable", Path("templates"), Path(packed.source)):
        for name, face in packed.templates().items():
            if name in templates and not np.array_equal(face, templates[name]):
                message = f"the packed face of {name} differs from templates.pkl; pack the corpus again"
                findings.error("template_differs", f"templates:{name}", message)
        quality = "lossless" if not record.tolerance else f"coordinates within {record.tolerance:g} mm"
        findings.note("packed", packed.source, f"is packed, {quality}; made by facediff {record.made_by}")


def examine_packed(rules: Rules, packed: PackedCorpus, clip: ClipFiles) -> ClipInfo:
    """Check one clip; every exception becomes a finding."""
    info = ClipInfo(clip.name)
    findings, stored = info.findings, packed.record.clips[clip.name]
    info.n_vertices = packed.record.n_vertices
    if info.n_vertices != rules.n_vertices:
        return info
    info.sample_rate, info.channels = stored.sound.rate, stored.sound.channels
    motion_path, sound_path = Path(f"vertices_npy/{clip.name}.npy"), Path(f"wav/{clip.name}.wav")
    with findings.guard("motion_unreadable", motion_path, rules.root):
        if not rules.quick:
            template = np.asarray(rules.templates.get(clip.subject, np.zeros((info.n_vertices, 3))), np.float32)
            motion = packed.open(clip.name).offsets(range(stored.frames), template)
            if clip.subject in rules.templates:
                check_vertices(findings, motion + template, str(motion_path), clip.subject, rules.templates)
        info.frames = stored.frames
    with findings.guard("sound_unreadable", sound_path, rules.root):
        if not rules.quick and not np.abs(packed.whole_speech(clip.name)).max(initial=0.0):
            message = "is silent throughout; get the recording again or remove the clip"
            findings.error("sound_silent", str(sound_path), message)
        info.seconds = stored.sound.samples / stored.sound.rate
    if info.frames is not None and info.seconds is not None:
        compare_lengths(info, rules.stored_frame_rate, info.frames, info.seconds)
    return info
