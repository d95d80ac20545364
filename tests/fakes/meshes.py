"""Meshes of known shape."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def sphere(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of radius one around the origin: rows · columns + 2 vertices, faces wound to the outside."""
    height, turn = np.meshgrid(
        np.pi * np.arange(1, rows + 1) / (rows + 1), 2 * np.pi * np.arange(columns) / columns, indexing="ij"
    )
    ring = np.stack([np.sin(height) * np.cos(turn), np.sin(height) * np.sin(turn), np.cos(height)], -1).reshape(-1, 3)
    row, column = (part.ravel() for part in np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij"))
    following = (column + 1) % columns
    a, b = row * columns + column, row * columns + following
    c, d = a + columns, b + columns
    top, last, around = rows * columns, (rows - 1) * columns, np.arange(columns)
    cap = np.stack([np.full(columns, top), around, (around + 1) % columns], 1)
    foot = np.stack([np.full(columns, top + 1), last + (around + 1) % columns, last + around], 1)
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1), cap, foot])
    return np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]]), faces


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a mesh in text."""
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(lines) + "\n")


def relief(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """An open, curved sheet with a ridge in its middle, like a face: rows · columns vertices, seen from +z."""
    y, x = np.meshgrid(np.linspace(1, -1, rows), np.linspace(-0.8, 0.8, columns), indexing="ij")
    z = 1 - 0.6 * x**2 - 0.3 * y**2 + 0.3 * np.exp(-((x / 0.2) ** 2) - (y / 0.3) ** 2)
    row, column = (part.ravel() for part in np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij"))
    a = row * columns + column
    faces = np.concatenate([np.stack([a, a + columns, a + 1], 1), np.stack([a + 1, a + columns, a + columns + 1], 1)])
    return np.stack([x, y, z], -1).reshape(-1, 3), faces


def together(*meshes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one with separate parts."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)
