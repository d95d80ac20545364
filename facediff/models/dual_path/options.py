"""Options of dual-path style diffusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from facediff.models.audio_encoders import AudioEncoderFactory, MelEncoder
from facediff.models.decoders import DecoderFactory, StyleTransformer
from facediff.models.folding import SamplingSpace
from facediff.models.fusions import BidirectionalCrossAttention, FusionFactory
from facediff.models.layers import Share, Weight, Width
from facediff.models.mesh_encoders import LinearMeshEncoder, MeshEncoderFactory
from facediff.models.motion_space import MotionSpaceFactory, VertexMotion
from facediff.models.samplers import DpmSolverSampler, SamplerFactory
from facediff.models.speaker_encoders import (
    HierarchicalIdentity,
    IdentityEncoderFactory,
    StyleEncoderFactory,
    TcnGruTransformer,
)
from facediff.utils import ranges
from facediff.utils.ranges import Range

NumericScale = Annotated[float, Range(1e-6, 1e6)]
TokenForm = Literal["levels", "single"]


@dataclass(kw_only=True)
class DualPathOptions:
    """Options of :class:`DualPathDiffusion`; the ablations of the paper are one override each.

    Args:
        dim: model width C.
        audio_encoder: speech to features F_a.
        identity_encoder: a speaker's label to the static identity F_id; ``none`` for the ablation.
        motion_space: the numbers of a frame that are noised: all vertices, or principal components with a
            preconditioned network (docs/generation.md).
        mesh_encoder: reference motion to one feature per frame, in front of the style encoder.
        style_encoder: these features to the dynamic style F_dyn; ``none`` for the ablation.
        fusion: speech features and noisy motion to one sequence; ``add`` for the ablation.
        decoder: this sequence and the style to clean motion.
        sampler: runs the reverse process in validation, test, prediction and animation.
        sampling_space: where it runs: ``folded`` into ``dim`` dimensions, with the same distribution of motion at a
            cost per step that does not depend on the vertices, or on the ``vertices`` themselves, for comparison. A
            sampler or a network that cannot be folded runs on the vertices anyway.
        diffusion_steps: noising steps N.
        noise_schedule: ``squaredcos_cap_v2`` (the cosine schedule), ``linear`` or ``scaled_linear``.
        noise_draws: how often a clip is noised in a training step, each time to another step with other noise; speech
            and style are encoded once for all of them.
        timestep_sampling: draw training steps ``uniform``, as in the paper, or by ``log_snr``: mostly evenly over the
            logarithm of the signal-to-noise ratio, where noise hides part of the motion. For a motion space with a
            preconditioned network.
        noise_scale: factor on the motion before it is noised; ``auto`` measures on the training split at which
            scale half of its variance shows in the schedule's middle.
        style_tokens: present the style condition as several tokens (``levels``) or one (``single``).
        template_token: let the network see the neutral face f as a further token. The paper's algorithms pass f but do
            not say where it enters. Such a model cannot be exported.
        identity_dropout: share of training clips with a hidden identity, so that unseen speakers can be animated.
        invented_speakers: share of training clips with motion and style reference multiplied by the same random
            gains under a hidden identity, so that the style path learns more speakers than the corpus has.
        style_dropout: share of training clips with a hidden dynamic style, so that the style is taken from the speech
            without a reference.
        style_from_speech: learn to predict the style from the speech, by a regression beside the training that changes
            nothing else (:class:`~facediff.models.dual_path.speech_style.SpeechStyle`); without a reference, an
            identity's mean style is then changed as the speech asks.
        expressivity: 0 for the predicted mean, 1 for a sample, and anything between and up to 2.
        velocity_weight: λ_vel.
        acceleration_weight: λ_acc.
        face_weight: λ_face.
        style_identity_weight: weight of telling the training identity from the dynamic style, by a linear map that is
            used in training only; lets the style hold the person in addition to the mood.
    """

    # Components.
    dim: Width = 256
    audio_encoder: AudioEncoderFactory = MelEncoder
    identity_encoder: IdentityEncoderFactory = HierarchicalIdentity
    motion_space: MotionSpaceFactory = VertexMotion
    mesh_encoder: MeshEncoderFactory = LinearMeshEncoder
    style_encoder: StyleEncoderFactory = TcnGruTransformer
    fusion: FusionFactory = BidirectionalCrossAttention
    decoder: DecoderFactory = StyleTransformer
    sampler: SamplerFactory = DpmSolverSampler
    sampling_space: SamplingSpace = "folded"
    # Noise.
    diffusion_steps: Annotated[int, Range(1, 100_000)] = 1000
    noise_schedule: Literal["squaredcos_cap_v2", "linear", "scaled_linear"] = "squaredcos_cap_v2"
    noise_draws: Annotated[int, Range(1, 64)] = 1
    timestep_sampling: Literal["uniform", "log_snr"] = "uniform"
    noise_scale: NumericScale | Literal["auto"] = 1.0
    # Conditions: how they are presented, how often they are hidden.
    style_tokens: TokenForm = "levels"
    template_token: bool = False
    identity_dropout: Share = 0.1
    invented_speakers: Share = 0.0
    style_dropout: Share = 0.0
    style_from_speech: bool = False
    expressivity: ranges.Expressivity = 1.0
    # Weights of losses.
    velocity_weight: Weight = 0.003
    acceleration_weight: Weight = 0.003
    face_weight: Weight = 0.0005
    style_identity_weight: Weight = 0.0

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weights of eq. 15."""
        weights = {"velocity": self.velocity_weight, "acceleration": self.acceleration_weight, "face": self.face_weight}
        return {"reconstruction": 1.0, **weights}
