"""Dual-path style diffusion as a LightningModule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
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
from facediff.diffusion.draws import unit_noise
from facediff.diffusion.folding import FoldCache
from facediff.diffusion.samplers import NoiseSource, SamplerFactory
from facediff.diffusion.samplers.dpm_solver import DpmSolverSampler
from facediff.hparams import describe
from facediff.systems.animation import Progress
from facediff.systems.base import SpeechAnimator
from facediff.systems.dual_path.network import Conditions, DualPathNetwork, TokenForm
from facediff.systems.dual_path.noise import ClipNoise, WindowNoise
from facediff.systems.dual_path.seam import Seam, unchanged
from facediff.systems.dual_path.spaces import Blend, SamplingSpace, choose_space
from facediff.systems.identity_policy import IdentityPolicy
from facediff.systems.windows import Window


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
        sampler: SamplerFactory = DpmSolverSampler,
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
        motion = batch.motion.flatten(2)
        step = self.process.draw_steps(len(batch), motion.device, generator)
        return self.losses_at(batch, step, unit_noise(motion.shape, motion.device, generator))

    def losses_at(
        self, batch: Batch, step: Int[Tensor, " batch"], noise: Float[Tensor, "batch frames coordinates"]
    ) -> dict[str, Tensor]:
        """The losses at given steps with given noise, which is overwritten.

        Args:
            batch: clips with their true motion.
            step: each clip's step, counted from 0.
            noise: unit noise.
        """
        network = self.network
        # As NoiseProcess.add_noise, without further tensors of the motion's size: on a processor, having a new one
        # takes longer than what is done to it.
        signal = self.process.signal.to(noise.device)[step][:, None, None]
        noisy = noise.mul_((1 - signal).sqrt()).addcmul_(batch.motion.flatten(2), signal.sqrt() * self.scale)
        decoded = network.core(network.embed(noisy), step, self._conditions(batch))
        return losses.losses_of_linear(
            decoded,
            network.unembed.weight,
            network.unembed.bias,
            batch.motion,
            batch.mask,
            self.assets.regions["upper_face"],
            self.loss_weights,
            scale=self.scale,
        )

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
    def perform(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Algorithm 2 with the system's sampler, in its sampling space; conditions are computed once.

        All noise of a clip follows from the seed and its name: its motion does not depend on the clips beside it.
        """
        noise = ClipNoise(batch.names, batch.frame_lengths.tolist(), [seed] * len(batch), self.device)
        return self._sample(self._conditions(batch), noise, progress=progress)

    @torch.no_grad()
    def perform_takes(
        self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None
    ) -> Float[Tensor, "takes frames vertices 3"]:
        """The same for several seeds: speech and style are encoded once."""
        lengths = clip.frame_lengths.tolist() * len(seeds)
        noise = ClipNoise(clip.names * len(seeds), lengths, seeds, self.device)
        return self._sample(self._conditions(clip).repeated(len(seeds)), noise, progress=progress)

    @torch.no_grad()
    def perform_window(
        self, clip: Batch, window: Window, seeds: Sequence[int], before: list[Tensor] | None
    ) -> tuple[Float[Tensor, "takes frames vertices 3"], list[Tensor]]:
        """The same for a window, joined in every denoising step to the window before it."""
        conditions = self._conditions(clip).frames(window.context, window.context + window.frames)
        seam = Seam(before, window.kept)
        noise = WindowNoise(clip.names[0], window, seeds, self.device)
        return self._sample(conditions.repeated(len(seeds)), noise, blend=seam), seam.features

    def _sample(
        self, conditions: Conditions, unit: NoiseSource, *, blend: Blend = unchanged, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """Run the sampler; ``unit`` gives unit noise, ``blend`` changes the features of every step."""
        conditions = self.network.prepared(conditions, self.process.steps)
        space = choose_space(self.network, self.sampling_space, self.sampler, self._fold_cache, blend)
        rows, frames = conditions.mask.shape

        def noise(like: Tensor) -> Tensor:
            return space.noise(unit(like))

        def denoise(state: Tensor, step: int) -> Tensor:
            steps = torch.full((rows,), step, device=state.device)
            return space.predict(state, steps, conditions)

        start = noise(torch.empty(rows, frames, space.width, device=self.device, dtype=next(self.parameters()).dtype))
        sample = self.sampler.run(denoise, start, noise=noise, progress=progress)
        return (space.motion(sample) / self.scale).view(rows, frames, self.n_vertices, 3)
