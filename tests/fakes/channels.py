"""The miniature corpus as channels of a rig: two shapes, one that never moves, and the turns of a head."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facediff.data.corpus import Corpus
from facediff.spaces import Rotation, Space
from tests.fakes.tiny import RATE, SEEN, UNSEEN, VERTICES, Tiny, write_tiny

CHANNELS = Space(
    "arkit",
    ("jawOpen", "browInnerUp", "mouthLeft", "HeadYaw", "HeadPitch", "HeadRoll"),
    rig="tiny",
    rig_hash="0",
    rotations=(Rotation("head", 3, "euler"),),
)


def write_channels(root: Path) -> Path:
    """Write the miniature corpus with its motion as channels next to it."""
    write_tiny(root)
    (root / "values_npy").mkdir()
    for path in sorted((root / "vertices_npy").glob("*.npy")):
        moved = np.load(path).reshape(-1, VERTICES, 3)
        time = np.arange(len(moved)) / RATE
        subject, sentence = [*SEEN, UNSEEN].index(path.stem[0]), int(path.stem[-2:])
        loud = 0.5 + 0.5 * np.sin(2 * np.pi * (1 + sentence / 3) * time)
        turns = 0.05 * np.stack([np.sin(time), np.cos(2 * time), np.sin(3 * time)], 1)
        shapes = np.stack([(1 + subject) * loud, np.cos(7 * time), np.zeros(len(time))], 1)
        np.save(root / "values_npy" / path.name, np.concatenate([shapes, turns], 1).astype("f4"))
    return root


class TinyChannels(Tiny):
    """The same corpus in channels, with a rig that makes the very vertices of them."""

    space = CHANNELS
    n_vertices = len(CHANNELS.channels)

    @cached_property
    def mesh_corpus(self) -> Corpus:
        return Corpus(self.root, VERTICES, self.frame_rate)

    def deltas(self) -> dict[str, Tensor]:
        deltas = torch.zeros(3, VERTICES, 3)
        deltas[0, :12, 1], deltas[1, 12:, 2], deltas[2, 3, 0] = -0.01, 0.002, 0.004
        return dict.fromkeys((*SEEN, UNSEEN), deltas)
