"""A model, a corpus and the ways to train, which ``training.py`` compares."""

from __future__ import annotations

import argparse
import pickle
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from loading import resident
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
        dropout: whether anything is dropped; loss curves are compared without.
    """

    def __init__(self, args: argparse.Namespace, frozen: int, *, dropout: bool = True) -> None:
        from transformers import HubertConfig

        class Fake(Biwi):
            n_vertices: ClassVar[int] = args.vertices  # type: ignore[misc]
            identities: ClassVar[list[str]] = SUBJECTS  # type: ignore[misc]

        self.make_data = partial(Fake, root=str(args.root))
        self.budget = args.max_frames
        self.args = args
        self.device = torch.device(getattr(args, "device", "cpu"))
        torch.manual_seed(0)
        tiny: dict[str, Any] = {"num_hidden_layers": 3, "num_attention_heads": 2, "hidden_size": 32}
        tiny |= {"intermediate_size": 64, "conv_dim": (16,) * 7, "num_conv_pos_embeddings": 16}
        tiny |= {"num_conv_pos_embedding_groups": 2}
        config = HubertConfig(**(tiny if args.tiny_encoder else {})).to_dict()
        self.model = DualPathDiffusion(
            n_vertices=args.vertices,
            identities=SUBJECTS,
            frame_rate=float(RATE),
            dim=args.dim,
            audio_encoder=partial(HubertEncoder, config=config, frozen_layers=frozen),
            style_encoder=partial(TcnGruTransformer, num_heads=args.heads),
            fusion=partial(BidirectionalCrossAttention, num_heads=args.heads),
            decoder=partial(StyleTransformer, num_layers=args.layers, num_heads=args.heads),
            identity_dropout=0.1 if dropout else 0.0,
        )
        data = self.make_data()
        self.model.adopt(data.assets().with_motion_scale(data.motion_scale()))
        self.model.to(self.device).train()
        if not dropout:
            self._drop_nothing()
        self._optimizers: dict[bool, torch.optim.Optimizer] = {}
        self._batches: dict[tuple[bool, bool], Iterator[Batch]] = {}
        self._compiled: dict[torch.nn.Module, Any] = {}

    def _drop_nothing(self) -> None:
        for module in self.model.modules():
            if isinstance(module, torch.nn.Dropout):
                module.p = 0.0
            for name in ("dropout", "attention_dropout"):
                if isinstance(getattr(module, name, None), float):
                    setattr(module, name, 0.0)

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
        """What the callback CompiledTraining does, or the undoing of it."""
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
        return training_losses(predicted, truth, mask, model.assets.regions["upper_face"], model.loss_weights)


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


@contextmanager
def watched() -> Iterator[list[int]]:
    """The highest memory of the process's own, without mapped files, in a list of one."""
    highest, done = [resident()], threading.Event()

    def watch() -> None:
        while not done.wait(0.01):
            highest[0] = max(highest[0], resident())

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield highest
    finally:
        done.set()
        thread.join()


def memory(bench: Bench, way: Way) -> dict[str, float]:
    """Highest memory over a few steps of one way, and what the weights alone take."""
    with watched() as highest:
        for _ in range(2):
            bench.step(way)
    return {"peak": float(highest[0]), "weights": 4.0 * sum(p.numel() for p in bench.model.parameters())}


def curve(args: argparse.Namespace, way: Way) -> list[float]:
    """Losses of the first training steps; by single clips with summed gradients unless the way makes batches."""
    bench = Bench(args, args.frozen[0], dropout=False)
    bench.budget = args.max_frames // 2
    model, optimizer = bench.model, bench.optimizer(fused=True)
    batches = bench.batches(replace(way, budget=True))
    found = []
    for number in range(args.curve_steps):
        batch = next(batches)
        draw = torch.Generator().manual_seed(number)
        step = model.process.draw_steps(len(batch), torch.device("cpu"), draw)
        noise = torch.randn(batch.motion.flatten(2).shape, generator=draw)
        with torch.autocast("cpu", torch.bfloat16, enabled=way.mixed):
            if way.budget:
                total = model.losses_at(batch, step, noise)["loss"]
                total.backward()
                found.append(total.item())
            else:
                found.append(sum(clip_losses(bench, batch, step, noise)))
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
    return found


def clip_losses(bench: Bench, batch: Batch, step: Tensor, noise: Tensor) -> Iterator[float]:
    """What each clip adds to the loss of a batch; its gradients are added up on the way."""
    names = ("reconstruction", "velocity", "acceleration")
    lengths = batch.frame_lengths
    for i, length in enumerate(lengths.tolist()):
        terms = bench.one_by_one(batch.select([i]), step[i : i + 1], noise[i : i + 1, :length])
        # The means of a batch are over all its valid frames or differences, that of the face is over clips.
        shares = [max(0, length - order) / float((lengths - order).clamp_min(0).sum()) for order in range(3)]
        shares.append(1 / len(batch))
        weights = bench.model.loss_weights
        loss = sum(share * weights[n] * terms[n] for n, share in zip((*names, "face"), shares, strict=True))
        assert isinstance(loss, Tensor)
        loss.backward()
        yield loss.item()
