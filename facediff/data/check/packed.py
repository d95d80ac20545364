"""Checking a packed corpus: every chunk of motion and every stream of speech is decoded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from facediff.data.check.clip import Array, ClipFacts, ClipFiles, Rules, check_vertices, compare_lengths
from facediff.data.check.report import Findings
from facediff.errors import FaceDiffError, MissingExtraError

if TYPE_CHECKING:
    from facediff.data.packed.reader import PackedCorpus


def check_packed(packed: PackedCorpus, n_vertices: int, templates: Mapping[str, Array], findings: Findings) -> None:
    """Compare the record with the recognised corpus, and the packed templates with ``templates.pkl``."""
    record = packed.record
    if record.n_vertices != n_vertices:
        message = f"was packed with {record.n_vertices} vertices, expected {n_vertices}; name the corpus with --corpus"
        findings.error("motion_shape", packed.source, message)
        return
    try:
        faces = packed.templates()
    except FaceDiffError as error:
        findings.error("templates_unreadable", "templates", str(error).removeprefix(f"{packed.source}/"))
        return
    for name, face in faces.items():
        if name in templates and not np.array_equal(face, templates[name]):
            message = f"the packed face of {name} is not that of templates.pkl; pack the corpus again"
            findings.error("template_differs", f"templates:{name}", message)
    kept = "lossless" if not record.tolerance else f"coordinates within {record.tolerance:g} mm"
    findings.note("packed", packed.source, f"is packed, {kept}; made by facediff {record.made_by}")


def examine_packed(rules: Rules, packed: PackedCorpus, clip: ClipFiles) -> ClipFacts:
    """Check one clip; every exception becomes a finding."""
    facts = ClipFacts(clip.name)
    findings, stored = facts.findings, packed.record.clips[clip.name]
    facts.n_vertices = packed.record.n_vertices
    if facts.n_vertices != rules.n_vertices:
        return facts
    facts.frames = stored.frames
    facts.sample_rate, facts.channels = stored.sound.rate, stored.sound.channels
    facts.seconds = stored.sound.samples / stored.sound.rate
    try:
        if not rules.quick:
            template = np.asarray(rules.templates.get(clip.subject, np.zeros((facts.n_vertices, 3))), np.float32)
            motion = packed.open(clip.name).offsets(range(stored.frames), template)
            if clip.subject in rules.templates:
                motion += template
                check_vertices(findings, motion, f"vertices_npy/{clip.name}.npy", clip.subject, rules.templates)
    except MissingExtraError:
        raise
    except Exception as error:  # one strange clip must not end the check of all others
        facts.frames = None
        findings.error("motion_unreadable", f"vertices_npy/{clip.name}.npy", str(error))
    try:
        if not rules.quick and not np.abs(packed.whole_speech(clip.name)).max(initial=0.0):
            message = "is silent throughout; get the recording again or remove the clip"
            findings.error("sound_silent", f"wav/{clip.name}.wav", message)
    except MissingExtraError:
        raise
    except Exception as error:
        facts.seconds = None
        findings.error("sound_unreadable", f"wav/{clip.name}.wav", str(error))
    if facts.frames is not None and facts.seconds is not None:
        compare_lengths(facts, rules.stored_frame_rate, facts.frames, facts.seconds)
    return facts
