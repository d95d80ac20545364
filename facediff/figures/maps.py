"""The numbers behind pictures of the face: how much each vertex moves, and how far it is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facediff.figures.material import TRUTH, Array, Material, chunks, shortest


class Moments:
    """Mean, population standard deviation and maximum over frames that come a few at a time.

    Chan, Golub and LeVeque's update (1983) of mean and sum of squared deviations: exact to rounding for any number of
    frames, where a difference of sums of squares is not.

    Args:
        n_vertices: numbers a frame.
    """

    def __init__(self, n_vertices: int) -> None:
        self.count = 0
        self.mean: Array = np.zeros(n_vertices)
        self.maximum: Array = np.zeros(n_vertices)
        self._squares: Array = np.zeros(n_vertices)

    def add(self, values: Array) -> None:
        """Take in values (frames, n_vertices), none below zero."""
        count = self.count + len(values)
        mean = values.mean(0)
        apart = mean - self.mean
        self._squares += ((values - mean) ** 2).sum(0) + apart**2 * (self.count * len(values) / count)
        self.mean = self.mean + apart * (len(values) / count)
        self.maximum = np.maximum(self.maximum, values.max(0))
        self.count = count

    @property
    def deviation(self) -> Array:
        """Population standard deviation (n_vertices,)."""
        return np.asarray(np.sqrt(self._squares / max(self.count, 1)))


@dataclass(frozen=True)
class VertexMap:
    """A number at each vertex, in the vertices' unit.

    Attributes:
        mean: mean over frames (V,).
        deviation: population standard deviation over frames (V,).
        maximum: maximum over frames (V,).
        frames: frames that they are over.
    """

    mean: Array
    deviation: Array
    maximum: Array
    frames: int


def motion_maps(material: Material, clips: Sequence[str]) -> tuple[dict[str, VertexMap], list[str]]:
    """How far each vertex is from the subject's template, over all frames of the clips, of truth and methods.

    Where lengths differ, the frames that all have are taken, so that the panels of a figure compare alike.

    Returns:
        a map by name, the truth's first; and notes on frames that were left out.

    Raises:
        FaceDiffError: if a file cannot be used or a template is missing.
    """
    found = {name: Moments(material.n_vertices) for name in material.names}
    notes = []
    for clip in clips:
        template, motions = material.template(clip), material.open(clip)
        frames, note = shortest(motions)
        notes += [f"{clip}: {note}"] if note else []
        for name, motion in motions.items():
            for _, part in chunks(motion, material.path(clip, name), frames):
                found[name].add(np.linalg.norm(part - template, axis=2))
    return {name: _map(moments) for name, moments in found.items()}, notes


def error_maps(material: Material, clips: Sequence[str]) -> tuple[dict[str, VertexMap], list[str]]:
    """How far each vertex is from the truth's, over all frames of the clips, of every method.

    Returns:
        a map by method; and notes on frames that were left out.

    Raises:
        FaceDiffError: if a file cannot be used.
    """
    found = {name: Moments(material.n_vertices) for name in material.methods}
    notes = []
    for clip in clips:
        motions = material.open(clip)
        frames, note = shortest(motions)
        notes += [f"{clip}: {note}"] if note else []
        for name, moments in found.items():
            true = chunks(motions[TRUTH], material.path(clip, TRUTH), frames)
            predicted = chunks(motions[name], material.path(clip, name), frames)
            for (_, one), (_, other) in zip(predicted, true, strict=True):
                moments.add(np.linalg.norm(one - other, axis=2))
    return {name: _map(moments) for name, moments in found.items()}, notes


def _map(moments: Moments) -> VertexMap:
    return VertexMap(moments.mean, moments.deviation, moments.maximum, moments.count)
