"""How many clips a second are trained on, by facediff's way and by that of released scripts, change by change.

Run ``python tools/benchmarks/training.py``: a corpus of BIWI's size (23 370 vertices, 25 frames a second, clips of
about 120 frames, low-rank motion; half a gigabyte in a temporary folder), HuBERT base with random weights, the network
of ``configs/model/dual_path.yaml``. All ways train the same model, with gradients clipped, and read their batches by
facediff's loader; they take turns, so that whatever else the machine does meets them alike.

- ``peers``: how FaceFormer, CodeTalker and FaceDiffuser train: one clip a step, the audio encoder run in full in every
  step, float32, each loss a pass over the vertices, PyTorch's usual optimiser.
- each line below it changes one thing more; ``cached frozen features`` is facediff in float32, ``bf16-mixed`` as it
  trains on a GPU, and with ``--compile`` a last line has fusion and decoder compiled, once that is done.

Frozen layers are neither trained nor given gradients by any way. ``clips/s`` is by the clock; ``clips/CPU s`` by what
all threads together were busy, which says more than the clock where other programs run, above all with ``--threads 1``.
"""

from __future__ import annotations

import argparse
import json
import pickle
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from machine import machine
from sampling import TINY_HUBERT
from torch import Tensor

from facediff.data import Batch, Biwi
from facediff.data.dataset import CachedFeatures
from facediff.models import DualPathDiffusion
from facediff.models.audio_encoders import HubertEncoder
from facediff.models.decoders import StyleTransformer
from facediff.models.fusions import BidirectionalCrossAttention
from facediff.models.losses import training_losses
from facediff.models.samplers import unit_noise
from facediff.models.speaker_encoders import TcnGruTransformer
from facediff.utils.arrays import ArrayStore

SUBJECTS = ["F2", "F3"]
RATE = 25


@dataclass(frozen=True)
class Way:
    """How one trains.

    Attributes:
        name: what the table calls it.
        fused: the optimiser makes one pass over the weights.
        one_pass: the losses make one pass over the vertices, and noise is drawn by all threads.
        budget: batches by frame budget, else single clips.
        cached: the frozen part of the audio encoder is read from the cache.
        mixed: bf16-mixed precision.
        compiled: fusion and decoder are compiled.
    """

    name: str
    fused: bool = False
    one_pass: bool = False
    budget: bool = False
    cached: bool = False
    mixed: bool = False
    compiled: bool = False


WAYS = [Way("peers")]
for _name, _field in (
    ("+ fused optimiser", "fused"),
    ("+ losses in one pass", "one_pass"),
    ("+ batches by frame budget", "budget"),
    ("+ cached frozen features", "cached"),
    ("+ bf16-mixed", "mixed"),
):
    WAYS.append(replace(WAYS[-1], name=_name, **{_field: True}))
PEERS, FLOAT32, MIXED = WAYS[0], WAYS[-2], WAYS[-1]
COMPILED = replace(MIXED, name="+ compiled", compiled=True)


def write_corpus(root: Path, clips: int, frames: int, vertices: int) -> None:
    """Clips of ragged length, whose speech is as loud as their motion is large, along a few random shapes."""
    import soundfile

    rng = np.random.default_rng(0)
    for folder in ("wav", "vertices_npy", "regions"):
        (root / folder).mkdir(parents=True)
    templates = {name: rng.uniform(-0.1, 0.1, (vertices, 3)) for name in SUBJECTS}
    (root / "templates.pkl").write_bytes(pickle.dumps(templates))
    shapes = rng.normal(0, 0.002, (4, 3 * vertices)).astype(np.float32)
    for number in range(clips):
        length = max(5, round(frames * rng.uniform(0.75, 1.25)))
        name = f"{SUBJECTS[number % 2]}_e{number // 2 + 1:02d}"
        phases, speeds = rng.uniform(0, 6, 4), rng.uniform(0.1, 0.6, 4)
        curves = np.sin(np.arange(length)[:, None] * speeds + phases).astype(np.float32)
        template = templates[SUBJECTS[number % 2]].ravel().astype(np.float32)
        np.save(root / "vertices_npy" / f"{name}.npy", curves @ shapes + template)
        loudness = np.repeat(np.abs(curves[:, 0]), 16000 // RATE)
        soundfile.write(root / "wav" / f"{name}.wav", 0.3 * loudness * rng.normal(size=len(loudness)), 16000)
    for name, share in (("lve", 4996 / 23370), ("fdd", 7784 / 23370)):
        chosen = np.sort(rng.choice(vertices, max(1, round(share * vertices)), replace=False))
        (root / "regions" / f"{name}.txt").write_text(", ".join(map(str, chosen)))


class Bench:
    """One model and its data.

    Args:
        args: the command line.
        frozen: frozen layers of the audio encoder, −1 for all.
    """

    def __init__(self, args: argparse.Namespace, frozen: int) -> None:
        from transformers import HubertConfig

        class Fake(Biwi):
            n_vertices: ClassVar[int] = args.vertices  # type: ignore[misc]
            identities: ClassVar[list[str]] = SUBJECTS  # type: ignore[misc]

        self.make_data = partial(Fake, root=str(args.root))
        self.budget = args.max_frames
        self.args = args
        self.device = torch.device(getattr(args, "device", "cpu"))
        torch.manual_seed(0)
        config = HubertConfig(**(TINY_HUBERT if args.tiny_encoder else {})).to_dict()
        self.model = DualPathDiffusion(
            n_vertices=args.vertices,
            identities=SUBJECTS,
            frame_rate=float(RATE),
            dim=args.dim,
            audio_encoder=partial(HubertEncoder, config=config, frozen_layers=frozen),
            style_encoder=partial(TcnGruTransformer, num_heads=args.heads),
            fusion=partial(BidirectionalCrossAttention, num_heads=args.heads),
            decoder=partial(StyleTransformer, num_layers=args.layers, num_heads=args.heads),
        )
        data = self.make_data()
        self.model.adopt(data.assets().with_motion_scale(data.motion_scale()))
        self.model.to(self.device).train()
        self._optimizers: dict[bool, torch.optim.Optimizer] = {}
        self._batches: dict[tuple[bool, bool], Iterator[Batch]] = {}
        self._compiled: dict[torch.nn.Module, Any] = {}

    def optimizer(self, fused: bool) -> torch.optim.Optimizer:
        """AdamW as the model makes it, or as PyTorch makes it unasked."""
        if fused not in self._optimizers:
            trained = [p for p in self.model.parameters() if p.requires_grad]
            self._optimizers[fused] = torch.optim.AdamW(trained, lr=1e-4, weight_decay=0.05, fused=fused or None)
        return self._optimizers[fused]

    def batches(self, way: Way) -> Iterator[Batch]:
        """Training batches without end."""
        key = way.budget, way.cached
        if key not in self._batches:
            self._batches[key] = self._endless(way)
        return self._batches[key]

    def _endless(self, way: Way) -> Iterator[Batch]:
        data = self.make_data(max_frames_per_batch=self.budget if way.budget else None)
        if way.cached:
            data.features.reader = self.fill_cache(data)
        loader = data.train_dataloader()
        for epoch in range(10**6):
            loader.sampler.set_epoch(epoch)  # type: ignore[attr-defined]
            yield from loader

    @torch.no_grad()
    def fill_cache(self, data: Biwi) -> CachedFeatures:
        """What the callback SpeechFeatureCache does when training starts."""
        encoder = self.model.speech_encoder
        features = CachedFeatures(ArrayStore(self.args.root / "cache"), f"{encoder.frozen_key()}:")
        for clip in data.clips("train"):
            audio = features.add(data.corpus, clip)
            if audio is not None:
                lengths = torch.tensor([len(audio)], device=self.device)
                features.put(clip, encoder.frozen_features(audio[None].to(self.device), lengths)[0][0].cpu())
        return features

    def step(self, way: Way) -> tuple[int, int]:
        """One training step with its batch read; clips and frames of it."""
        return self.step_with(way, next(self.batches(way)))

    def step_with(self, way: Way, batch: Batch) -> tuple[int, int]:
        """One training step; clips and frames of its batch."""
        batch = batch.to(self.device)
        steps = self.model.process.draw_steps(len(batch), self.device)
        shape = batch.motion.flatten(2).shape
        self._compile(way.compiled)
        noise = unit_noise(shape, self.device) if way.one_pass else torch.randn(shape, device=self.device)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=way.mixed):
            compute = self.model.losses_at if way.one_pass else self.one_by_one
            loss = compute(batch, steps, noise)["loss"]
        loss.backward()
        del loss
        optimizer = self.optimizer(way.fused)
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        return len(batch), int(batch.frame_lengths.sum())

    def finish(self) -> None:
        """Wait until the device has done what it was given."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _compile(self, wanted: bool) -> None:
        """Compile fusion and decoder, or undo it."""
        for part in (self.model.network.fusion, self.model.network.decoder):
            if wanted and part not in self._compiled:
                part.compile(dynamic=True)
                self._compiled[part] = part._compiled_call_impl
            part._compiled_call_impl = self._compiled[part] if wanted else None

    def one_by_one(self, batch: Batch, step: Tensor, noise: Tensor) -> dict[str, Tensor]:
        """The losses as one writes them down: each a pass over prediction and truth."""
        model = self.model
        clean = batch.motion.flatten(2) * model.scale
        noisy = model.process.add_noise(clean, noise, step)
        predicted = model.network(noisy, step, model.conditions(batch)).view(batch.motion.shape)
        truth, mask = clean.view(batch.motion.shape), batch.mask
        return training_losses(predicted, truth, mask, model.assets.regions["upper_face"], model.options.loss_weights)


def in_turn(bench: Bench, ways: list[Way], rounds: int, clips: int) -> dict[str, dict[str, float]]:
    """Clips, frames, seconds and CPU seconds of every way, after a round that warms up."""
    found = {way.name: dict.fromkeys(("clips", "frames", "seconds", "busy"), 0.0) for way in ways}
    for way in ways:
        next(bench.batches(way))  # features are encoded now if they are not in the cache yet
    for turn in range(rounds + 1):
        for way in ways:
            row = found[way.name]
            for _ in range(1 if way.budget else clips):
                start, busy = time.perf_counter(), time.process_time()
                many, frames = bench.step(way)
                bench.finish()
                seconds = time.perf_counter() - start
                if turn:
                    row["clips"] += many
                    row["frames"] += frames
                    row["seconds"] += seconds
                    row["busy"] += time.process_time() - busy
    return found


def table(frozen: int, rows: dict[str, dict[str, float]]) -> str:
    """One line a way, with ratios to the first and to the line before."""
    lines = [
        f"\n{'the whole audio encoder' if frozen < 0 else f'the lower {frozen} layers of the audio encoder'} frozen",
        f"{'way':<28}{'clips/s':>9}{'frames/s':>10}{'clips/CPU s':>13}{'x peers':>9}{'x peers, CPU':>14}"
        f"{'x before, CPU':>15}",
    ]
    first = before = next(iter(rows.values()))
    for name, row in rows.items():
        ratio = [
            (row["clips"] / row[key]) / (other["clips"] / other[key])
            for other, key in ((first, "seconds"), (first, "busy"), (before, "busy"))
        ]
        lines.append(
            f"{name:<28}{row['clips'] / row['seconds']:>9.3f}{row['frames'] / row['seconds']:>10.1f}"
            f"{row['clips'] / row['busy']:>13.3f}{ratio[0]:>9.2f}{ratio[1]:>14.2f}{ratio[2]:>15.2f}"
        )
        before = row
    return "\n".join(lines)


def options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--vertices", type=int, default=23370, help="vertices of the face (default: BIWI's 23370)")
    parser.add_argument("--clips", type=int, default=16, help="clips of the corpus (default: 16)")
    parser.add_argument("--frames", type=int, default=120, help="mean frames of a clip (default: 120)")
    parser.add_argument("--max-frames", type=int, default=800, help="frame budget (default: 800, as configs have it)")
    parser.add_argument("--dim", type=int, default=512, help="model width (default: 512)")
    parser.add_argument("--layers", type=int, default=6, help="decoder blocks (default: 6)")
    parser.add_argument("--heads", type=int, default=8, help="attention heads (default: 8)")
    parser.add_argument("--frozen", type=int, nargs="+", default=[2, -1], help="frozen layers, each in turn; -1: all")
    parser.add_argument("--rounds", type=int, default=4, help="turns of each way (default: 4)")
    parser.add_argument("--single", type=int, default=3, help="clips a turn of ways of single clips (default: 3)")
    parser.add_argument("--compile", action="store_true", help="a further line with compiled parts; wants a compiler")
    parser.add_argument("--threads", type=int, help="threads of PyTorch (default: its own choice)")
    parser.add_argument("--tiny-encoder", action="store_true", help="a tiny HuBERT instead of HuBERT base, for trials")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers there too, unrounded")
    return parser.parse_args()


def main() -> None:
    """Measure and print."""
    args = options()
    if args.threads:
        torch.set_num_threads(args.threads)
    print(machine())
    print(f"model: {args.vertices} vertices, width {args.dim}, {args.layers} blocks, {args.heads} heads")
    print(f"corpus: {args.clips} clips of about {args.frames} frames; frame budget {args.max_frames}", flush=True)
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        args.root = Path(folder) / "corpus"
        write_corpus(args.root, args.clips, args.frames, args.vertices)
        for frozen in args.frozen:
            ways = [*WAYS, COMPILED] if args.compile else WAYS
            rows[frozen] = in_turn(Bench(args, frozen), ways, args.rounds, args.single)
            print(table(frozen, rows[frozen]), flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
