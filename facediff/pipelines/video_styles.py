"""The style of a person from a video, as motion on the face of a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facediff.animation.styles import split_styles
from facediff.errors import needs_extra, note
from facediff.speech.audio import SAMPLE_RATE, VIDEOS

if TYPE_CHECKING:
    from facediff.animation import Animation


def with_video_styles(style: object, model: Callable[[], Any]) -> object:
    """A style with a file of motion, on the model's face, in place of each video of a person."""
    if isinstance(style, Mapping):
        return {_motion(str(name), model): weight for name, weight in style.items()}
    if not isinstance(style, str | Path) or not str(style):
        return style
    parts = split_styles(str(style))
    names = [_motion(part.name, model) for part in parts]
    if names == [part.name for part in parts]:
        return style
    weights = ["" if part.weight is None else f":{part.weight!r}" for part in parts]
    return ",".join(map("".join, zip(names, weights, strict=True)))


def _motion(name: str, model: Callable[[], Any]) -> str:
    """The file of motion in place of a video; other names stay."""
    return str(video_style(Path(name), model())) if Path(name).suffix.lower() in VIDEOS else name


def video_style(video: Path, model: Any) -> Path:  # noqa: ANN401 - an Animator, which imports this file
    """A file with the motion of a video's first clip on the face of a model; it is kept for the next time."""
    with needs_extra("torch", "prepare,render,onnx", "the style of a video"):
        from facediff.data.preparation import write_mesh
        from facediff.data.track.corpus import track_people
    from facediff.data.track.options import TrackingOptions
    from facediff.utils.arrays import ArrayStore
    from facediff.utils.checksums import sha256
    from facediff.utils.files import cache_dir, scratch_folder

    target = cache_dir() / "styles" / ArrayStore.key(sha256(video), model.corpus, model.n_vertices)
    target = target / f"{video.stem}.npz"
    if target.is_file():
        return target
    with scratch_folder(target) as scratch:
        people = scratch / "people"
        report = track_people({"style": [video]}, people, TrackingOptions(face="largest"), workers=1)
        for text in report.warnings:
            note(text)
        motion = first_clip(people)
        if model.n_vertices != len(motion.template):
            still = model.animate(np.zeros(SAMPLE_RATE, np.float32), SAMPLE_RATE, seed=0)
            face = scratch / "face.ply"
            write_mesh(face, still.template, still.triangles)
            motion = motion.retarget(face)
        motion.save(target)
    return target


def first_clip(root: Path) -> Animation:
    """The first clip of a corpus of people as an animation."""
    from facediff.animation import Animation
    from facediff.data import People
    from facediff.pipelines.trained import facts_of

    corpus = (data := People(root=str(root))).corpus
    clip = next(iter(corpus.clips.values()))
    template = corpus.template(clip)
    speech = corpus.read_audio(clip, 0, corpus.frames(clip)).numpy()
    facts = facts_of(data.assets(), clip.identity)
    return Animation(name=clip.name, vertices=(corpus.read_motion(clip) + template).numpy(), speech=speech, **facts)
