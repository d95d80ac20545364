"""Draw the head of the built-in corpus: views, expressions, speech sounds, wireframe and people.

    python tools/puppet_sheet.py docs/images/puppet_head.webp

Rows: front, three quarters, side, wireframe; rest, smile, brows up, frown; /a/, /o/, /f/, /m/; open eyes, half a
blink, a whole blink, a glance; and the ten of the cast. Needs the extras ``render`` and ``puppet``.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from facediff.render import contact_sheet  # noqa: E402
from facediff.render.rasteriser import FIELD_OF_VIEW, Camera, Renderer, opencv  # noqa: E402
from facediff.spaces.arkit import LEFT_AND_RIGHT  # noqa: E402
from facediff.synthetic.articulation import LIP_AT_TEETH  # noqa: E402
from facediff.synthetic.cast import CAST  # noqa: E402
from facediff.synthetic.head.mesh import QuadMesh  # noqa: E402
from facediff.synthetic.head.parts import build_head  # noqa: E402
from facediff.synthetic.head.people import Complexion, coloured, dressed  # noqa: E402
from facediff.synthetic.head.rig import head_shapes  # noqa: E402

Points = NDArray[np.float64]
Picture = NDArray[np.uint8]

SIZE = 300
EXPRESSIONS: dict[str, dict[str, float]] = {
    "rest": {},
    "smile": {"mouthSmile": 0.9, "cheekSquint": 0.5, "eyeSquint": 0.3},
    "brows up": {"browInnerUp": 1.0, "browOuterUp": 0.8, "eyeWide": 0.6},
    "frown": {"browDown": 1.0, "noseSneer": 0.4, "mouthFrown": 0.7},
    "/a/": {"jawOpen": 0.5, "mouthLowerDown": 0.3},
    "/o/": {"jawOpen": 0.3, "mouthFunnel": 0.6, "mouthPucker": 0.5},
    "/f/": LIP_AT_TEETH,
    "/m/": {"jawOpen": 0.15, "mouthClose": 0.15, "mouthPress": 0.45},
}
BLINKS: dict[str, dict[str, float]] = {
    "open": {},
    "half a blink": {"eyeBlink": 0.5},
    "a whole blink": {"eyeBlink": 1.0},
    "a glance": {"eyeLookOutLeft": 0.6, "eyeLookInRight": 0.6, "eyeLookUp": 0.2},
}


def camera(centre: tuple[float, float, float], turn: float, height: float) -> Camera:
    """A camera that looks at a point in mm, turned by degrees, and shows so many mm of height there."""
    cos, sin = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    rotation = ((cos, 0.0, -sin), (0.0, 1.0, 0.0), (sin, 0.0, cos))
    return Camera(centre, rotation, 0.5 * height / math.tan(FIELD_OF_VIEW / 2), 1000.0)


def posed(weights: dict[str, float]) -> NDArray[np.float64]:
    """The average head with some weights; a name without a side stands for both."""
    vertices, shapes = build_head().vertices.copy(), head_shapes()
    for name, weight in weights.items():
        for side in ("Left", "Right") if name in LEFT_AND_RIGHT else ("",):
            vertices += weight * shapes[name + side]
    return vertices


def wireframe(view: Camera) -> NDArray[np.uint8]:
    """The quads that look to the camera, drawn over a grey head."""
    mesh = build_head()
    grey = np.full((len(mesh.vertices), 3), 205, np.uint8)
    picture = Renderer(mesh.faces, template=mesh.vertices, size=SIZE, camera=view, colours=grey).render(mesh.vertices)
    points = view.to_camera(mesh.vertices)
    focal = 0.5 * SIZE / math.tan(FIELD_OF_VIEW / 2)
    places = 0.5 * SIZE + focal * points[:, :2] * [1.0, -1.0] / -points[:, 2:]
    corners = points[mesh.quads]
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    shown = np.isin(mesh.quads, mesh.both("skin", "mouth_", "lip_", "eye_", "ear_", "nostril")).all(axis=1)
    facing = mesh.quads[((normals * -corners.mean(axis=1)).sum(axis=1) > 0) & shown]
    lines = [np.rint(8 * places[quad]).astype(np.int32) for quad in facing]
    cv2 = opencv()
    cv2.polylines(picture, lines, True, (40, 40, 70), 1, cv2.LINE_AA, 3)
    return picture


def main() -> None:
    """Draw the sheet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output", type=Path, help="a .webp file")
    options = parser.parse_args()
    pictures, labels = sheet()
    Image.fromarray(contact_sheet(pictures, 4, labels=labels)).save(options.output, quality=85, method=6)
    mesh = build_head()
    print(f"{options.output}: {len(mesh.vertices)} vertices, {len(mesh.quads)} quads")


def sheet() -> tuple[list[Picture], list[str]]:
    """Everything that the head can do, with labels."""
    mesh = build_head()
    average = coloured(mesh, Complexion())
    pictures = [draw(mesh, mesh.vertices, camera((0, -25, 0), turn, 350), average) for turn in (0, 40, 90)]
    pictures.append(wireframe(camera((0, -10, 40), 25, 230)))
    labels = ["front", "three quarters", "side", "quads"]
    for (name, weights), turn in zip(EXPRESSIONS.items(), (0, 0, 0, 0, 20, 40, 20, 20), strict=True):
        pictures.append(draw(mesh, posed(weights), camera((0, -12, 50), turn, 205), average))
        labels.append(name)
    for name, weights in BLINKS.items():
        pictures.append(draw(mesh, posed(weights), camera((31, 27, 60), 10, 62), average))
        labels.append(name)
    for name, member in CAST.items():
        vertices = dressed(member.face, mesh, member.complexion)
        colours = coloured(mesh, member.complexion)
        pictures.append(draw(mesh, vertices, camera((0, -25, 0), 25, 350), colours, vertices))
        labels.append(name)
    return pictures, labels


def draw(mesh: QuadMesh, vertices: Points, view: Camera, colours: Picture, rest: Points | None = None) -> Picture:
    """One picture; ``rest`` is the face at rest where it is not the mesh's own."""
    template = mesh.vertices if rest is None else rest
    return Renderer(mesh.faces, template=template, size=SIZE, camera=view, colours=colours).render(vertices)


if __name__ == "__main__":
    main()
