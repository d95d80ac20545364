"""Facts of the weights of a motion for a page, which offers them for download under their names."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from facediff.animation import Animation
from facediff.animation.options import ExportOptions
from facediff.editing.blendshapes import own_weights
from facediff.export.format import FileSpace
from facediff.export.glb import moving_nodes, weighted_shapes
from facediff.export.viewer.packing import Blobs
from facediff.export.viewer.posing import FIELD_STEP, packed_field
from facediff.spaces.visemes import VisemeSet

VISEME_SETS: tuple[VisemeSet, ...] = ("oculus", "vrm")
TOLERANCE = 0.1
"""Largest distance of a vertex in mm from the weights' sum, as of a page's own .glb."""


def channel_facts(animation: Animation, blobs: Blobs) -> dict[str, Any] | None:
    """Weights of ARKit's shapes as a page keeps them: numbers, displacements and tables; None for other motion."""
    values = animation.values
    if values is None or animation.space.kind != "arkit":
        return None
    tables = {}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "weights.csv"
        weights = own_weights(animation)
        weights.save(path)
        tables["arkit"] = blobs.add(path.read_bytes())
        for viseme_set in VISEME_SETS:
            weights.tracks(viseme_set).save(path, plain=True)
            tables[viseme_set] = blobs.add(path.read_bytes())
    return {
        "space": animation.space.state(),
        "channels": len(animation.space.channels),
        "values": blobs.add(values.astype("<f4").tobytes()),
        "tables": tables,
        "scene": _scene(animation, blobs),
    }


def _scene(animation: Animation, blobs: Blobs) -> dict[str, Any] | None:
    """Content of a .glb with targets under the weights' names, in metres; None if the weights do not determine it."""
    space = FileSpace.of(animation, ExportOptions(), "m")
    still = animation.still()
    shapes = weighted_shapes(still, space, TOLERANCE / 1000)
    if shapes is None:
        return None
    rest, morphs = shapes
    return {
        "names": morphs.names,
        "step": FIELD_STEP,
        "rest": blobs.add((1000 * rest).astype("<f4").tobytes()),
        "weights": blobs.add(np.ascontiguousarray(morphs.weights, "<f4").tobytes()),
        "shapes": [packed_field(1000 * shape, blobs) for shape in morphs.shapes],
        "nodes": [
            {
                "name": node.name,
                "place": None if node.translation is None else node.translation.tolist(),
                "curves": {path: blobs.add(curve.astype("<f4").tobytes()) for path, curve in node.curves.items()},
            }
            for node in moving_nodes(still, space, animation.head)
        ],
    }
