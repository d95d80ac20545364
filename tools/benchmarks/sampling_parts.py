"""A model and a clip to sample for it, and the clocks that time the parts of sampling; used by ``sampling.py``."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from facediff.data import Assets, Batch, Sample, collate
from facediff.models import DualPathDiffusion
from facediff.models.audio_encoders import HubertEncoder, MelEncoder
from facediff.models.decoders import StyleTransformer
from facediff.models.dual_path.network import Conditions
from facediff.models.folding import ConditionalDenoiser, SamplingSpace, fold
from facediff.models.fusions import BidirectionalCrossAttention
from facediff.models.inference import ClipNoise
from facediff.models.samplers import Sampler
from facediff.models.speaker_encoders import TcnGruTransformer
from facediff.speech.audio import samples_for

FRAME_RATE = 25.0
REFERENCE_FRAMES = 100
IDENTITIES = ["F2", "F3", "F4", "M3", "M4", "M5"]
SPACES: tuple[SamplingSpace, ...] = ("folded", "vertices")


@dataclass
class Costs:
    """Seconds that the parts of sampling take; each is the quickest of the repeats.

    Attributes:
        audio_encoder: speech to features, once a clip.
        conditions: identity, style and what is prepared of all conditions, once a clip.
        fold: the products of the linear ends, once a model.
        look: whether the weights are those that were folded; once a clip.
        core: fusion and decoder, in every step.
        core_unprepared: the same without what is prepared once a clip.
        leave: features to vertices: once a clip where folded, in every step otherwise.
        rest: undoing the motion scale; once a clip.
        step: a whole step with the noise that it draws, by sampling space and sampler.
    """

    audio_encoder: float
    conditions: float
    fold: float
    look: float
    core: float
    core_unprepared: float
    leave: float
    rest: float
    step: dict[str, dict[str, float]] = field(default_factory=dict)

    def row(self, space: str, sampler: str, steps: int, seconds: float) -> dict[str, Any]:
        """What one configuration costs: parts, total and real-time factor."""
        step = self.step[space][sampler]
        rest = self.rest + (self.look + self.leave if space == "folded" else 0.0)
        total = self.audio_encoder + self.conditions + steps * step + rest
        return {
            "space": space,
            "sampler": sampler,
            "steps": steps,
            "audio_encoder": self.audio_encoder,
            "conditions": self.conditions,
            "per_step": step,
            "all_steps": steps * step,
            "rest": rest,
            "total": total,
            "real_time_factor": total / seconds,
        }


@dataclass(frozen=True)
class Bench:
    """A model and one clip to sample for it.

    Attributes:
        model: the model, in evaluation mode.
        batch: one clip.
        repeats: timed repetitions of every part; one more before them warms up.
    """

    model: DualPathDiffusion
    batch: Batch
    repeats: int

    def now(self) -> float:
        """The time in seconds, once the device has finished what it was given."""
        if self.model.device.type == "cuda":
            torch.cuda.synchronize(self.model.device)
        return time.perf_counter()

    def clock(self, work: Callable[[], object]) -> float:
        """Seconds that a call takes, with everything that it started on the device."""
        start = self.now()
        work()
        return self.now() - start

    def quickest(self, work: Callable[[], object]) -> float:
        """Seconds of the quickest of several calls, after one to warm up."""
        work()
        return min(self.clock(work) for _ in range(self.repeats))

    def conditions(self) -> Conditions:
        """What is computed once a clip."""
        batch, network = self.batch, self.model.network
        style = self.model.encode_style(batch.reference, batch.reference_mask)
        return network.conditions(batch, batch.identity, style)

    def once_a_clip(self) -> tuple[float, float]:
        """Seconds of the audio encoder, and of all other conditions."""
        encoder = self.model.network.audio_encoder
        entered: list[float] = []
        left: list[float] = []
        hooks = [
            encoder.register_forward_pre_hook(lambda *_: entered.append(self.now())),
            encoder.register_forward_hook(lambda *_: left.append(self.now())),
        ]
        whole = [self.clock(self.conditions) for _ in range(self.repeats + 1)]
        for hook in hooks:
            hook.remove()
        audio = [end - start for start, end in zip(entered, left, strict=True)]
        others = [total - part for total, part in zip(whole, audio, strict=True)]
        return min(audio[1:]), min(others[1:])

    def usual(self) -> tuple[str, int]:
        """Name and steps of the model's sampler."""
        return self.model.hparams["sampler"]["class_path"].rpartition(".")[2], self.model.sampler.steps

    def denoiser(self, name: SamplingSpace, conditions: Conditions) -> ConditionalDenoiser:
        """The network in a sampling space, with the model's own cache."""
        steps = self.model.process.steps
        return self.model.network.prepare_for_inference(conditions, steps, folded=name == "folded")

    def stepper(self, name: SamplingSpace, sampler: Sampler, conditions: Conditions) -> Callable[[], None]:
        """A call that takes one step of the real loop: prediction, noise, update."""
        denoiser, batch = self.denoiser(name, conditions), self.batch
        unit = ClipNoise(batch.names, batch.frame_lengths.tolist(), [0] * len(batch), self.model.device)
        shape = (*batch.motion.shape[:2], denoiser.width)
        state = denoiser.noise(unit(torch.empty(shape, device=self.model.device)))
        places = iter(enumerate(sampler.timesteps))
        predictions: list[Tensor] = []

        def step() -> None:
            nonlocal state, predictions
            i, place = next(places)
            predictions = [*predictions, denoiser.denoise(state, place)][-sampler.memory :]
            state = sampler.update(i, state, predictions, lambda like: denoiser.noise(unit(like)))

        return step

    def in_turn(self, steppers: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
        """Seconds of the quickest step of each, taken in turn after two that warm up."""
        spent: dict[str, list[float]] = {name: [] for name in steppers}
        for _ in range(repeats + 2):
            for name, step in steppers.items():
                spent[name].append(self.clock(step))
        return {name: min(times[2:]) for name, times in spent.items()}

    def measure(self, samplers: dict[str, Sampler]) -> Costs:
        """Time every part."""
        network, batch = self.model.network, self.batch
        audio_encoder, others = self.once_a_clip()
        conditions = self.conditions()
        prepared = self.denoiser("folded", conditions)
        number = self.model.process.steps // 2
        step = torch.full((len(batch),), number, device=self.model.device)
        entered = torch.randn(*batch.motion.shape[:2], network.embed.out_features, device=self.model.device)
        decoded = network.core(entered, step, conditions)
        vertices = network.clean_motion(decoded)
        maps = network.embed.weight.detach(), network.unembed.weight.detach(), network.unembed.bias.detach()
        cores = self.in_turn(
            {
                "kept": lambda: prepared.features(entered, number),
                "anew": lambda: network.core(entered, step, conditions),
            },
            self.repeats,
        )
        costs = Costs(
            audio_encoder=audio_encoder,
            conditions=others,
            fold=self.clock(lambda: fold(*maps)),
            look=self.quickest(lambda: self.denoiser("folded", conditions)),
            core=cores["kept"],
            core_unprepared=cores["anew"],
            leave=self.quickest(lambda: network.clean_motion(decoded)),
            rest=self.quickest(lambda: vertices / self.model.scale),
        )
        costs.step = {space: {} for space in SPACES}
        for name, sampler in samplers.items():
            found = self.in_turn({s: self.stepper(s, sampler, conditions) for s in SPACES}, self.repeats)
            for space, seconds in found.items():
                costs.step[space][name] = seconds
        return costs


def build(args: argparse.Namespace, vertices: int, *, tiny_encoder: bool, student: bool = False) -> Bench:
    """The model with random weights, its assets, and one clip of noise as speech.

    Args:
        args: its sizes, as attributes.
        vertices: of the face.
        tiny_encoder: a tiny HuBERT instead of HuBERT base.
        student: the mel encoder, as ``adapt --low-latency --audio-encoder mel`` puts it in HuBERT's place.
    """
    from transformers import HubertConfig

    torch.manual_seed(0)
    tiny: dict[str, Any] = {
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "hidden_size": 32,
        "intermediate_size": 64,
    }
    tiny |= {"conv_dim": (16,) * 7, "num_conv_pos_embeddings": 16, "num_conv_pos_embedding_groups": 2}
    config = HubertConfig(**(tiny if tiny_encoder else {})).to_dict()
    model = DualPathDiffusion(
        n_vertices=vertices,
        identities=IDENTITIES,
        frame_rate=FRAME_RATE,
        dim=args.dim,
        audio_encoder=MelEncoder if student else partial(HubertEncoder, config=config),
        style_encoder=partial(TcnGruTransformer, num_heads=args.heads),
        fusion=partial(BidirectionalCrossAttention, num_heads=args.heads),
        decoder=partial(StyleTransformer, num_layers=args.layers, num_heads=args.heads),
    )
    model.adopt(
        Assets(
            corpus="random weights",
            synthetic=True,
            unit="m",
            frame_rate=FRAME_RATE,
            identities=IDENTITIES,
            templates={name: torch.zeros(vertices, 3) for name in IDENTITIES},
            faces=None,
            regions={name: torch.arange(3) for name in ("lips", "upper_face")},
            motion_scale=100.0,
        )
    )
    frames = max(1, round(args.seconds * FRAME_RATE))
    sample = Sample(
        audio=torch.randn(samples_for(frames, FRAME_RATE)),
        motion=torch.zeros(frames, vertices, 3),
        template=torch.zeros(vertices, 3),
        identity=0,
        reference=1e-2 * torch.randn(REFERENCE_FRAMES, vertices, 3),
        name="speech",
        identity_name=IDENTITIES[0],
        sentence="",
        reference_name="reference",
    )
    return Bench(model.eval().to(args.device), collate([sample]).to(args.device), args.repeats)
