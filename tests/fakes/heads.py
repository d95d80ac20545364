"""A family of heads that are not the built-in one: other people, other topologies, other units and axes, made by code.

Each is a different person's head, cut, closed, resampled, warped and completed with parts of its own, as masks,
registered heads, scans and avatars from elsewhere are. Nothing in them says which vertex was which.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import fast_simplification
import numpy as np
import trimesh

from facediff.animation import Animation
from facediff.editing.landmarks import Landmarks
from facediff.synthetic.head.parts import EYE_CENTRE, build_head
from facediff.synthetic.head.people import Face
from facediff.synthetic.head.rig import head_shapes
from facediff.synthetic.head.rig import lip_pairs as lip_pairs_of_head
from tests.fakes.small_face import CONTROLS, LANDMARKS, Shape, build_face, build_rig, lip_pairs

Mesh = tuple[np.ndarray, np.ndarray]
INTERIOR = ("lip_roll", "mouth_bag", "mouth_back")


@dataclass
class Head:
    """A mesh at rest, and where its parts begin."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3)
    parts: dict[str, np.ndarray] = field(default_factory=dict)  # faces of named parts, in the order of the mesh
    alive: bool = True  # whether lips can part at all


def nearest_vertices(landmarks: Landmarks) -> list[list[int]]:
    """The vertices of both meshes that weigh most in each place."""
    every = np.arange(len(landmarks))
    sides = [side.corners[every, side.weights.argmax(axis=1)] for side in (landmarks.source, landmarks.target)]
    return np.stack(sides, axis=1).tolist()


def talking(shape: Shape | None = None) -> Animation:
    """A face that opens its mouth, rounds and stretches its lips, blinks and raises its brows: (13, 1008, 3)."""
    rig, mesh = build_rig(shape or Shape()), build_face()
    weights = np.zeros((13, len(CONTROLS)))
    for frame, amounts in enumerate(
        (
            {},
            {"jaw_open": 0.3},
            {"jaw_open": 0.7},
            {"jaw_open": 1.0},
            {"jaw_open": 0.4, "pucker": 0.8},
            {"jaw_open": 0.2, "funnel": 1.0},
            {"jaw_open": 0.3, "stretch": 0.9},
            {"upper_lip_raise": 0.8, "lower_lip_drop": 0.8},
            {"jaw_open": 0.5, "corner_up": 0.8},
            {"lids_close": 1.0},
            {"inner_brow_up": 1.0, "outer_brow_up": 1.0},
            {"brow_frown": 1.0, "nose_wrinkle": 0.8},
            {},
        )
    ):
        for name, amount in amounts.items():
            weights[frame, CONTROLS.index(name)] = amount
    upper, lower = lip_pairs()
    return Animation(
        "talking",
        rig.pose(weights).astype(np.float32),
        rig.neutral.astype(np.float32),
        25.0,
        faces=np.asarray(mesh.faces, np.int32),
        colours=mesh.colours,
        regions={"lips": np.unique(np.concatenate([upper, lower]))},
        inner_lip_pairs=np.stack([upper, lower], axis=1),
    )


def turned(*degrees: float) -> np.ndarray:
    """A rotation about x, then y, then z."""
    made = np.eye(3)
    for axis, angle in enumerate(np.deg2rad(degrees)):
        one, two = [k for k in range(3) if k != axis]
        turn = np.eye(3)
        turn[one, one] = turn[two, two] = np.cos(angle)
        turn[one, two], turn[two, one] = -np.sin(angle), np.sin(angle)
        made = turn @ made
    return made


def person(shape: Shape, *without: str) -> Mesh:
    """A person's head in metres without the named groups of vertices."""
    mesh = build_face()
    vertices, faces = build_rig(shape).neutral, np.asarray(mesh.faces)
    if without:
        gone = np.zeros(len(vertices), bool)
        gone[mesh.both(*without)] = True
        faces = faces[~gone[faces].any(axis=1)]
    return cleaned(vertices, faces)


def cleaned(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Without vertices that no triangle touches."""
    used, place = np.unique(faces, return_inverse=True)
    return vertices[used], place.reshape(-1, 3)


def finer(vertices: np.ndarray, faces: np.ndarray, rounds: int = 1) -> Mesh:
    """Every triangle in four, smoothed as Loop (1987) has it."""
    return trimesh.remesh.subdivide_loop(vertices, faces, rounds)


def coarser(vertices: np.ndarray, faces: np.ndarray, share: float) -> Mesh:
    """A decimated mesh without that share of its triangles."""
    points, corners = fast_simplification.simplify(
        vertices.astype(np.float32), np.ascontiguousarray(faces, np.int32), share
    )
    return cleaned(points.astype(np.float64), corners.astype(np.int64))


def shuffled(head: Head, seed: int = 3) -> Head:
    """In an order of its own."""
    order = np.random.default_rng(seed).permutation(len(head.vertices))
    return Head(head.vertices[order], np.argsort(order)[head.faces], head.parts, head.alive)


def joined(**parts: Mesh) -> Head:
    """Several meshes as one, which knows which triangles each part has."""
    points, faces, named, before, first = [], [], {}, 0, 0
    for name, (vertices, corners) in parts.items():
        points.append(vertices)
        faces.append(corners + before)
        named[name] = np.arange(first, first + len(corners))
        before, first = before + len(vertices), first + len(corners)
    return Head(np.concatenate(points), np.concatenate(faces), named)


def laid(head: Head, scale: float, rotation: np.ndarray, shift: tuple[float, float, float] = (0, 0, 0)) -> Head:
    """In another unit, pose and place."""
    return Head(scale * head.vertices @ rotation.T + shift, head.faces, head.parts, head.alive)


def eyeballs(shape: Shape, subdivisions: int = 3) -> dict[str, Mesh]:
    """Two whole eyeballs of a person."""
    centre = shape(np.array([EYE_CENTRE, EYE_CENTRE]) * [[1], [1]] / 1000.0)[0]
    ball = trimesh.creation.icosphere(subdivisions, radius=0.0138)
    points, faces = np.array(ball.vertices), np.array(ball.faces)
    return {"eye_l": (points + centre, faces), "eye_r": (points + centre * [-1, 1, 1], faces)}


def teeth(shape: Shape) -> dict[str, Mesh]:
    """Two rows of teeth as bent boxes, and a tongue."""
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box = box.subdivide().subdivide()
    made: dict[str, Mesh] = {}
    for name, centre, size in (
        ("teeth_upper", (0, -0.0455, 0.070), (0.040, 0.009, 0.006)),
        ("teeth_lower", (0, -0.0555, 0.067), (0.038, 0.009, 0.006)),
        ("tongue", (0, -0.0580, 0.050), (0.024, 0.006, 0.034)),
    ):
        points = np.array(box.vertices) * size
        points[:, 2] -= 28 * np.square(points[:, 0]) if name != "tongue" else 0
        made[name] = (shape(points + centre), np.array(box.faces))
    return made


def patch_eyes(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Holes at the eyes closed by a point in their middle, as scans have them."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    names, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    rim = {tuple(edge) for edge in names[counts == 1]}
    near = [edge for edge in edges if tuple(np.sort(edge)) in rim and abs(vertices[edge, 1].mean() - 0.0255) < 0.02]
    near = [
        edge for edge in near if abs(abs(vertices[edge, 0].mean()) - 0.031) < 0.022 and vertices[edge, 2].min() > 0.03
    ]
    for side in (-1, 1):
        ring = np.array([edge for edge in near if np.sign(vertices[edge, 0].mean()) == side])
        middle = vertices[ring[:, 0]].mean(axis=0) + [0, 0, 0.004]
        vertices = np.concatenate([vertices, middle[None]])
        faces = np.concatenate([faces, [(b, a, len(vertices) - 1) for a, b in ring]])
    return vertices, faces


ROUND = Shape(width=0.6, length=-0.5, lips=0.6, mouth_width=0.5, nose_width=0.5, cheeks=0.6, chin=-0.3, eye_size=0.3)
LONG = Shape(width=-0.5, length=0.8, lips=-0.5, mouth_width=-0.6, nose_length=0.8, jaw=-0.4, chin=0.7, brow_ridge=0.5)
STRONG = Shape(
    width=0.3, length=0.5, jaw=0.9, chin_width=0.8, lips=0.8, mouth_width=0.9, nose_bridge=0.6, forehead=-0.4
)
YOUNG = Shape(
    width=0.2, length=-0.9, lips=0.4, mouth_width=-0.4, nose_length=-0.8, eye_size=0.9, eye_gap=0.6, cheeks=0.8
)


def mask() -> Head:
    """A registered mask of BIWI's kind: millimetres, open back, slit lips, no mouth behind them, eyes closed over."""
    vertices, faces = person(ROUND, *INTERIOR, "teeth", "eyeball", "pupil", "lid_inner", "ear")
    kept = (vertices[:, 2] > 0.018) & (vertices[:, 1] > -0.093) & (vertices[:, 1] < 0.085)
    vertices, faces = cleaned(vertices, faces[kept[faces].all(axis=1)])
    vertices, faces = finer(*patch_eyes(vertices, faces), 2)
    return shuffled(laid(Head(vertices, faces), 1000.0, turned(-6, 4, 0), (12, -30, 55)))


def slit_mask() -> Head:
    """The same idea with fewer triangles and lips that share their places: a cut without a width."""
    vertices, faces = person(Shape(), *INTERIOR, "teeth", "eyeball", "pupil", "lid_inner", "ear")
    kept = (vertices[:, 2] > 0.03) & (vertices[:, 1] > -0.09) & (vertices[:, 1] < 0.075)
    vertices, faces = cleaned(vertices, faces[kept[faces].all(axis=1)])
    return shuffled(laid(Head(*finer(vertices, faces)), 100.0, np.eye(3)))


def registered() -> Head:
    """A head of FLAME's kind: metres, lips that touch and fold in by a few millimetres, whole eyeballs, open neck."""
    vertices, faces = person(LONG, "mouth_bag", "mouth_back", "teeth", "eyeball", "pupil")
    vertices = vertices + 0.006 * np.exp(-np.square((vertices - [0, -0.05, 0.09]) / [0.05, 0.03, 0.06]).sum(1))[
        :, None
    ] * [0, 1, 0]
    head = joined(skin=finer(vertices, faces, 1), **eyeballs(LONG))
    return shuffled(laid(head, 1.07, turned(0, 0, 0), (0.0, -0.02, -0.03)))


def avatar_head() -> Head:
    """An avatar's head: centimetres, mouth bag, teeth, tongue, eyeballs, lips that touch, stylised proportions."""
    vertices, faces = person(YOUNG, "teeth", "eyeball", "pupil")
    head = joined(skin=finer(vertices, faces, 2), **eyeballs(YOUNG), **teeth(YOUNG))
    head.vertices = head.vertices * [1.12, 0.94, 1.05]
    return shuffled(laid(head, 100.0, turned(0, 0, 0), (0, 160, 3)))


def coarse() -> Head:
    """Decimated to vertices of its own: about 1500, uneven."""
    vertices, faces = person(STRONG, "teeth", "eyeball", "pupil")
    return shuffled(Head(*coarser(*finer(vertices, faces, 2), 0.9)))


def remeshed() -> Head:
    """Re-meshed: cut to short edges, then decimated; lips are ragged, z points up."""
    vertices, faces = person(LONG, "teeth", "eyeball", "pupil", "ear")
    vertices, faces = finer(vertices, faces)
    vertices, faces = trimesh.remesh.subdivide_to_size(vertices, faces, 0.005)
    vertices, faces = cleaned(vertices, faces)
    merged = trimesh.Trimesh(vertices, faces, process=False)
    merged.merge_vertices(digits_vertex=7)
    made = coarser(np.array(merged.vertices), np.array(merged.faces), 0.6)
    return shuffled(laid(Head(*made), 1000.0, turned(90, 0, 0)))


def scan(*, sealed: bool = False) -> Head:
    """A scan: crooked, noisy, tilted, with a ragged border and specks; the lips are cut, or sealed."""
    vertices, faces = person(STRONG, *INTERIOR, "teeth", "eyeball", "pupil", "lid_inner")
    if sealed:
        vertices, faces = sealed_lips(vertices, faces)
    vertices, faces = finer(*patch_eyes(vertices, faces), 2)
    x, y, z = vertices.T
    swollen = np.exp(-np.square((vertices - [0.04, -0.03, 0.06]) / 0.03).sum(1))
    vertices = vertices + np.stack(
        [0.004 * swollen + 0.03 * y * (y < 0) * 0.5, 0.05 * x * (z > 0.03), 0.006 * swollen], 1
    )
    vertices = vertices + np.random.default_rng(0).normal(0, 0.00012, vertices.shape)
    kept = (vertices[:, 2] > -0.02 + 0.01 * np.sin(90 * vertices[:, 1])) & (vertices[:, 1] > -0.12)
    vertices, faces = cleaned(vertices, faces[kept[faces].all(axis=1)])
    speck = np.array([[0.2, 0.1, 0.0], [0.204, 0.1, 0.0], [0.2, 0.104, 0.0], [0.2, 0.1, 0.004]])
    made = joined(skin=(vertices, faces), speck=(speck, np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])))
    made = shuffled(laid(made, 1000.0, turned(14, -18, 9), (300, 120, -800)))
    made.alive = not sealed
    return made


def sealed_lips(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """One skin over the mouth: what upper and lower lip have in one place becomes one vertex."""
    _, first, place = np.unique(np.rint(1e6 * vertices), axis=0, return_index=True, return_inverse=True)
    return cleaned(vertices, first[place.reshape(-1)][faces])


def whole_avatar() -> Head:
    """A whole figure in a T-pose of eight parts, centimetres with z up: the face is a twentieth of it."""
    vertices, faces = person(YOUNG, "teeth", "eyeball", "pupil")
    hair = trimesh.creation.icosphere(3)
    shell = np.array(hair.vertices) * [0.083, 0.085, 0.105] + [0, 0.066, -0.018]
    keep = (shell[:, 2] < 0.055) & (shell[:, 1] > -0.02)
    torso = trimesh.creation.capsule(height=0.9, radius=0.16, count=[16, 16])
    arms = trimesh.creation.capsule(height=1.5, radius=0.05, count=[12, 12])
    body = np.array(torso.vertices) @ turned(90, 0, 0).T * [1, 1, 0.7]
    body -= [0, body[:, 1].max() + 0.13, 0.02]
    wide = np.array(arms.vertices) @ turned(0, 90, 0).T
    wide -= [wide[:, 0].mean(), 0.22, 0.02]
    head = joined(
        body=(np.concatenate([body, wide]), np.concatenate([torso.faces, np.array(arms.faces) + len(body)])),
        head=finer(vertices, faces, 1),
        **eyeballs(YOUNG, 2),
        **teeth(YOUNG),
        hair=cleaned(shell, np.array(hair.faces)[keep[hair.faces].all(axis=1)]),
    )
    return laid(head, 100.0, turned(90, 0, 0), (0, 0, 150))


def lower_face() -> Head:
    """A mask that ends below the eyes, in another unit and far from any usual pose: it needs landmarks."""
    vertices, faces = person(YOUNG, *INTERIOR, "teeth", "eyeball", "pupil", "lid_inner", "ear")
    kept = (vertices[:, 2] > 0.03) & (vertices[:, 1] > -0.1) & (vertices[:, 1] < 0.005)
    vertices, faces = cleaned(vertices, faces[kept[faces].all(axis=1)])
    return laid(Head(*finer(vertices, faces)), 3.0, turned(20, 140, 0))


INSIDE_LIDS = ("lid_edge", "lid_behind", "lid_end")
INSIDE_MOUTH = ("lip_roll", "mouth_front", "mouth_bag", "mouth_back")
BALLS = ("ball_", "iris_", "pupil", "glint")
APART = ("teeth", "tongue", "hair", "brow_", "lash_", *BALLS)


def second(face: Face, *without: str, **pose: float) -> Mesh:
    """A person with the built-in head in metres, posed by ARKit's shapes, without the named groups of vertices."""
    mesh = build_head()
    gone = np.zeros(len(mesh.vertices), bool)
    if without:
        gone[mesh.both(*without)] = True
    return cleaned(second_places(face, **pose), mesh.faces[~gone[mesh.faces].any(axis=1)])


def only(face: Face, *groups: str) -> Mesh:
    """Some groups of a person with the built-in head."""
    mesh = build_head()
    return second(face, *(name for name in mesh.groups if not name.startswith(groups)))


def talking_second() -> Animation:
    """What :func:`talking` does, on the average head with the built-in head: (13, 5875, 3)."""
    pairs = lip_pairs_of_head(build_head())
    poses: list[dict[str, float]] = [
        {},
        {"jawOpen": 0.3},
        {"jawOpen": 0.5},
        {"jawOpen": 0.8},
        {"jawOpen": 0.4, "mouthPucker": 0.8},
        {"jawOpen": 0.2, "mouthFunnel": 1.0},
        {"jawOpen": 0.3, "mouthStretchLeft": 0.9, "mouthStretchRight": 0.9},
        {"mouthUpperUpLeft": 0.8, "mouthUpperUpRight": 0.8, "mouthLowerDownLeft": 0.8, "mouthLowerDownRight": 0.8},
        {"jawOpen": 0.3, "mouthSmileLeft": 0.8, "mouthSmileRight": 0.8},
        {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
        {"browInnerUp": 1.0, "browOuterUpLeft": 1.0, "browOuterUpRight": 1.0},
        {"browDownLeft": 1.0, "browDownRight": 1.0, "noseSneerLeft": 0.8, "noseSneerRight": 0.8},
        {},
    ]
    vertices = np.stack([second_places(Face(), **pose) for pose in poses]).astype(np.float32)
    return Animation(
        "talking",
        vertices,
        vertices[0].copy(),
        25.0,
        faces=np.asarray(build_head().faces, np.int32),
        colours=build_head().colours,
        inner_lip_pairs=np.stack(pairs, axis=1),
    )


WIDE = Face(sex=0.5, width=0.6, eye_gap=0.8, nose_width=0.8, brow_ridge=0.8, mouth_width=0.5)
NARROW = Face(sex=-0.6, width=-0.7, eye_size=-0.6, eye_gap=-0.6, length=0.5, lips=-0.4)
TILTED = Face(sex=-0.8, eye_size=0.8, eye_tilt=0.9, cheekbones=0.8, nose_length=-0.6, forehead=0.7)


def sockets() -> Head:
    """A head of ICT-FaceKit's kind: lids with thickness, eyeballs, lashes as cards, brows, teeth, hair; centimetres."""
    groups = {"balls": BALLS, "lashes": ("lash_",), "brows": ("brow_",), "teeth": ("teeth",), "tongue": ("tongue",)}
    skin = second(WIDE, *APART)
    head = joined(skin=finer(*skin), **{name: only(WIDE, *own) for name, own in groups.items()})
    return shuffled(laid(head, 100.0, np.eye(3), (0, 165, 4)))


def eye_holes() -> Head:
    """A mask of BIWI's kind with holes for eyes whose lids stand wide open, and nothing behind them; millimetres."""
    opened = {"eyeWideLeft": 1.0, "eyeWideRight": 1.0}
    vertices, faces = second(NARROW, *APART, *INSIDE_LIDS, *INSIDE_MOUTH, "ear_", **opened)
    kept = (vertices[:, 2] > 0.02) & (vertices[:, 1] > -0.1)
    vertices, faces = cleaned(vertices, faces[kept[faces].all(axis=1)])
    return shuffled(laid(Head(*finer(vertices, faces)), 1000.0, turned(-5, 3, 0), (12, -30, 55)))


def painted_eyes() -> Head:
    """Eyes that are shut for good: one skin with a crease where the lids meet."""
    shut = {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}
    vertices, faces = second(TILTED, *APART, *INSIDE_LIDS, **shut)
    loop, mesh = build_head().groups["eye_edge"], build_head()
    rest = second_places(TILTED, **shut)
    for ring in (loop, mesh.mirror[loop]):
        own = np.array([np.linalg.norm(vertices - rest[v], axis=1).argmin() for v in ring])
        half = len(own) // 2
        for upper, lower in zip(own[1:half], own[:half:-1], strict=True):
            faces = np.where(faces == upper, lower, faces)
    return shuffled(laid(Head(*finer(*cleaned(vertices, faces))), 1.0, np.eye(3)))


def second_places(face: Face, **pose: float) -> np.ndarray:
    """All vertices of a person with the built-in head in metres, posed."""
    mesh, shapes = build_head(), head_shapes()
    posed = mesh.vertices + sum((pose[name] * shapes[name] for name in pose), np.zeros_like(mesh.vertices))
    return np.asarray(face(posed) / 1000.0)


def uneven_eyes() -> Head:
    """One eye half shut at rest, the face crooked and wider than high."""
    vertices, faces = second(NARROW, *APART, eyeBlinkLeft=0.4)
    head = joined(skin=(vertices, faces), balls=only(NARROW, *BALLS))
    x, y, z = head.vertices.T
    head.vertices = np.stack([1.12 * x + 0.02 * y, 0.95 * y + 0.03 * x, 1.05 * z], axis=1)
    return shuffled(laid(head, 1000.0, turned(4, -7, 3), (30, 10, -80)))


def large_eyes() -> Head:
    """A stylised head: eyes half as large again as a person's, a small nose, z up."""
    points = second(TILTED, *APART), only(TILTED, *BALLS)
    made = []
    for vertices, faces in points:
        about = np.stack([np.sign(vertices[:, 0]) * 0.0335, np.full(len(vertices), 0.0245), vertices[:, 2]], axis=1)
        away = np.linalg.norm((vertices - about)[:, :2], axis=1)
        grown = 1.0 + 0.4 / (1.0 + (away / 0.022) ** 4) * np.clip(np.abs(vertices[:, 0]) / 0.012, 0, 1)
        made.append((np.concatenate([(about + (vertices - about) * grown[:, None])[:, :2], vertices[:, 2:]], 1), faces))
    head = joined(skin=finer(*made[0]), balls=made[1])
    return shuffled(laid(head, 100.0, turned(90, 0, 0)))


def few_triangles() -> Head:
    """About 500 vertices for the skin, and two eyeballs."""
    skin = coarser(*second(WIDE, *APART, "ear_", "nostril"), 0.8)
    return shuffled(joined(skin=skin, balls=only(WIDE, *BALLS)))


def dense() -> Head:
    """About 25 000 vertices, decimated from four times as many, with eyeballs and lashes; metres."""
    skin = coarser(*finer(*second(TILTED, *APART), 2), 0.6)
    return shuffled(joined(skin=skin, balls=only(TILTED, *BALLS), lashes=only(TILTED, "lash_")))


def dressed_avatar() -> Head:
    """A figure with eyeballs, lashes, brows, teeth, hair, glasses with pads, a hat and earrings; centimetres."""
    skin = second(NARROW, *APART)
    groups = {"balls": BALLS, "lashes": ("lash_",), "brows": ("brow_",), "teeth": ("teeth",), "hair": ("hair",)}
    parts = {name: only(NARROW, *own) for name, own in groups.items()}
    middle = parts["balls"][0][parts["balls"][0][:, 0] > 0].mean(axis=0) * [1, 1, 0] + [0, 0, 0.088]
    for side, sign in (("left", 1), ("right", -1)):
        lens = trimesh.creation.torus(0.021, 0.0012, major_sections=24, minor_sections=6)
        parts[f"lens_{side}"] = (np.array(lens.vertices) + middle * [sign, 1, 1], np.array(lens.faces))
        bow = trimesh.creation.box((0.002, 0.004, 0.1)).subdivide()
        parts[f"bow_{side}"] = (np.array(bow.vertices) + [sign * 0.078, middle[1], 0.04], np.array(bow.faces))
        drop = trimesh.creation.icosphere(1, 0.004)
        parts[f"earring_{side}"] = (np.array(drop.vertices) + [sign * 0.083, -0.036, -0.004], np.array(drop.faces))
    bridge = trimesh.creation.box((0.022, 0.002, 0.002)).subdivide()
    parts["bridge"] = (np.array(bridge.vertices) + [0, middle[1], 0.0885], np.array(bridge.faces))
    hat = trimesh.creation.icosphere(2)
    parts["hat"] = (np.array(hat.vertices) * [0.09, 0.03, 0.11] + [0, 0.125, 0.0], np.array(hat.faces))
    torso = trimesh.creation.capsule(height=0.9, radius=0.16, count=[16, 16])
    body = np.array(torso.vertices) @ turned(90, 0, 0).T * [1, 1, 0.7]
    parts["body"] = (body - [0, body[:, 1].max() + 0.19, 0.02], np.array(torso.faces))
    return laid(joined(skin=skin, **parts), 100.0, np.eye(3), (0, 150, 0))


LOWER_MARKS = ("chin", "mouth_corner_left", "mouth_corner_right", "nose_base", "upper_lip_top", "lower_lip_bottom")
"""Landmarks that :func:`lower_face` shows."""


def lower_face_marks(head: Head) -> dict[str, int]:
    """The vertices of the head's named places: those nearest to the person's own."""
    places = 3.0 * build_rig(YOUNG).neutral @ turned(20, 140, 0).T
    return {name: int(np.linalg.norm(head.vertices - places[LANDMARKS[name]], axis=1).argmin()) for name in LOWER_MARKS}


FAMILY: dict[str, Callable[[], Head]] = {
    "mask": mask,
    "slit mask": slit_mask,
    "registered head": registered,
    "avatar head": avatar_head,
    "decimated head": coarse,
    "re-meshed head": remeshed,
    "scan": scan,
    "whole avatar": whole_avatar,
    "sealed scan": lambda: scan(sealed=True),
    "sockets and lashes": sockets,
    "eye holes": eye_holes,
    "painted eyes": painted_eyes,
    "uneven eyes": uneven_eyes,
    "large eyes": large_eyes,
    "few triangles": few_triangles,
    "dense head": dense,
    "dressed avatar": dressed_avatar,
}
