"""Dual-path style diffusion as a LightningModule."""

from __future__ import annotations

import zlib
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from facediff import losses, registry
from facediff.components.audio_encoder import AudioEncoder, AudioEncoderFactory
from facediff.components.audio_encoder.mel import MelEncoder
from facediff.components.decoder import DecoderFactory
from facediff.components.decoder.style_transformer import StyleTransformer
from facediff.components.fusion import FusionFactory
from facediff.components.fusion.cross_attention import BidirectionalCrossAttention
from facediff.components.identity_encoder import IdentityEncoderFactory
from facediff.components.identity_encoder.hierarchical import HierarchicalIdentity
from facediff.components.mesh_encoder import MeshEncoderFactory
from facediff.components.mesh_encoder.linear import LinearMeshEncoder
from facediff.components.style_encoder import StyleEncoderFactory
from facediff.components.style_encoder.tcn_gru_transformer import TcnGruTransformer
from facediff.data import Batch
from facediff.diffusion import NoiseProcess
from facediff.diffusion.folding import FoldCache
from facediff.diffusion.samplers import SamplerFactory
from facediff.diffusion.samplers.ddim import DdimSampler
from facediff.hparams import describe
from facediff.systems.base import Progress, SpeechAnimator
from facediff.systems.dual_path.network import Conditions, DualPathNetwork, TokenForm
from facediff.systems.dual_path.spaces import SamplingSpace, choose_space
from facediff.systems.identity_policy import IdentityPolicy


class DualPathDiffusion(SpeechAnimator):
    """Personalised speech-driven animation by dual-path style diffusion.

    Speech features, a hierarchical identity embedding and a dynamic style encoder condition a diffusion model over
    vertex motion. Every part is chosen by name; the ablations of the paper are one override each:
    ``style_encoder=none``, ``identity_encoder=none``, ``fusion=add``.

    Args:
        n_vertices: vertices of the topology; taken from the data module on the command line.
        identities: training identities; taken from the data module on the command line.
        frame_rate: motion frames a second; taken from the data module on the command line.
        dim: model width C.
        audio_encoder: speech to features.
        identity_encoder: who the face is.
        mesh_encoder: reference motion to one feature per frame, in front of the style encoder.
        style_encoder: how the person moves.
        fusion: where speech meets noisy motion.
        decoder: to clean motion.
        sampler: runs the reverse process in validation, test, prediction and animation.
        sampling_space: where it runs: ``folded`` into ``dim`` dimensions, with the same distribution of motion at a
            cost per step that does not depend on the vertices, or on the ``vertices`` themselves, for comparison. A
            sampler or a network that cannot be folded runs on the vertices anyway.
        diffusion_steps: noising steps N.
        noise_schedule: schedule of diffusers; ``squaredcos_cap_v2`` is the cosine schedule.
        motion_scale: ``unit`` multiplies motion by one factor so that training motion has unit variance, ``none``
            leaves it as it is.
        style_tokens: present the style condition as several tokens (``levels``) or one (``single``).
        identity_dropout: share of training clips whose identity is hidden, so that unknown people can be animated.
        velocity_weight: λ_vel.
        acceleration_weight: λ_acc.
        face_weight: λ_face.
        learning_rate: AdamW's learning rate.
        weight_decay: AdamW's weight decay.
        lr_schedule: constant, or a cosine down to zero at the end of training.
        warmup_steps: optimiser steps over which the learning rate rises from zero.
        protocol: the metrics' protocol for validation and test.
        unseen_identity: as whom people are tested whom the model was not trained on: as nobody known, with their own
            style (``style_only``), as each training identity in turn with the mean of the scores (``each_seen``), or as
            themselves, once the model is adapted to them (``adapted``).
    """

    samples: ClassVar[bool] = True

    def __init__(
        self,
        *,
        n_vertices: int,
        identities: list[str],
        frame_rate: float,
        dim: int = 256,
        audio_encoder: AudioEncoderFactory = MelEncoder,
        identity_encoder: IdentityEncoderFactory = HierarchicalIdentity,
        mesh_encoder: MeshEncoderFactory = LinearMeshEncoder,
        style_encoder: StyleEncoderFactory = TcnGruTransformer,
        fusion: FusionFactory = BidirectionalCrossAttention,
        decoder: DecoderFactory = StyleTransformer,
        sampler: SamplerFactory = DdimSampler,
        sampling_space: SamplingSpace = "folded",
        diffusion_steps: int = 1000,
        noise_schedule: Literal["squaredcos_cap_v2", "linear", "scaled_linear"] = "squaredcos_cap_v2",
        motion_scale: Literal["unit", "none"] = "unit",
        style_tokens: TokenForm = "levels",
        identity_dropout: float = 0.1,
        velocity_weight: float = 0.003,
        acceleration_weight: float = 0.003,
        face_weight: float = 0.0005,
        learning_rate: float = 1e-4,
        weight_decay: float = 0.05,
        lr_schedule: Literal["constant", "cosine"] = "constant",
        warmup_steps: int = 0,
        protocol: str = "paper",
        unseen_identity: IdentityPolicy = "style_only",
    ) -> None:
        arguments = {k: v for k, v in locals().items() if k not in ("self", "__class__")}
        super().__init__(
            n_vertices=n_vertices,
            identities=identities,
            frame_rate=frame_rate,
            learning_rate=learning_rate,
            weight_decay=weight_decay,
            lr_schedule=lr_schedule,
            warmup_steps=warmup_steps,
            protocol=protocol,
            motion_scale=motion_scale,
            unseen_identity=unseen_identity,
        )
        self.identity_dropout = identity_dropout
        self.loss_weights = {
            "reconstruction": 1.0,
            "velocity": velocity_weight,
            "acceleration": acceleration_weight,
            "face": face_weight,
        }
        self.process = NoiseProcess(diffusion_steps, noise_schedule)
        self.sampler = sampler(process=self.process)
        self.sampling_space: SamplingSpace = sampling_space
        self._fold_cache = FoldCache()
        style = style_encoder(dim=dim)
        self.network = DualPathNetwork(
            n_vertices=n_vertices,
            dim=dim,
            audio_encoder=audio_encoder(dim=dim),
            identity_encoder=identity_encoder(dim=dim, n_identities=len(identities)),
            # Without a dynamic style there is nothing to embed, and no idle weights.
            mesh_encoder=mesh_encoder(dim=dim, n_vertices=n_vertices) if style.token_dims else None,
            style_encoder=style,
            fusion=fusion(dim=dim),
            decoder=decoder(dim=dim, style_dim=dim),
            token_form=style_tokens,
        )
        for kind in ("audio_encoder", "identity_encoder", "style_encoder", "fusion", "decoder"):
            arguments[kind] = describe(arguments[kind], getattr(self.network, kind))
        arguments["mesh_encoder"] = describe(mesh_encoder, self.network.mesh_encoder)
        arguments["sampler"] = describe(sampler, self.sampler)
        self.remember(arguments)

    def personal_modules(self) -> list[nn.Module]:
        """The identity's and the dynamic style's encoders, and how both are presented to the decoder."""
        network = self.network
        parts = (network.identity_encoder, network.mesh_encoder, network.style_encoder, network.style_tokens)
        return [part for part in parts if part is not None]

    @property
    def speech_encoder(self) -> AudioEncoder:
        """The audio encoder."""
        return self.network.audio_encoder

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Sample in another way from now on; checkpoints keep the sampler that the system was made with."""
        chosen = registry.sampler.get(name) if name is not None else type(self.sampler)
        options = dict(self.hparams["sampler"]["init_args"]) if name is None else {}
        if steps is not None:
            options["steps"] = steps
        self.sampler = chosen(process=self.process, **options)

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """One draw of step and noise per clip (algorithm 1), then the four losses (eq. 15 to 19)."""
        clean = batch.motion.flatten(2) * self.scale
        noise = torch.randn(clean.shape, device=clean.device, generator=generator)
        step = self.process.draw_steps(len(batch), clean.device, generator)
        noisy = self.process.add_noise(clean, noise, step)
        predicted = self.network(noisy, step, self._conditions(batch)).view(batch.motion.shape)
        truth, mask = clean.view(batch.motion.shape), batch.mask
        upper = self.assets.regions["upper_face"].to(clean.device)
        terms = {
            "reconstruction": losses.reconstruction_loss(predicted, truth, mask),
            "velocity": losses.velocity_loss(predicted, truth, mask),
            "acceleration": losses.acceleration_loss(predicted, truth, mask),
            "face": losses.face_dynamics_loss(predicted, truth, mask, upper),
        }
        terms["loss"] = sum((self.loss_weights[name] * term for name, term in terms.items()), clean.new_zeros(()))
        return terms

    def _conditions(self, batch: Batch) -> Conditions:
        identity = batch.identity
        if self.training and self.identity_dropout:
            hidden = torch.rand(identity.shape, device=identity.device) < self.identity_dropout
            identity = identity.masked_fill(hidden, -1)
        return self.network.conditions(
            batch.audio,
            batch.audio_lengths,
            batch.frame_lengths,
            identity,
            self.style_of(batch),
            batch.cached_features,
        )

    def encode_style(
        self, reference: Float[Tensor, "batch frames vertices 3"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """F_dyn of reference motions (eq. 2 to 9); of width 0 if the dynamic path is left out."""
        return self.network.dynamic_style(reference * self.scale, mask)

    @torch.no_grad()
    def generate(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Algorithm 2 with the system's sampler, in its sampling space; conditions are computed once.

        All noise of a clip follows from the seed and its name: its motion does not depend on the clips beside it.
        """
        conditions = self._conditions(batch)
        space = choose_space(self.network, self.sampling_space, self.sampler, self._fold_cache)
        unit = ClipNoise(batch, seed)

        def noise(like: Tensor) -> Tensor:
            return space.noise(unit(like))

        def denoise(state: Tensor, step: int) -> Tensor:
            steps = torch.full((len(batch),), step, device=state.device)
            return space.predict(state, steps, conditions)

        start = noise(batch.motion.new_empty((*batch.motion.shape[:2], space.width)))
        sample = self.sampler.run(denoise, start, noise=noise, progress=progress)
        return (space.motion(sample) / self.scale).view(batch.motion.shape)


class ClipNoise:
    """Unit Gaussian noise for the clips of a batch, zero on their padding; each clip has a stream of its own.

    Args:
        batch: the clips; their names and lengths are looked at.
        seed: seed of all streams.
    """

    def __init__(self, batch: Batch, seed: int) -> None:
        self.lengths = batch.frame_lengths.tolist()
        self.streams = [
            torch.Generator(batch.motion.device).manual_seed(zlib.crc32(name.encode()) + seed) for name in batch.names
        ]

    def __call__(self, like: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
        """The next noise of the shape of ``like``."""
        noise = torch.zeros_like(like)
        for i, (stream, frames) in enumerate(zip(self.streams, self.lengths, strict=True)):
            noise[i, :frames] = torch.randn(
                (frames, like.shape[2]), device=like.device, dtype=like.dtype, generator=stream
            )
        return noise
