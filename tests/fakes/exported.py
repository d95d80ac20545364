"""A folder as ``facediff export-model`` writes it, in miniature: all is valid but the graphs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from facediff.runtime.folder import ARRAYS, DESCRIPTION, NEEDED, Description
from facediff.utils.plain_files import write_json

VERTICES, STATE = 6, 8


def write_exported(folder: Path, **changes: object) -> Path:
    """Write the folder; keyword arguments replace what the description says."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    arrays = {
        "templates": rng.normal(0, 0.05, (2, VERTICES, 3)).astype(np.float32),
        "styles": rng.normal(size=(2, 4)).astype(np.float32),
        "rest_weights": np.ones((2, VERTICES), np.float32),
        "faces": np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]], np.int32),
    }
    np.savez_compressed(folder / ARRAYS, **arrays)  # type: ignore[arg-type]
    for graph in NEEDED["sampled"]:
        (folder / f"{graph}.onnx").write_bytes(b"no graph")
    description = Description(
        model="DualPathDiffusion",
        facediff="0",
        corpus="tiny",
        synthetic=True,
        licences={},
        opset=20,
        precision="float32",
        sizes={path.name: path.stat().st_size for path in folder.iterdir()},
        graphs={graph: {} for graph in NEEDED["sampled"]},
        sample_rate=16_000,
        frame_rate=25.0,
        unit="m",
        identities=["A", "B"],
        faces=["A", "B"],
        styles=["A", "B"],
        windows={"seconds": 4.0, "overlap": 1.0, "before": 2.0, "after": 0.5, "above": 10.0},
        epsilon=1e-7,
        equal_lengths=False,
        state=STATE,
        kept=STATE,
        sampler="ddim",
        steps=[1],
        table=[[0.0, 1.0, 0.0, 0.0, 0.0]],
        last_step=1,
        decoded="sample",
    )
    write_json(folder / DESCRIPTION, {**description.content(), **changes})
    return folder
