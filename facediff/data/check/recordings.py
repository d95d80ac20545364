"""Checking folders of recordings in parameters: order, version, rate, and channels that are dead or out of range."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff import registry
from facediff.data.check.findings import CheckReport, Findings, few, relative
from facediff.errors import FaceDiffError
from facediff.spaces.layouts import LAYOUTS
from facediff.spaces.operations import FLOOR

if TYPE_CHECKING:
    from facediff.data.parametric import ParametricDataModule
    from facediff.spaces import Space

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


def check_recordings(report: CheckReport, root: Path, module: type[ParametricDataModule], corpus: str | None) -> None:
    """Add the contents and the defects of a folder of recordings to a report."""
    from facediff.data.recordings import RecordingFolder
    from facediff.speech.audio import SAMPLE_RATE, read_speech

    layout = (corpus or "").partition(":")[2] or None
    space = LAYOUTS[layout].space if layout else getattr(module, "space", LAYOUTS["arkit"].space)
    folder = RecordingFolder(root, space, module.frame_rate, suffixes=module.suffixes, layout=layout)
    findings = report.findings
    report.corpus, report.data_module = module.corpus_name, f"{module.__module__}.{module.__name__}"
    report.frame_rate, report.points = module.frame_rate, "channels"
    names = folder.names()
    if not names:
        message = f"no {' or '.join(module.suffixes)} with a .wav of its name; put them there"
        findings.error("no_clip", str(root), message)
    orders: Counter[str] = Counter()
    rates: Counter[float] = Counter()
    subjects: dict[str, list[float]] = {}
    statistics: list[npt.NDArray[np.floating]] = []
    channels: tuple[str, ...] = ()
    for name in names:
        clip_file = folder.path_of(name)
        where = relative(clip_file, root)
        with findings.guard("clip_unreadable", clip_file, root):
            clip = folder.recording(name)
            if channels and clip.space.channels != channels:
                findings.error("other_channels", where, "has other channels than the recordings before it")
                continue
            channels = clip.space.channels
            without = f", without {few(clip.space.absent)}" if clip.space.absent else ""
            version = f" {clip.space.version}" if clip.space.version else ""
            orders[f"{clip.layout or clip.space.kind}{version}: {len(channels)} channels{without}"] += 1
            rates[clip.frame_rate] += 1
            for note in clip.notes:
                findings.warning("remark", where, note)
            statistics.append(np.stack([of(axis=0) for of in (clip.values.min, clip.values.max, clip.values.std)]))
            seconds = len(read_speech(folder.files[name][1])) / SAMPLE_RATE
            if abs(seconds - clip.duration) > SOUND_DIFFERS:
                message = f"lasts {clip.duration:.2f} s and its sound {seconds:.2f} s; cut both to one stretch"
                findings.warning("length", where, message)
            speaker = module.parse_name(name)
            if speaker is None:
                findings.note("name", where, "is not named as recordings of this corpus are, and is not read")
            else:
                subjects.setdefault(speaker.identity, []).append(clip.duration)
    report.n_vertices = len(channels) or None
    report.stored_frame_rate = max(rates, default=None)
    for subject, lengths in sorted(subjects.items()):
        row = {"subject": subject, "trained_on": True, "clips": len(lengths), "template": False}
        report.subjects.append(row | {"frames": round(sum(lengths) * module.frame_rate), "seconds": sum(lengths)})
    for order, count in orders.items():
        findings.note("order", str(count), f"recordings in the order {order}")
    if len(rates) > 1:
        counts = ", ".join(f"{count} of {rate:g}" for rate, count in sorted(rates.items()))
        findings.note("rates", "frame rate", f"several: {counts} a second; all are read at {module.frame_rate:g}")
    if statistics:
        _check_values(findings, space, channels, np.stack(statistics))


def _check_values(
    findings: Findings, space: Space, channels: tuple[str, ...], statistics: npt.NDArray[np.floating]
) -> None:
    """Report channels that never move or leave their range, by minimum, maximum and deviation (clips, 3, channels)."""
    low, high, deviation = statistics[:, 0].min(0), statistics[:, 1].max(0), statistics[:, 2].max(0)
    unrecorded = {name.casefold() for name in space.absent}
    still = deviation <= FLOOR * deviation.max()
    if dead := [
        name for name, rests in zip(channels, still, strict=True) if rests and name.casefold() not in unrecorded
    ]:
        findings.note("dead", few(dead), "never move in this folder: a model learns nothing about them")
    span, turning = space.valid_range, {*space.head, *space.eyes}
    beyond = [
        f"{name} {low[column]:.2f} to {high[column]:.2f}"
        for column, name in enumerate(channels)
        if span and column not in turning and (low[column] < span[0] or high[column] > span[1])
    ]
    if span and beyond:
        message = f"outside {span[0]:g} to {span[1]:g}; they are kept, and clipped by what shows them only"
        findings.warning("range", few(beyond), message)


def refuse_layout(corpus: str | None) -> None:
    """Refuse a layout that does not exist, or one of recordings that name their columns."""
    name, _, layout = (corpus or "").partition(":")
    if layout and (layout not in LAYOUTS or name.lower() not in ("flame_clips", "flameclips")):
        raise FaceDiffError(f"--corpus {corpus}: expected flame_clips with one of the layouts {', '.join(LAYOUTS)}")
