"""Checking folders of recordings in parameters: order, version, rate, and channels that are dead or out of range."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facediff import registry
from facediff.data.check.findings import CheckReport, few, relative
from facediff.errors import FaceDiffError
from facediff.spaces.layouts import LAYOUTS
from facediff.spaces.operations import FLOOR

if TYPE_CHECKING:
    from facediff.data.parametric import ParametricDataModule
    from facediff.data.recordings import RecordingFolder

SOUND_DIFFERS = 0.5
"""Seconds by which sound and motion may differ in length without a warning."""


def parametric_module(root: Path, corpus: str | None, manifest: dict[str, Any]) -> type[ParametricDataModule] | None:
    """The data module of a folder of recordings; None for a corpus of vertices.

    Args:
        root: the folder.
        corpus: name of the corpus that the user gave, for arrays with their layout: ``flame_clips:flame_artalk``.
        manifest: of the folder.
    """
    from facediff.data.parametric import ParametricDataModule

    entries = [entry.implementation for entry in registry.corpus]
    modules: list[type[ParametricDataModule]] = [m for m in entries if issubclass(m, ParametricDataModule)]
    if name := (corpus or "").partition(":")[0].lower() or str(manifest.get("layout", "")):
        return next((module for module in modules if name in (module.corpus_name, module.__name__.lower())), None)
    if any((root / folder).is_dir() for folder in ("vertices_npy", "vertex", "weights_npy", "values_npy")):
        return None
    modules_by_channels = (module for module in modules if module.names_channels)
    return next((module for module in modules_by_channels if module.speakers_in(root)), None)


def _folder(module: type[ParametricDataModule], root: Path, layout: str | None) -> RecordingFolder:
    from facediff.data.recordings import RecordingFolder

    space = LAYOUTS[layout].space if layout else getattr(module, "space", LAYOUTS["arkit"].space)
    return RecordingFolder(root, space, module.frame_rate, suffixes=module.suffixes, layout=layout)


def check_recordings(report: CheckReport, root: Path, module: type[ParametricDataModule], corpus: str | None) -> None:
    """Add the contents and the defects of a folder of recordings to a report."""
    from facediff.speech.audio import SAMPLE_RATE, read_speech

    layout = (corpus or "").partition(":")[2] or None
    folder, findings = _folder(module, root, layout), report.findings
    report.corpus, report.data_module = module.corpus_name, f"{module.__module__}.{module.__name__}"
    report.frame_rate, report.points = module.frame_rate, "channels"
    names = folder.names()
    if not names:
        findings.error(
            "no_clip", str(root), f"no {' or '.join(module.suffixes)} with a .wav of its name; put them there"
        )
    low = high = deviation = None
    orders: Counter[str] = Counter()
    rates: Counter[float] = Counter()
    subjects: dict[str, list[float]] = {}
    channels: tuple[str, ...] = ()
    for name in names:
        clip_file = folder.path_of(name)
        with findings.guard("clip_unreadable", clip_file, root):
            clip = folder.recording(name)
            where = relative(clip_file, root)
            if channels and clip.space.channels != channels:
                findings.error("other_channels", where, "has other channels than the recordings before it")
                continue
            channels = clip.space.channels
            report.n_vertices = len(channels)
            without = f", without {few(clip.space.absent)}" if clip.space.absent else ""
            version = f" {clip.space.version}" if clip.space.version else ""
            orders[f"{clip.layout or clip.space.kind}{version}: {len(channels)} channels{without}"] += 1
            rates[clip.frame_rate] += 1
            for note in clip.notes:
                findings.warning("remark", where, note)
            minimum, maximum, std = (of(axis=0) for of in (clip.values.min, clip.values.max, clip.values.std))
            low = minimum if low is None else np.minimum(low, minimum)
            high = maximum if high is None else np.maximum(high, maximum)
            deviation = std if deviation is None else np.maximum(deviation, std)
            seconds = len(read_speech(folder.files[name][1])) / SAMPLE_RATE
            if abs(seconds - clip.duration) > SOUND_DIFFERS:
                findings.warning(
                    "length",
                    where,
                    f"lasts {clip.duration:.2f} s and its sound {seconds:.2f} s; cut both to one stretch",
                )
            speaker = module.parse_name(name)
            if speaker is None:
                findings.note("name", where, "is not named as recordings of this corpus are, and is not read")
            else:
                subjects.setdefault(speaker.identity, []).append(clip.duration)
    report.stored_frame_rate = max(rates, default=None)
    report.subjects = [
        {
            "subject": speaker,
            "trained_on": True,
            "clips": len(lengths),
            "frames": round(sum(lengths) * module.frame_rate),
            "seconds": sum(lengths),
            "template": False,
        }
        for speaker, lengths in sorted(subjects.items())
    ]
    for order, count in orders.items():
        findings.note("order", str(count), f"recordings in the order {order}")
    if len(rates) > 1:
        counts = ", ".join(f"{count} of {rate:g}" for rate, count in sorted(rates.items()))
        findings.note("rates", "frame rate", f"several: {counts} a second; all are read at {module.frame_rate:g}")
    if low is not None and high is not None and deviation is not None:
        _check_values(report, folder, channels, low, high, deviation)


def _check_values(
    report: CheckReport,
    folder: RecordingFolder,
    channels: tuple[str, ...],
    low: np.ndarray[Any, Any],
    high: np.ndarray[Any, Any],
    deviation: np.ndarray[Any, Any],
) -> None:
    unrecorded = {name.casefold() for name in folder.space.absent}
    dead = [
        name
        for name, std in zip(channels, deviation, strict=True)
        if std <= FLOOR * deviation.max() and name.casefold() not in unrecorded
    ]
    if dead:
        report.findings.note("dead", few(dead), "never move in this folder: a model learns nothing about them")
    span = folder.space.valid_range
    if span is None:
        return
    turning = {*folder.space.head, *folder.space.eyes}
    beyond = [
        f"{name} {minimum:.2f} to {maximum:.2f}"
        for column, (name, minimum, maximum) in enumerate(zip(channels, low, high, strict=True))
        if column not in turning and (minimum < span[0] or maximum > span[1])
    ]
    if beyond:
        report.findings.warning(
            "range",
            few(beyond),
            f"outside {span[0]:g} to {span[1]:g}; they are kept, and clipped by what shows them only",
        )


def refuse_layout(corpus: str | None) -> None:
    """Refuse a layout that does not exist, or one of recordings that name their columns."""
    name, _, layout = (corpus or "").partition(":")
    if layout and (layout not in LAYOUTS or name.lower() not in ("flame_clips", "flameclips")):
        raise FaceDiffError(f"--corpus {corpus}: expected flame_clips with one of the layouts {', '.join(LAYOUTS)}")
