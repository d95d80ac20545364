"""Texture coordinates, materials and pictures of an .obj or .glb, as the export formats write them.

An .obj names a material file, and that names pictures. Both are looked for in the folder of the .obj alone, so that a
file from elsewhere opens nothing outside of it. A .glb holds its pictures itself.
"""

from __future__ import annotations

import io
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, damaged, needs_extra
from facediff.mesh.glb import Glb, attributes, open_glb, whole_number
from facediff.mesh.glb_scene import placed_parts
from facediff.utils.colours import to_srgb
from facediff.utils.limits import in_range
from facediff.utils.numerics import Array, Indices, Integers

PICTURES = {b"\x89PNG\r\n\x1a\n": ("image/png", ".png"), b"\xff\xd8\xff": ("image/jpeg", ".jpg")}
"""How pictures begin that programs for glTF and USD read, their type and suffix."""


@dataclass(frozen=True, eq=False)
class Material:
    """A material: its name, its colour (sRGB from 0 to 1), and the picture that colours it instead."""

    name: str
    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)
    picture: Path | bytes | None = None

    def picture_bytes(self) -> tuple[bytes, str, str] | None:
        """The picture, its type, and the suffix for it."""
        if self.picture is None:
            return None
        data = self.picture if isinstance(self.picture, bytes) else self.picture.read_bytes()
        return next(((data, *about) for start, about in PICTURES.items() if data.startswith(start)), None)


@dataclass(frozen=True, eq=False)
class Textures:
    """The surface of a mesh file.

    Attributes:
        uvs: (M, 2) texture coordinates, v upwards.
        corners: (F, 3) number of each corner's coordinate, triangles as :func:`facediff.mesh.read_mesh` reads them.
        materials: the materials of the triangles.
        of_face: (F,) number of each triangle's material.
        losses: properties that are not carried over, a sentence each.
    """

    uvs: Array
    corners: Indices
    materials: tuple[Material, ...]
    of_face: Indices
    losses: tuple[str, ...] = ()

    def turned(self, triangles: Integers, outward: Integers) -> Indices:
        """The corners for the same triangles (F, 3) with their vertices in another order."""
        order = (outward[:, :, None] == triangles[:, None, :]).argmax(axis=2)
        return np.take_along_axis(self.corners, order, axis=1)

    def at_vertices(self, triangles: Integers, count: int) -> npt.NDArray[np.uint8]:
        """Colours (count, 3) of the vertices of the triangles (F, 3): of the pictures, or else of the materials."""
        with needs_extra("PIL", "render", "reading pictures"):
            from PIL import Image
        colours = np.full((count, 3), 200, np.uint8)
        for number, material in enumerate(self.materials):
            some = self.of_face == number
            vertices, (u, v) = triangles[some].ravel(), self.uvs[self.corners[some].ravel()].T
            if (picture := material.picture_bytes()) is None:
                colours[vertices] = np.rint(255 * np.array(material.colour))
                continue
            pixels = np.asarray(Image.open(io.BytesIO(picture[0])).convert("RGB"))
            height, width, _ = pixels.shape
            # Coordinates beyond 0 to 1 repeat the picture.
            row, column = ((1 - v) % 1 * height).astype(int), (u % 1 * width).astype(int)
            colours[vertices] = pixels[np.minimum(row, height - 1), np.minimum(column, width - 1)]
        return colours


def has_textures(path: Path) -> bool:
    """Whether a file is an .obj with texture coordinates, or a .glb with a material that has a picture."""
    if not path.is_file():
        return False
    if path.suffix.lower() == ".glb":
        with suppress(FaceDiffError), damaged(path, ""):  # the reader of meshes says what is wrong
            return _has_picture(open_glb(path))
    if path.suffix.lower() != ".obj":
        return False
    with path.open("rb") as stream:
        return any(line.startswith((b"vt ", b"vt\t")) for line in stream)


def hands_on_textures(path: Path, output: Path) -> bool:
    """Whether an output gets a mesh file's textures without being a copy of it: a .glb's own go into its copy alone."""
    return not (path.suffix.lower() == output.suffix.lower() == ".glb") and has_textures(path)


def mesh_files(path: Path) -> list[Path]:
    """A mesh file, and of an .obj the material files and pictures that it names."""
    found = [path]
    for file in found:  # which grows: a material file names pictures
        if file.suffix.lower() in (".obj", ".mtl"):
            for line in file.read_bytes().decode("utf-8-sig", errors="replace").splitlines():
                word, _, rest = line.strip().replace("\t", " ").partition(" ")
                beside = _beside(path, _file_name(rest)) if word in ("mtllib", "map_Kd") else None
                found += [beside] if beside is not None and beside not in found else []
    return found


def read_textures(path: Path, n_triangles: int) -> Textures:
    """Texture coordinates and materials of an .obj or .glb."""
    reader = {".glb": _read_glb, ".obj": _read_obj}.get(path.suffix.lower()) if path.is_file() else None
    with damaged(path, f"not a readable {path.suffix[1:].upper()} mesh, export it again"):
        surface = None if reader is None else reader(path)
    if surface is None:
        raise FaceDiffError(
            f"{path}: has no texture coordinates; expected an .obj with lines `vt u v`, or a .glb with a picture"
        )
    if len(surface.corners) != n_triangles:
        raise FaceDiffError(
            f"{path}: has {len(surface.corners)} triangles and the animation's mesh {n_triangles}; give the file of "
            f"that mesh"
        )
    return surface


def _read_obj(path: Path) -> Textures | None:
    uvs: list[tuple[float, float]] = []
    corners: list[tuple[int, int, int]] = []
    libraries: list[str] = []
    names, of_face, current = {"": 0}, [], 0
    for line in path.read_bytes().decode("utf-8-sig", errors="replace").splitlines():
        word, _, rest = line.strip().replace("\t", " ").partition(" ")
        if word == "vt":
            u, v = rest.split()[:2]
            uvs.append((float(u), float(v)))
        elif word == "f":
            cells = [corner.split("/") for corner in rest.split()]
            numbers = [int(cell[1]) if len(cell) > 1 and cell[1] else 0 for cell in cells]
            # Numbers count from 1, or backwards from the coordinates read so far if they are negative; 0 is none.
            rows = [number - 1 if number > 0 else len(uvs) + number if number else -1 for number in numbers]
            # Polygons become fans, as in the mesh itself.
            corners += [(rows[0], b, c) for b, c in zip(rows[1:-1], rows[2:], strict=True)]
            of_face += [current] * (len(rows) - 2)
        elif word == "usemtl":
            current = names.setdefault(rest.strip(), len(names))
        elif word == "mtllib":
            libraries.append(rest.strip())
    if not uvs:
        return None
    table, coordinates = np.array(corners, np.int64), np.array(uvs, np.float64)
    if not len(table) or table.max() >= len(uvs) or table.min() < -1 or not in_range(coordinates):
        raise ValueError("a face names a texture coordinate that does not exist")
    if (table < 0).any():  # corners without a coordinate get one of their own
        table[table < 0] = len(coordinates)
        coordinates = np.concatenate([coordinates, np.zeros((1, 2))])
    losses: list[str] = []
    library = _materials(path, libraries, losses)
    numbers_in_use = np.unique(np.array(of_face))
    every = list(names)
    materials = tuple(library.get(every[number], Material(every[number] or "surface")) for number in numbers_in_use)
    return Textures(
        coordinates, table, materials, np.searchsorted(numbers_in_use, of_face), tuple(dict.fromkeys(losses))
    )


def _materials(path: Path, libraries: list[str], losses: list[str]) -> dict[str, Material]:
    """Materials by their names; adds a sentence to ``losses`` for each missing file or picture."""
    result: dict[str, Material] = {}
    pictures: dict[str, Path | None] = {}
    for library in dict.fromkeys(libraries):
        file = _beside(path, library)
        if file is None:
            losses.append(f"the material file {library} is not in the folder of {path.name}: materials are grey")
            continue
        name, left_out = "", set()
        for line in file.read_bytes().decode("utf-8-sig", errors="replace").splitlines():
            word, _, rest = line.strip().replace("\t", " ").partition(" ")
            if word == "newmtl":
                name = rest.strip()
                result[name] = Material(name)
            elif word == "Kd" and name:
                result[name] = Material(name, _colour(rest), result[name].picture)
            elif word == "map_Kd" and name:
                text = _file_name(rest)
                if text not in pictures:
                    beside = _beside(path, text)
                    is_picture = beside is not None and Material(name, picture=beside).picture_bytes()
                    pictures[text] = beside if is_picture else None
                if (picture := pictures[text]) is None:
                    losses.append(f"the picture {text} is no .png or .jpg in the folder of {path.name}: it is left out")
                else:
                    result[name] = Material(name, result[name].colour, picture)
            elif word.lower().startswith(("map_", "bump", "norm")) or (
                word == "d" and rest.strip() not in ("1", "1.0")
            ):
                left_out.add(word)
        if names := ", ".join(sorted(left_out)):
            losses.append(f"colours and their pictures are carried over, and {names} of {library} left out")
    return result


def _colour(text: str) -> tuple[float, float, float]:
    try:
        red, green, blue = (min(max(0.0, float(number)), 1.0) for number in text.split()[:3])
    except ValueError:
        return Material("").colour
    return red, green, blue


def _file_name(rest: str) -> str:
    # Options such as -o 0 0 0 stand before the name, which may have spaces.
    return rest.split()[-1] if rest.strip().startswith("-") else rest.strip()


def _beside(path: Path, name: str) -> Path | None:
    """A file that an .obj names, if it lies in its folder or below; by its name alone where folders have changed."""
    folder = path.resolve().parent
    relative = PurePosixPath(name.replace("\\", "/"))
    for candidate in (relative, PurePosixPath(relative.name)):
        # Resolved first, so that neither `..` nor a link leads out of the folder: files from elsewhere name anything.
        with suppress(OSError, RuntimeError, ValueError):  # too long, a loop of links, or no name at all
            file = (folder / candidate).resolve()
            if file.is_relative_to(folder) and file.is_file():
                return file
    return None


# glTF. Only what other formats have too is read: a colour, or a picture with its coordinates.

ELSEWHERE = ("normalTexture", "occlusionTexture", "emissiveTexture", "alphaMode")


def _base_picture(material: dict[str, Any]) -> dict[str, Any]:
    """A material's entry for its colour texture; empty if there is none."""
    look = material.get("pbrMetallicRoughness", {})
    texture = look.get("baseColorTexture", {}) if isinstance(look, dict) else {}
    return texture if isinstance(texture, dict) else {}


def _has_picture(glb: Glb) -> bool:
    return any(_base_picture(material) for material in glb.entries("materials"))


def _read_glb(path: Path) -> Textures | None:
    glb, losses = open_glb(path), list[str]()
    if not _has_picture(glb):
        return None
    numbers: dict[int, int] = {}  # of the materials here, by those of the file's; -1 for parts without one
    materials: list[Material] = []
    uvs, corners, of_face, before = [], [], [], 0
    for part in placed_parts(glb):
        index = part.primitive["material"] if part.material else -1
        if index not in numbers:
            numbers[index] = len(materials)
            materials.append(_material(glb, part.material, path, losses))
        accessor = attributes(part.primitive).get(
            f"TEXCOORD_{whole_number(_base_picture(part.material), 'texCoord', 0)}"
        )
        coordinates = np.zeros((len(part.local), 2))
        if accessor is not None:
            coordinates += glb.numbers(accessor, "VEC2", ("f4", "u1", "u2"), len(part.local))
        uvs.append(coordinates * [1, -1] + [0, 1])  # v upwards
        corners.append(part.faces + before)
        of_face.append(np.full(len(part.faces), numbers[index]))
        before += len(part.local)
    table = np.concatenate(uvs)
    left_out = sorted({word for material in glb.entries("materials") for word in ELSEWHERE if word in material})
    if left_out:
        losses.append(f"colours and their pictures are carried over, and {', '.join(left_out)} of {path.name} left out")
    # Material files of .obj need names of their own, for which glTF does not ask.
    counts = Counter(material.name for material in materials)
    unique = [
        replace(material, name=f"{material.name}_{number}") if counts[material.name] > 1 else material
        for number, material in enumerate(materials)
    ]
    return Textures(
        table, np.concatenate(corners), tuple(unique), np.concatenate(of_face), tuple(dict.fromkeys(losses))
    )


def _material(glb: Glb, material: dict[str, Any], path: Path, losses: list[str]) -> Material:
    """A material of a file as other formats have it; adds a sentence to ``losses`` for a picture that is left out."""
    name = "_".join(str(material.get("name", "")).split()) or "surface"
    look, texture = material.get("pbrMetallicRoughness", {}), _base_picture(material)
    factor = look.get("baseColorFactor", [1, 1, 1, 1]) if isinstance(look, dict) else [1, 1, 1, 1]
    red, green, blue = (float(value) for value in to_srgb(np.array(factor[:3], np.float64).clip(0, 1)))
    if not texture:
        return Material(name, (red, green, blue))
    data = b""
    # A picture may be of a kind that glTF itself does not know, in another file, or damaged.
    with suppress(FaceDiffError), damaged(path, ""):
        image = glb.entry("images", glb.entry("textures", texture.get("index")).get("source"))
        data = glb.piece(image.get("bufferView"))
    if "KHR_texture_transform" in str(texture.get("extensions", "")) or not data.startswith(tuple(PICTURES)):
        losses.append(
            f"the picture of {name} is no .png or .jpg in {path.name}, or moved on its surface: it is left out"
        )
        return Material(name, (red, green, blue))
    return Material(name, (red, green, blue), data)
