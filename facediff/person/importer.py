"""From a reconstructed video to a corpus entry."""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.person.auxiliary import (
    RESIDUAL_LIMIT,
    Auxiliary,
    check_faces,
    into_coordinates,
    lay_onto_corpus,
    read_auxiliary,
    relative_residual,
)
from facediff.person.entry import EntryClip, check_output, whole_folder, write_entry
from facediff.person.frames import spans
from facediff.person.motion import Motion, read_motion, read_template
from facediff.person.report import Report
from facediff.person.stabilise import Stabilised, find_stable, middle_face, stabilise
from facediff.topology import Similarity, robust_align
from facediff.topology.rigid_motion import Indices, chunks

Array = npt.NDArray[np.float64]

MIN_SECONDS = 2.0
MIN_CLIP_SECONDS = 1.0
SILENCE = 1e-4
MISMATCH = 0.1
"""Sound and motion may differ in length by this share; more is an error."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9-]{0,63}")


def import_person(
    motion: Path,
    *,
    audio: Path,
    name: str,
    corpus: Path,
    output: Path,
    frame_rate: float,
    corpus_frame_rate: float | None = None,
    template: Path | None = None,
    stable: str | None = None,
    flame: Path | None = None,
    scale: float | None = None,
    clip_seconds: float = 8.0,
    progress: bool = False,
) -> Report:
    """Turn the reconstruction of one person's video into a corpus entry that fits an existing corpus.

    Args:
        motion: folder of .obj or .ply files, .npy of vertices, or FLAME parameters.
        audio: the video, or its sound.
        name: the person's name, without underscore.
        corpus: folder of the auxiliary corpus.
        output: folder to make.
        frame_rate: frames a second of the motion.
        corpus_frame_rate: frames a second of the corpus, where its manifest does not say.
        template: neutral face (.obj, .ply, .npy) in the motion's unit; found in the motion if None.
        stable: file with the vertices that move with the skull only; found in the motion if None.
        flame: FLAME model file, for FLAME parameters.
        scale: corpus units to a unit of the motion; measured if None.
        clip_seconds: length of the clips, about.
        progress: whether to show a progress bar.

    Returns:
        what was done.

    Raises:
        FaceDiffError: for anything that is wrong with the files or arguments; nothing is left behind then.
    """
    output = output.expanduser().absolute()
    _check_arguments(name, frame_rate, corpus_frame_rate, scale, clip_seconds)
    check_output(output)
    known = read_auxiliary(corpus, name=name, frame_rate=corpus_frame_rate)
    speech = _read_speech(audio)
    with whole_folder(output) as folder:
        scratch = folder / "scratch"
        scratch.mkdir()
        read = read_motion(
            motion,
            n_vertices=known.n_vertices,
            frame_rate=frame_rate,
            scratch=scratch / "read.npy",
            flame=flame,
            progress=progress,
        )
        warnings, mismatch = _check_lengths(audio, len(speech), motion, len(read.frames), frame_rate)
        chosen = _named(motion, lambda: find_stable(read, stable))
        face = _named(motion, lambda: middle_face(read, chosen))
        compared = check_faces(motion, read.faces, known)
        lay_onto_corpus(motion, face, known)  # before the long work
        made = _named(motion, lambda: stabilise(read, face, chosen, scratch / "stable.npy"))
        neutral = _neutral(read, made, template, known, speech, frame_rate)
        fit, residual = lay_onto_corpus(template or motion, neutral.face, known)
        place = into_coordinates(neutral.face, known, fit.scale, scale)
        frames = _placed(made, neutral.placing.then(place), scratch / "placed.npy")
        frames = _at_rate(frames, frame_rate, known.frame_rate, scratch / "rate.npy")
        clips, count = _cut(name, speech, len(frames), known.frame_rate, clip_seconds)
        report = Report(
            name=name,
            frames=len(read.frames),
            seconds=len(read.frames) / frame_rate,
            frame_rate=frame_rate,
            corpus_frame_rate=known.frame_rate,
            rotation_max=float(np.degrees(made.turns.max())),
            rotation_rms=float(np.degrees(_rms(made.turns))),
            translation_max=place.scale * float(made.shifts.max()),
            translation_rms=place.scale * _rms(made.shifts),
            stable_vertices=len(chosen),
            stable_source="found to move least" if stable is None else f"of {stable}",
            jitter=place.scale * made.jitter,
            scale=place.scale,
            measured_scale=fit.scale,
            topology_residual=residual,
            faces_compared=compared,
            template_source=neutral.source,
            template_frames=neutral.frames,
            mismatch=mismatch,
            clips=len(clips),
            splits=dict(Counter(clip.split for clip in clips)),
            frames_written=count,
            warnings=warnings,
            notes=read.notes,
        )
