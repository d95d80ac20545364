"""From an animation to weights of blendshapes: one bounded least-squares problem over all frames, and its tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.editing.bounded import MOST_STEPS, Problem, minimise, minimise_sparse
from facediff.editing.controls.expressiveness import ALL, check_factors
from facediff.editing.shapes import BUILT_IN, ShapeSet, read_shapes
from facediff.errors import FaceDiffError, OptionError, check_known
from facediff.mesh.mesh import triangle_areas
from facediff.spaces.arkit import ARKIT, absent_from, beyond_arkit, mirror_pairs
from facediff.spaces.files.clips import ParameterClip
from facediff.spaces.files.csv_files import gaze, live_link_header, live_link_rows
from facediff.spaces.layouts import layout
from facediff.spaces.rigs import LinearRig
from facediff.spaces.rotations import convert
from facediff.spaces.space import Space
from facediff.spaces.visemes import VisemeSet, visemes
from facediff.utils import ranges
from facediff.utils.files import atomic, check_writable
from facediff.utils.numerics import Array, Floats, Indices, Integers
from facediff.utils.plain_files import json_text, write_table

CHUNK_BYTES = 32 * 2**20
AROUND = 1 / 15  # Seconds before and after a shape's work in which it is free to fade
VISIBLE_MM = 0.2  # A residual that nobody sees is none, however small the motion
UNBOUNDED = 1e3  # More than a coefficient reaches, in standard deviations or weights
TOLERANCE = 1e-8  # of the optimality conditions, in weights
STATED_RATE = 30.0  # Frames a second for which the smoothness is stated


@dataclass(frozen=True)
class SolveOptions:
    """Options of a solve; all strengths are shares of a shape's own energy, so that they mean the same for every shape.

    Attributes:
        smoothness: how much a weight's change from frame to frame costs; at 0.02, a movement to and fro five times a
            second keeps 98 % of its size. Stated for 30 frames a second and converted to the animation's frame rate.
        symmetry: how much a difference between the weights of a left shape and its right one costs.
        sparsity: how much of a weight a shape must gain by its work to be used in a frame: shapes that would cancel one
            another stay at 0. With 0, all shapes are used, and weights may be negative; see
            :func:`minimise_sparse`.
        ridge: how much the squares of weights cost, which chooses the smallest among equally good ones.
        lower: least weight.
        upper: greatest weight.
        region: name of the animation's region that is looked at; None for the whole face.
        area_weighted: count vertices by the area around them, so that finely meshed places do not count for more;
            without triangles, all count alike.
        residual_limit: largest residual as a share of the motion, root mean square over all frames; above it the shapes
            belong to another face. 1 or more allows everything.
    """

    smoothness: ranges.Strength = 0.02
    symmetry: ranges.Strength = 0.0
    sparsity: ranges.Strength = 0.003
    ridge: ranges.Strength = 1e-6
    lower: ranges.Bound = 0.0
    upper: ranges.Bound = 1.0
    region: str | None = None
    area_weighted: bool = True
    residual_limit: ranges.Strength = 0.8

    def __post_init__(self) -> None:
        ranges.check_options(self)
        if not self.lower < self.upper or self.sparsity > 0 > self.lower:
            raise FaceDiffError(
                f"bounds {self.lower:g} to {self.upper:g}: expected the lower one first, as in 0 1, and below 0 a "
                f"sparsity of 0"
            )


@dataclass(frozen=True, eq=False, repr=False)
class Weights:
    """Weights of blendshapes, frame by frame, as :func:`solve` finds them."""

    names: tuple[str, ...]  # K names
    values: Array  # (T, K) weights
    residual_rms_mm: Array  # (T,) root-mean-square residual of each frame's vertices, in millimetres
    residual_max_mm: Array  # (T,) greatest such distance
    amplitude_mm: float  # root-mean-square distance of all vertices in all frames from the template
    frame_rate: float  # frames a second
    still: tuple[str, ...] = ()  # names of shapes that move no vertex, so that their weights mean nothing
    metadata: Mapping[str, str] = field(default_factory=dict)  # the animation's, and how the weights were solved for
    head: Array | None = None  # (T, 3) rotation of the head that the weights leave out, axis-angle in radians
    # (T, 6) yaw, pitch and roll of the left and the right eye, radians as `facediff.spaces.files.csv_files.gaze` has
    # them; None if only weights say where the eyes look
    eyes: Array | None = None

    @property
    def absent(self) -> tuple[str, ...]:
        """Names of ARKit's that had no shape, in ARKit's order."""
        return absent_from(self.names)

    @property
    def extra(self) -> tuple[str, ...]:
        """Names that are not ARKit's."""
        return beyond_arkit(self.names)

    @property
    def residual_share(self) -> Array:
        """(T,) each frame's residual as a share of the motion's amplitude; zero for a motion that stands still."""
        if self.amplitude_mm <= 0:
            return np.zeros_like(self.residual_rms_mm)
        return self.residual_rms_mm / self.amplitude_mm

    def arkit_columns(self, purpose: object) -> list[int]:
        """The columns with names of ARKit's; refused if there are none, for a purpose such as a file."""
        columns = [index for index, name in enumerate(self.names) if name in ARKIT]
        if not columns:
            raise OptionError.naming(
                f"{purpose}: none of the shapes ({', '.join(self.names[:3])} …) has a name of ARKit's; "
                f"rename them, or write a table of their own names with {{plain}}"
            )
        return columns

    def tracks(self, viseme_set: VisemeSet) -> Weights:
        """The weights as visemes, ``oculus`` or ``vrm``; see :func:`facediff.spaces.visemes.visemes`."""
        columns = self.arkit_columns("visemes")
        space = Space("arkit", tuple(self.names[index] for index in columns))
        values, target = visemes(self.values[:, columns], space, viseme_set)
        about = {**self.metadata, "tracks": viseme_set}
        return replace(self, names=target.channels, values=np.asarray(values, np.float64), still=(), metadata=about)

    def save(self, path: str | Path, *, plain: bool = False) -> Path:
        """Write the table, and a .json with further facts next to it.

        Args:
            path: the .csv file.
            plain: columns time, the set's own names and residuals in mm, instead of Live Link Face's columns.
        """
        (write_weights if plain else write_live_link)(Path(path), self)
        return Path(path)

    def __repr__(self) -> str:
        shares = self.residual_share
        return (
            f"Weights({len(self.values)} frames, {len(self.names)} shapes; residual: median "
            f"{np.median(self.residual_rms_mm):.3g} mm, {np.median(shares):.1%} of the motion)"
        )


def own_weights(animation: Animation) -> Weights:
    """The weights that an animation was made of, as they are; nothing is solved for."""
    values, space = animation.values, animation.space
    if values is None:
        raise FaceDiffError(f"{animation.name}: has no weights of its own; give shapes to solve for them")
    face, frames = list(space.face), len(values)
    turns = {turn.joint: convert(values[:, list(turn.channels)], turn.form, "euler") for turn in space.rotations}
    eyes = [turns[joint] for joint in ("left_eye", "right_eye") if joint in turns]
    return Weights(
        names=tuple(space.channels[channel] for channel in face),
        values=np.asarray(values[:, face], np.float64),
        residual_rms_mm=np.zeros(frames),
        residual_max_mm=np.zeros(frames),
        amplitude_mm=0.0,
        frame_rate=animation.frame_rate,
        metadata={**animation.metadata, "weights": "those of the model; nothing was solved for"},
        head=None if animation.head is None else animation.head[:, :3],
        eyes=np.concatenate(eyes, axis=1) if len(eyes) == 2 else None,
    )


def has_arkit_weights(animation: Animation) -> bool:
    """Whether an animation has weights of ARKit's shapes, or is of the built-in face, which has such shapes."""
    has_weights = animation.values is not None and animation.space.kind == "arkit"
    return has_weights or is_built_in_face(len(animation.template), animation.faces)


def is_built_in_face(vertices: int, faces: Integers | None) -> bool:
    """Whether a mesh of so many vertices with these triangles is one of the built-in faces."""
    from facediff.synthetic.known_faces import is_built_in

    return faces is not None and is_built_in(vertices, faces)


def arkit_weights(animation: Animation) -> Weights:
    """Weights of ARKit's shapes of an animation that :func:`has_arkit_weights`: its own, or solved for."""
    if animation.values is not None and animation.space.kind == "arkit":
        return own_weights(animation)
    return solve(animation, read_shapes(Path(BUILT_IN), animation.template, animation.unit))


def solve(animation: Animation, shapes: ShapeSet, options: SolveOptions | None = None) -> Weights:
    """Weights w_t that bring the shapes nearest to an animation.

    Minimises Σ_t ½‖Σ_k w_tk d_k − (x_t − template)‖² + ½λ Σ_t Σ_k e_k (w_tk − w_{t−1,k})² + ½σ Σ_t Σ_(l,r) ½(e_l + e_r)
    (w_tl − w_tr)² + ½ρ Σ_t Σ_k e_k w_tk² with lower ≤ w ≤ upper, where d_k are the displacements of shape k, norms are
    means over vertices weighted by area, and e_k = ‖d_k‖² makes the strengths λ (smoothness), σ (symmetry) and ρ
    (ridge) the same for shapes that move much and little. All frames are solved for together. Sparsity τ first adds
    τ Σ_t Σ_k e_k |w_tk|, and holds at 0 what that sets to 0.

    Args:
        animation: with V vertices and T frames.
        shapes: of the animation's topology.
        options: the usual ones if None.

    Example:
        >>> from facediff.animation import Animation
        >>> from facediff.editing.shapes import BUILT_IN, ShapeSet, read_shapes
        >>> rest = np.random.default_rng(0).normal(size=(9, 3))
        >>> shapes = ShapeSet(("jawOpen",), rest, np.full((1, 9, 3), 0.01))
        >>> half_open = Animation("hello", (rest + 0.005)[None], rest, frame_rate=30.0)
        >>> solve(half_open, shapes).values.round(3)
        array([[0.5]])
    """
    options = options or SolveOptions()
    if shapes.deltas.shape[1] != len(animation.template):
        raise FaceDiffError(
            f"{animation.name}: has {len(animation.template)} vertices and the shapes {shapes.deltas.shape[1]}; give "
            f"shapes of the same mesh, or carry them over with `facediff blendshapes --carry`"
        )
    animation.refuse_not_finite()
    head, animation = animation.head, animation.still()
    terms = objective(animation, shapes, options)
    products, square = [], 0.0
    for _, moved in _displacements(animation, terms):
        # Frame by frame only the products with the shapes are kept: (T, K) numbers instead of (T, 3N).
        products.append(moved.reshape(len(moved), -1) @ terms.projection.T)
        square += float(np.square(moved).sum())
    right = np.concatenate(products)
    amplitude = float(np.sqrt(square / (len(animation.vertices) * len(terms.vertices))))
    scale = terms.scale
    problem = Problem(terms.matrix, right, terms.coupling, options.lower * scale, options.upper * scale)
    tolerance = TOLERANCE * scale
    if options.sparsity > 0:
        around = max(1, round(AROUND * animation.frame_rate))
        scaled_weights, converged = minimise_sparse(problem, options.sparsity * scale, tolerance, frames_around=around)
    else:
        scaled_weights, converged = minimise(problem, tolerance)
    values = np.full((len(right), len(shapes.names)), np.clip(0.0, options.lower, options.upper))
    # Division may lead past a bound by a rounding error.
    values[:, terms.indices] = np.clip(scaled_weights / scale, options.lower, options.upper)
    rms, largest = _residuals(animation, terms, values[:, terms.indices])
    millimetres = 1000.0 * metres_per_unit(animation.unit)
    # Over all frames together: a frame in which the face hardly moves has a large share of nothing left.
    remaining = float(np.sqrt(np.square(rms).mean()))
    if remaining > options.residual_limit * amplitude and millimetres * remaining > VISIBLE_MM:
        raise OptionError.naming(
            f"{animation.name}: the weights leave {remaining / amplitude:.0%} of the motion "
            f"({millimetres * remaining:.2g} of {millimetres * amplitude:.2g} mm), as shapes of another face or "
            f"in another unit do; look at them, or raise {{residual_limit}} from {options.residual_limit:g}"
        )
    about = {
        **{name: f"{getattr(options, name):g}" for name in ("smoothness", "symmetry", "sparsity", "ridge")},
        "bounds": f"{options.lower:g} {options.upper:g}",
        "region": options.region or "whole face",
        "converged": "yes" if converged else f"no, after {MOST_STEPS} iterations",
    }
    return Weights(
        names=shapes.names,
        values=values,
        residual_rms_mm=millimetres * rms,
        residual_max_mm=millimetres * largest,
        amplitude_mm=millimetres * amplitude,
        frame_rate=animation.frame_rate,
        still=tuple(name for k, name in enumerate(shapes.names) if k not in terms.indices),
        metadata={**animation.metadata, **{f"solve {key}": value for key, value in about.items()}},
        head=None if head is None else head[:, :3],
    )


def encode(animation: Animation, rig: LinearRig) -> Array:
    """Weights (T, C) of a rig that come nearest to an animation's vertices: the exact ones if the rig made them.

    This is :func:`solve` without sparsity and smoothness, which suit artists; captured weights are dense, and keeping
    shapes at 0 would cost them more than it costs the geometry.

    Args:
        animation: of the rig's topology and unit.
        rig: for ARKit's shapes the weights are bounded by 0 and 1, else by the rig's own range or not at all.
    """
    lower, upper = rig.space.valid_range or (-UNBOUNDED, UNBOUNDED)
    options = SolveOptions(smoothness=0.0, sparsity=0.0, ridge=0.0, lower=lower, upper=upper, residual_limit=1.0)
    return solve(animation, ShapeSet(rig.names, rig.neutral, rig.deltas), options).values


def key_frames(values: Array, tolerance: float) -> Indices:
    """Frames (N,) that are enough: between them, no curve is further than a tolerance from the straight line.

    The first and the last frame are among them. Douglas & Peucker, "Algorithms for the reduction of the number of
    points required to represent a digitized line", Cartographica 1973, with distances taken at equal times, as
    players interpolate.

    Args:
        values: (T, K) curves that share their keys.
        tolerance: largest change of a value.

    Example:
        >>> key_frames(np.array([[0.0], [0.5], [1.0], [0.0]]), 0.001).tolist()
        [0, 2, 3]
    """
    last = len(values) - 1
    keys, spans = {0, last}, [(0, last)]
    while spans:
        first, end = spans.pop()
        if end - first < 2:
            continue
        share = (np.arange(first + 1, end) - first)[:, None] / (end - first)
        # As a player interpolates: all curves of a span share one pair of keys.
        line = values[first] + share * (values[end] - values[first])
        apart = np.abs(values[first + 1 : end] - line).max(axis=1)
        worst = int(apart.argmax())
        if apart[worst] > tolerance:
            middle = first + 1 + worst
            keys.add(middle)
            spans += [(first, middle), (middle, end)]
    return np.array(sorted(keys), np.int64)


@dataclass(frozen=True)
class Objective:
    """½ Σ xᵀ M x − Σ (P v)ᵀ x + ½ c Σ ‖x_t − x_{t−1}‖² in x, weights times `scale`, of shapes that move something."""

    indices: Indices  # (K,) numbers of these shapes in the set
    vertices: Indices  # (N,) vertices that count
    deltas: Array  # (K, 3N) their displacements
    scale: Array  # (K,) root of each shape's energy: with it, M has ones on its diagonal
    projection: Array  # P (K, 3N), of the displacements v of the vertices that count
    matrix: Array  # M (K, K)
    coupling: float  # c


def objective(animation: Animation, shapes: ShapeSet, options: SolveOptions) -> Objective:
    """The terms that do not depend on the motion."""
    vertices = np.arange(len(animation.template))
    if options.region is not None:
        check_factors([options.region], animation.regions, animation.name)
        if options.region != ALL:
            vertices = np.unique(np.asarray(animation.regions[options.region], np.int64))
    area = np.ones(len(vertices))
    if options.area_weighted and animation.faces is not None and len(animation.faces):
        areas = vertex_areas(animation.template, animation.faces)[vertices]
        area = areas if areas.sum() > 0 else area
    area = np.repeat(area / max(float(area.sum()), np.finfo(float).tiny), 3)
    deltas = shapes.deltas[:, vertices].reshape(len(shapes.names), -1).astype(np.float64)
    energy = np.square(deltas) @ area
    # A shape that moves nothing among the vertices that count has no energy to be scaled by.
    still = np.array([name in shapes.still for name in shapes.names])
    indices = np.flatnonzero(~still & (energy > 1e-12 * energy.max(initial=0.0)))
    if not len(indices):
        raise FaceDiffError(
            f"{animation.name}: no shape moves any vertex that counts; give other shapes or another region"
        )
    deltas, scale = deltas[indices], np.sqrt(energy[indices])
    projection = deltas * area / scale[:, None]
    matrix = projection @ (deltas / scale[:, None]).T + options.ridge * np.eye(len(scale))
    for left, right in mirror_pairs(tuple(shapes.names[k] for k in indices)):
        cost = 0.5 * options.symmetry * (scale[left] ** 2 + scale[right] ** 2)
        row = np.zeros(len(scale))
        row[left], row[right] = 1.0 / scale[left], -1.0 / scale[right]
        matrix += cost * np.outer(row, row)
    # A movement that takes as many seconds takes more steps at a higher frame rate, each the smaller.
    coupling = options.smoothness * (animation.frame_rate / STATED_RATE) ** 2
    return Objective(indices, vertices, deltas, scale, projection, 0.5 * (matrix + matrix.T), coupling)


def vertex_areas(vertices: Floats, faces: Integers) -> Array:
    """A third of the area of every triangle around each vertex, (V,)."""
    thirds = np.repeat(triangle_areas(vertices, faces) / 3.0, 3)
    return np.bincount(faces.ravel(), thirds, len(vertices)).astype(np.float64)


def _displacements(animation: Animation, terms: Objective) -> Iterator[tuple[slice, Array]]:
    """Displacements (frames, N, 3) from the template, some frames at a time."""
    template = np.asarray(animation.template, np.float64)
    step = max(1, CHUNK_BYTES // (24 * len(template)))
    for first in range(0, len(animation.vertices), step):
        frames = slice(first, first + step)
        yield frames, (np.asarray(animation.vertices[frames], np.float64) - template)[:, terms.vertices]


def _residuals(animation: Animation, terms: Objective, values: Array) -> tuple[Array, Array]:
    """Root mean square and maximum (T,) over the vertices of the residuals."""
    rms, largest = [], []
    for frames, moved in _displacements(animation, terms):
        square = np.square(moved - (values[frames] @ terms.deltas).reshape(moved.shape)).sum(axis=-1)
        rms.append(np.sqrt(square.mean(axis=-1)))
        largest.append(np.sqrt(square.max(axis=-1)))
    return np.concatenate(rms), np.concatenate(largest)


# Weights as CSV, with a JSON file of further facts next to the table.

FORMAT = "facediff blendshape weights 1"
SURELY_SIXTIETHS = 31 / 60  # A table with a row at this time is read as one of sixtieths


def write_live_link(path: Path, weights: Weights) -> None:
    """Write a table as Epic's app Live Link Face records it, and ``<name>.json`` next to it.

    A row for each frame: timecode, number of values (61), ARKit's 52 names in order, rotations of head and eyes, as
    :func:`facediff.spaces.files.read_parameters` reads them. Names without a shape are 0, and so are rotations of a
    head that does not move and of eyes without ``eyeLook`` shapes; the JSON file declares them, and holds the frame
    rate and each frame's residual. Both files appear whole or not at all.

    A table that ends before frame number 31 of a second gets one more row there, which holds the last frame: Unreal
    Engine's importer takes a table for one of 30 frames a second unless it finds a greater number than 30.
    """
    weights.arkit_columns(path)
    times = [frame / weights.frame_rate for frame in range(len(weights.values))]
    row_times = [*times, SURELY_SIXTIETHS] if times and times[-1] < SURELY_SIXTIETHS else times
    values, unknown = live_link_values(weights)
    values = np.concatenate([values, values[-1:]])[: len(row_times)]
    space, stamps = layout("live_link"), np.array(row_times)
    rows = live_link_rows(ParameterClip(path.stem, values, space, weights.frame_rate, stamps, layout="live_link"))
    more: dict[str, object] = {
        "rotations": "radians, as Live Link Face records them: yaw and roll to the face's right and pitch down are "
        "positive; columns of rotations_absent are 0 and say nothing",
        "rotations_absent": unknown,
        "timecode": "frames are sixtieths of a second with a fraction, whatever the frame rate",
        "rows_held": len(row_times) - len(times),
    }
    _write_both(path, live_link_header(), rows, _about(weights, ARKIT, more))


def live_link_values(weights: Weights) -> tuple[npt.NDArray[np.float32], list[str]]:
    """Values (T, 61) in the layout ``live_link``, and the names of unknown rotations, ``head`` and ``eyes``."""
    column = {name: index for index, name in enumerate(weights.names)}
    looks = [name for name in column if name.startswith("eyeLook") and name not in weights.still]
    zero = np.zeros(len(weights.values))
    shapes = [weights.values[:, column[name]] if name in column else zero for name in ARKIT]
    head = np.zeros((len(zero), 3)) if weights.head is None else convert(weights.head, "axis_angle", "euler")
    eyes = gaze(weights.names, weights.values) if weights.eyes is None else weights.eyes
    unknown = ["head"] if weights.head is None else []
    unknown += ["eyes"] if weights.eyes is None and not looks else []
    return np.concatenate([np.stack(shapes, axis=1), head, eyes], axis=1).astype(np.float32), unknown


def write_weights(path: Path, weights: Weights) -> None:
    """Write a plain table and ``<name>.json`` next to it: time in seconds, every weight, residuals in millimetres."""
    header = ["time", *weights.names, "residual_rms_mm", "residual_max_mm"]
    rows = (
        [
            f"{frame / weights.frame_rate:.6f}",
            *(f"{value:.8f}" for value in values),
            f"{weights.residual_rms_mm[frame]:.6f}",
            f"{weights.residual_max_mm[frame]:.6f}",
        ]
        for frame, values in enumerate(weights.values)
    )
    _write_both(path, header, rows, _about(weights, weights.names, {}))


def _about(weights: Weights, in_table: Sequence[str], more: Mapping[str, object]) -> dict[str, object]:
    """The content of the .json next to a table."""
    return {
        "format": FORMAT,
        "frame_rate": weights.frame_rate,
        "frames": len(weights.values),
        "absent": list(weights.absent),
        "absent_means": "no shape was given under these names: their weights are 0 and say nothing",
        "still": list(weights.still),
        "not_in_table": [name for name in weights.names if name not in in_table],
        **more,
        "amplitude_mm": round(weights.amplitude_mm, 6),
        "residual_rms_mm": [round(float(value), 6) for value in weights.residual_rms_mm],
        "residual_max_mm": [round(float(value), 6) for value in weights.residual_max_mm],
        "metadata": dict(weights.metadata),
    }


def _write_both(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]], about: dict[str, object]) -> None:
    check_known(path, "format of a table", [path.suffix.lower()], [".csv"])
    # Both names are checked before either file is written.
    for file in (path, path.with_suffix(".json")):
        check_writable(file)
    text = json_text(path.with_suffix(".json"), about) + "\n"
    with atomic(path.with_suffix(".json")) as companion, atomic(path) as temporary:
        write_table(temporary, [header, *rows])
        companion.write_text(text, encoding="utf-8")
