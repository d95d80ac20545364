"""A corpus in miniature, in the true on-disk layout: 24 vertices, three people, a few short sentences."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import soundfile
import trimesh

from facediff.data.corpus import Clip
from facediff.data.datamodule import SpeechMotionDataModule

SEEN = ["A", "B"]
UNSEEN = "C"
VERTICES = 24
RATE = 25


def tiny_model_options() -> dict[str, Any]:
    """Options of a DualPathDiffusion for this corpus that is small enough to train in a test."""
    from functools import partial

    from facediff import registry

    return {
        "n_vertices": VERTICES,
        "identities": SEEN,
        "frame_rate": 25.0,
        "dim": 16,
        "diffusion_steps": 40,
        "audio_encoder": partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1),
        "style_encoder": partial(registry.style_encoder.tcn_gru_transformer, num_layers=1),
        "decoder": partial(registry.decoder.style_transformer, num_layers=1),
        "sampler": partial(registry.sampler.ddim, steps=3),
    }


def write_tiny(root: Path, *, sentences: int = 7, seed: int = 0) -> Path:
    """Write the corpus: a tone whose loudness drives the lips, so that speech determines motion."""
    rng = np.random.default_rng(seed)
    for folder in ("wav", "vertices_npy", "regions"):
        (root / folder).mkdir(parents=True)
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(4)), -1).reshape(-1, 2)
    base = np.concatenate([grid * 0.02, np.zeros((VERTICES, 1))], 1)
    templates = {name: base + rng.normal(0, 1e-3, base.shape) for name in [*SEEN, UNSEEN]}
    rows = ["clip,subject,sentence,mood"]
    for i, subject in enumerate([*SEEN, UNSEEN]):
        for sentence in range(1, sentences + 1):
            frames = 12 + 2 * sentence + i
            clip = f"{subject}_e{sentence:02d}"
            time = np.arange(frames) / RATE
            loud = 0.5 + 0.5 * np.sin(2 * np.pi * (1 + sentence / 3) * time)
            motion = np.zeros((frames, VERTICES, 3))
            motion[:, :12, 1] = -0.01 * (1 + i) * loud[:, None]
            motion[:, 12:, 2] = 0.002 * np.cos(7 * time)[:, None]
            np.save(
                root / "vertices_npy" / f"{clip}.npy", (templates[subject] + motion).reshape(frames, -1).astype("f4")
            )
            samples = np.repeat(loud, 640) * np.sin(2 * np.pi * 300 * np.arange(frames * 640) / 16000)
            soundfile.write(root / "wav" / f"{clip}.wav", 0.5 * samples, 16000, subtype="PCM_16")
            rows.append(f"{clip},{subject},e{sentence:02d},{'calm' if sentence % 2 else 'lively'}")
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    own = {name: rng.integers(0, 256, (VERTICES, 3)).astype(np.uint8) for name in SEEN}
    np.savez(root / "colours.npz", **own)
    (root / "clips.csv").write_text("\n".join(rows) + "\n")
    (root / "regions" / "lve.txt").write_text(", ".join(map(str, range(12))))
    (root / "regions" / "fdd.txt").write_text(",".join(map(str, range(12, 24))))
    (root / "regions" / "inner_lip_pairs.txt").write_text("0, 6\n1, 7\n")
    faces = [[r * 6 + c, r * 6 + c + 1, r * 6 + c + 6] for r in range(3) for c in range(5)]
    trimesh.Trimesh(base, faces, process=False).export(root / "tiny.ply")
    return root


class Tiny(SpeechMotionDataModule):
    """The miniature corpus: sentences 1 to 4 train, 5 validates, 6 and 7 test; C is unseen."""

    corpus_name: ClassVar[str] = "tiny"
    synthetic: ClassVar[bool] = True
    unit = "m"
    frame_rate: ClassVar[float] = float(RATE)
    n_vertices = VERTICES
    identities = SEEN
    mesh_files: ClassVar[tuple[str, ...]] = ("tiny.ply",)
    reference_attributes: ClassVar[tuple[str, ...]] = ("mood",)

    def split_of(self, clip: Clip) -> str | None:
        seen = clip.identity in SEEN
        if clip.number >= 6:
            return "test_a" if seen else "test_b"
        if not seen:
            return None
        return "val" if clip.number == 5 else "train"
