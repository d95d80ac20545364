"""Whether an animation carried to another mesh can be used: lips part, lids meet, nothing folds, all of it is there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facediff.animation import Animation, metres_per_unit
from facediff.animation.animation import measured
from facediff.editing.correspondence import Correspondence
from facediff.editing.eye_fit import EyeFigures, check_eyes, fullest_blink, raised_brows
from facediff.editing.lid_transfer import lid_edges
from facediff.editing.surface import Surface, nearest, triangle_normals
from facediff.errors import OptionError
from facediff.utils.numerics import Array, Floats, Integers

FRAMES = 24  # As many frames, evenly spread, and the one with the widest mouth are looked at
LIP_RATIO = 0.22
"""Gap at rest over gap at the widest between the lips, along the way that they part."""
SPEAKS = 0.003  # metres: an animation whose lips part by less says nothing of the other mesh's lips
CLEARLY_OPENS = 0.75  # A mouth of which every third opens by this share is not glued
OPENS = 0.4  # A third of the mouth must open by this share of what the animation's does
FOLDED = 0.02  # Share of the moving triangles that may turn over, beyond what the animation's own do
CROSSED = 0.1  # Share of pairs and frames in which the lips may pass through one another by a millimetre
COVERED = 0.5  # Share of the animation's motion for which the mesh must have a place
NEAR = 0.12  # A place is there if the mesh is no further away than this share of the face's size
LIPS = 15  # places along the lips that are looked at
TORN = 0.2  # Share of the lips' edges that may move otherwise


@dataclass(frozen=True)
class FitReport:
    """Figures of a fit; None where the animation does not show it."""

    folded: float  # share of the moving triangles that turn over in some frame
    covered: float  # share of the animation's motion for which the mesh has a place
    eyes: EyeFigures | None  # the upper face's figures
    faults: tuple[str, ...]  # a clause each; empty if the result can be used
    remarks: tuple[str, ...]  # differences from the animation that are no fault, a clause each
    lip_ratio: float | None = None  # gap at rest over gap at the widest between the mesh's own lips; 0 is best
    opened: float | None = None  # least opening of the mouth's left, middle and right third, over the animation's own
    torn: float | None = None  # share of the lips' edges that move otherwise than the animation's
    crossed: float | None = None  # share of pairs and frames in which upper and lower lip pass through one another

    @property
    def good(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults

    @property
    def summary(self) -> str:
        """The figures on one line."""
        figures = []
        if self.lip_ratio is not None and self.opened is not None:
            figures.append(f"lips {self.lip_ratio:.2f} of their widest gap at rest, {self.opened:.0%} as open")
        if self.eyes is not None and self.eyes.lid_gap is not None:
            figures.append(f"{self.eyes.lid_gap:.0%} of the eyes left open at a full blink")
        figures.append(f"{self.folded:.1%} of the triangles fold over")
        figures.append(f"{self.covered:.0%} of the motion is carried")
        return ", ".join(figures)


def refuse_poor(source: object, report: FitReport) -> None:
    """Refuse a result that cannot be used."""
    if not report.good:
        raise OptionError.naming(
            f"{source}: {report.faults[0]}. Look at it with `facediff retarget --show`, show places that are the same "
            f"with {{pick}} or {{landmarks}}, or write it as it is with {{accept_poor}}"
        )


def check_fit(animation: Animation, carried: Animation, correspondence: Correspondence) -> FitReport:
    """Measure an animation that a correspondence carried to another mesh against the original, with triangles."""
    scale, rotation = correspondence.similarity.scale, correspondence.similarity.rotation
    frames = np.unique(np.linspace(0, len(animation.vertices) - 1, min(FRAMES, len(animation.vertices))).astype(int))
    lips, faults = dict[str, float](), list[str]()
    source, target = correspondence.features
    if source is not None:
        pairs = source.lips(correspondence.source_vertices, LIPS)
        rest = _gaps(animation.template[None], pairs)[0]
        moving = measured(animation.vertices, lambda vertices: _gaps(vertices, pairs))
        mean = moving.mean(axis=1)
        widest = int(mean.argmax())
        # Lips that are glued or torn show most where the mouth is widest.
        frames = np.unique(np.append(frames, widest))
        opening = float(mean[widest] - rest.mean())
        if opening * metres_per_unit(animation.unit) > SPEAKS and target is None:
            faults.append(
                "no line between its lips was found: triangles close its mouth, or it lies elsewhere; cut a closed "
                "mesh along the lips"
            )
        elif opening * metres_per_unit(animation.unit) > SPEAKS and target is not None:
            facing = target.lips(correspondence.laid.vertices, LIPS)
            # Along the way that the lips part: facing vertices of a coarse mesh do not lie above one another.
            shut, wide = _apart(animation, pairs, widest)
            parting = wide - shut
            way = parting.mean(axis=0) / np.linalg.norm(parting.mean(axis=0))
            gaps = _apart(carried, facing, widest) @ (rotation @ way)
            lips = {
                "lip_ratio": float(gaps[0].mean() / max(gaps.mean(axis=1).max(), 1e-12)),
                "opened": _opened(gaps[1] - gaps[0], scale * (parting @ way)),
                "torn": _torn(animation, carried, pairs, facing, widest, scale * rotation, scale * opening),
                "crossed": _crossed(animation, carried, pairs, facing, frames, rotation @ [0.0, 1.0, 0.0], scale),
            }
            most = max(float(rest.mean()), float(mean[widest]))
            faults += _lip_faults(*lips.values(), limit=max(LIP_RATIO, 1.3 * (float(rest.mean()) / most)))
    frames = np.unique(np.append(frames, list(telling_frames(animation, correspondence).values()))).astype(int)
    folded = _folded(carried, correspondence.target_faces, frames)
    if folded > FOLDED + _folded(animation, animation.triangles.astype(np.int64), frames):
        faults.append(f"{folded:.0%} of its moving triangles fold over")
    covered = _covered(animation, correspondence, frames)
    if covered < COVERED:
        faults.append(f"it has a place for {covered:.0%} of the animation's motion only")
    eyes, eye_faults, remarks = check_eyes(animation, carried, correspondence, frames)
    return FitReport(folded, covered, eyes, (*faults, *eye_faults), tuple(remarks), **lips)


def telling_frames(animation: Animation, correspondence: Correspondence) -> dict[str, int]:
    """The frames that show most of a result, by name: the widest mouth, a full blink and raised brows."""
    source = correspondence.features[0]
    if source is None:
        return {}
    lips = source.lips(correspondence.source_vertices, LIPS)
    gaps = measured(animation.vertices, lambda vertices: _gaps(vertices, lips).mean(axis=1))
    frames = {"widest mouth": int(gaps.argmax())}
    edges = [lid_edges(correspondence.source_vertices, source, eye) for eye in (0, 1)]
    lids = [one for one in edges if one is not None]
    if lids:
        frames["full blink"] = fullest_blink(animation, lids)[0]
    brows = raised_brows(animation, source)
    return frames if brows is None else {**frames, "raised brows": brows}


def _lip_faults(ratio: float, opened: float, torn: float, crossed: float, *, limit: float) -> list[str]:
    faults = []
    # A mouth that stands open at rest has a high ratio too; its opening tells it from a mouth with glued lips.
    if ratio > limit and (opened < CLEARLY_OPENS or torn > 0):
        faults.append(f"its lips do not part as the animation's do: {ratio:.2f} of their widest gap is there at rest")
    if opened < OPENS:
        faults.append(f"a part of its mouth opens by {max(opened, 0):.0%} of what the animation's does only")
    if torn > TORN:
        faults.append(f"its lips are torn: {torn:.0%} of their edges move otherwise than the animation's")
    if crossed > CROSSED:
        faults.append(f"its lips pass through one another in {crossed:.0%} of the places looked at")
    return faults


def _opened(grown: Array, expected: Array) -> float:
    """Least growth of the gap over the mouth's thirds, as a share of the expected growth."""
    return min(
        float(grown[third].mean() / max(expected[third].mean(), 1e-12))
        for third in np.array_split(np.arange(len(grown)), 3)
        if expected[third].mean() > 0.2 * expected.mean()
    )


def _torn(
    animation: Animation,
    carried: Animation,
    pairs: Integers,
    facing: Integers,
    frame: int,
    matrix: Array,
    opening: float,
) -> float:
    """Share of the lips' edges with motion that differs by half of the mouth's opening from the expected one."""
    expected = (np.float64(animation.vertices[frame][pairs]) - animation.template[pairs]) @ matrix.T
    moved = np.float64(carried.vertices[frame][facing]) - carried.template[facing]
    return float(np.mean(np.linalg.norm(moved - expected, axis=2) > 0.5 * opening))


def _apart(animation: Animation, pairs: Integers, frame: int) -> Array:
    """From one lip to the other at rest and in a frame, (2, P, 3)."""
    frames = np.stack([animation.template, animation.vertices[frame]]).astype(np.float64)
    return np.asarray(frames[:, pairs[:, 0]] - frames[:, pairs[:, 1]])


def _gaps(frames: Floats, pairs: Integers) -> Array:
    """Distances (T, P) of facing vertices."""
    return np.asarray(np.linalg.norm(np.float64(frames[:, pairs[:, 0]]) - frames[:, pairs[:, 1]], axis=2))


def _crossed(
    animation: Animation,
    carried: Animation,
    pairs: Integers,
    facing: Integers,
    frames: Integers,
    up: Array,
    scale: float,
) -> float:
    """How often the upper lip is a millimetre further below the lower one than at rest, where the original's is not."""

    def heights(one: Animation, which: Integers, axis: Array) -> tuple[Array, Array]:
        rest = np.float64(one.template[which[:, 0]]) - one.template[which[:, 1]]
        moved = np.float64(one.vertices[frames][:, which[:, 0]]) - one.vertices[frames][:, which[:, 1]]
        return moved @ axis, np.minimum(rest @ axis, 0.0)

    source_heights, source_rest = heights(animation, pairs, np.array([0.0, 1.0, 0.0]))
    heights_now, rest_now = heights(carried, facing, up)
    # Closed lips touch, and rounding puts some a little past one another: a millimetre is not yet a fault.
    slack = 0.001 / metres_per_unit(animation.unit)
    return float(((heights_now < rest_now - scale * slack) & (source_heights > source_rest - 0.5 * slack)).mean())


def _folded(animation: Animation, faces: Integers, frames: Integers) -> float:
    """Share of the triangles that move which turn by more than a right angle in some frame."""
    rest = triangle_normals(np.asarray(animation.template, np.float64), faces)
    turned, moving = np.zeros(len(faces), bool), np.zeros(len(faces), bool)
    extent = float(np.ptp(animation.template, axis=0).max())
    for frame in frames:
        points = np.asarray(animation.vertices[frame], np.float64)
        turned |= (triangle_normals(points, faces) * rest).sum(axis=1) < 0
        moving |= (np.abs(points - animation.template).max(axis=1) > 1e-4 * extent)[faces].any(axis=1)
    return float((turned & moving).sum() / max(int(moving.sum()), 1))


def _covered(animation: Animation, correspondence: Correspondence, frames: Integers) -> float:
    """Share of the animation's motion, summed over its vertices, that has the target's surface nearby."""
    motion = np.max(
        [np.linalg.norm(animation.vertices[frame] - animation.template, axis=1) for frame in frames], axis=0
    )
    if not motion.any():
        return 1.0
    some = np.flatnonzero(motion > 0.05 * motion.max())
    # A sample is enough for a share, and each place costs a search.
    if len(some) > 400:
        some = np.sort(np.random.default_rng(0).choice(some, 400, replace=False))
    laid = correspondence.laid
    size = Surface(correspondence.source_vertices, correspondence.source_faces).size
    points = np.asarray(correspondence.source_vertices[some], np.float64)
    away = nearest(laid, points, np.zeros_like(points), 0.0).distances
    return float(motion[some][away < NEAR * size].sum() / motion[some].sum())
