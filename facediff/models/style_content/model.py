"""The style-content model: its options, its objectives and inference.

E_C and E_S split motion into content (articulation, per frame) and style (how a person moves, one vector); the decoder
D turns both into motion again, whether the content comes from motion or from speech. The networks are in
``network.py``, the distances and the alignment of two recordings of a sentence in ``losses.py``.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from facediff import registry
from facediff.data import Assets, Batch, SpeechMotionDataModule
from facediff.errors import FaceDiffError
from facediff.hyperparameters import takes_options, with_classes
from facediff.models.base import AnimationModel
from facediff.models.graphs import BATCH, FRAMES, Graph, Graphs, ModelPart, results_of, speech_graph, style_graphs
from facediff.models.inference import Progress
from facediff.models.layers import frame_mask
from facediff.models.losses import style_contrast
from facediff.models.style_content.losses import (
    Alignments,
    Pairing,
    dynamics_distance,
    motion_distance,
    pair_up,
    relative_distance,
    squared_distance,
    style_distance,
)
from facediff.models.style_content.network import DisentanglementNetwork, StyleContentOptions


@registry.model.register("StyleContentDisentanglement")
class StyleContentDisentanglement(AnimationModel):
    """Personalised speech-driven animation by style-content disentanglement.

    Spiral convolutions split motion into content and personal style; one decoder turns content and style into motion,
    whether the content comes from motion or from speech. Chai, Shao, Weng, Zhou, "Personalized Audio-Driven 3D Facial
    Animation via Style-Content Disentanglement", IEEE TVCG 2024; the method is also described in a published patent
    document; its steps (4.1) and (4.2) are :meth:`losses`.

    Args:
        options: of :class:`StyleContentOptions` as keyword arguments, and of every model
            (:class:`facediff.models.AnimationModel`).
    """

    @takes_options(StyleContentOptions)
    def __init__(self, options: StyleContentOptions, **common: Any) -> None:  # noqa: ANN401
        super().__init__(weight_decay=options.weight_decay, **common)
        self.options = with_classes(options)
        relative, contrast = options.content_pull == "relative", options.style_pull == "contrast"
        self.content_distance = relative_distance if relative else squared_distance
        self.style_pull = style_contrast if contrast else style_distance
        self.alignments = Alignments(self.frame_rate)
        points = {"n_vertices": self.n_vertices, "dims": self.dims}
        self.network = DisentanglementNetwork(options, **points, frame_rate=self.frame_rate)

    def personal_modules(self) -> list[nn.Module]:
        """The style encoder, and the decoder: its basis holds the shapes of a face."""
        return [self.network.style_frames, self.network.style_encoder, self.network.decoder]

    def setup(self, stage: str) -> None:
        """Ask for pairs of clips, and let a basis that was never trained start from the training motion."""
        new = self.untrained
        super().setup(stage)
        data: SpeechMotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        if stage == "fit":
            data.pair_sentences = True
            data.aligner = self.alignments if self.options.aligned_pairs and self.options.aligned_windows else None
            data.window_context = self.context_frames() if self.options.window_context else (0, 0)
            if new:
                mean, shapes = data.principal_motion(self.network.decoder.basis.in_features)
                self.network.decoder.start_from(mean * self.scale, shapes * self.scale)
            if self.options.lip_gap_weight and self.assets.inner_lip_pairs is None:
                print(
                    f"note: lip_gap_weight has no effect: {data.source} has no regions/inner_lip_pairs.txt",
                    flush=True,
                )

    def adopt(self, assets: Assets) -> None:
        """Take over a corpus's assets, and which vertices are the face."""
        super().adopt(assets)
        visible = self.network.visible
        if visible is not None:
            if "face" not in assets.regions:
                raise FaceDiffError(
                    f"vertices=face: {assets.corpus} has no region face; set data.face to a file that lists its "
                    f"vertices, e.g. --data.face=FLAME_masks.pkl:face"
                )
            visible.zero_()[assets.regions["face"].to(visible.device)] = 1.0

    def context_frames(self) -> tuple[int, int]:
        """Frames before and after a frame that its motion hears: the decoder sees contents, each of a window.

        A term that decodes twice, such as the cycle with content of motion, hears the decoder's past frames twice.
        """
        speech, ratio = self.network.speech_content, self.network.ratio
        before = self.network.decoder.past_frames + math.ceil(speech.before / ratio)
        return before, math.ceil((speech.window - 1 - speech.before) / ratio)

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The patent's step (4): the disentanglement network (4.1) and the speech network (4.2), trained together."""
        network, motion, options = self.network, batch.motion * self.scale, self.options
        aligned = options.aligned_pairs and self.alignment_allowed()
        pairing = pair_up(batch, self.alignments if aligned else None)
        # (4.1) E_C and E_S split motion into content and style.
        content, style = network.content(motion, batch.mask), self.style_of_window(batch, motion)
        reference_style = network.style(batch.reference * self.scale, batch.reference_mask)
        # (4.2) The speech encoder gives content as well, decoded with the style of another clip of the speaker, as
        # in inference, or with the style of the clip itself.
        speech_content = network.content_of_speech(batch)
        speech_style = style if options.speech_style == "own" else reference_style
        terms = {
            "recording_content": self.content_distance(content, pairing.of_partner(content), pairing.aligned),
            "identity_style": self.style_pull(torch.cat([style, reference_style]), batch.identity_names * 2),
            "speech_content": self.content_distance(content, speech_content, batch.window_mask),
        }
        # One decoder D and the same terms for both: reconstruction, style swap, cycle.
        terms |= self.branch_losses(batch, motion, pairing, content, style, style)
        speech_terms = self.branch_losses(batch, motion, pairing, speech_content, speech_style, style)
        terms |= {f"speech_{name}": term for name, term in speech_terms.items()}
        weights = options.weights
        terms["loss"] = torch.stack([weights[name] * term for name, term in terms.items()]).sum()
        return terms

    def branch_losses(
        self, batch: Batch, motion: Tensor, pairing: Pairing, content: Tensor, decoded_style: Tensor, style: Tensor
    ) -> dict[str, Tensor]:
        """Reconstruction, swap and cycle of clips i with partners j.

        Args:
            batch: the clips.
            motion: M_i, scaled (B, T, V, 3).
            pairing: the partners.
            content: C_i (B, T, content_dim), from motion or from speech.
            decoded_style: the style (B, style_dim) with which C_i must give M_i.
            style: S_i of the motion (B, style_dim); S_j is the partner's.
        """
        # All valid frames are seen; those that count are fewer where a training window comes with the frames around it.
        network, mask, scored, partner = self.network, batch.mask, batch.window_mask, pairing.partner
        # D(C_i, S_i) ≈ M_i
        rebuilt = self.decode_scaled(content, decoded_style, mask)
        terms = {"reconstruction": self.distance_to(batch, rebuilt, motion, scored)}
        apart = partner != torch.arange(len(partner), device=partner.device)
        if not apart.any():  # no partners: saves two thirds of the work while one speaker alone is trained
            return {**terms, **dict.fromkeys(("swap", "swap_dynamics", "cycle"), motion.new_zeros(()))}
        # D(C_i, S_j) is the partner's motion where both say the same sentence, in the timing of i. Where they do not,
        # no true motion exists, and content and style that are encoded again must be those that went in.
        swapped = self.decode_scaled(content, style[partner], mask)
        again, style_again = network.content(swapped, mask), self.style_of_window(batch, swapped)
        # Two people who say the same share the movements of lips and jaw in time, but not of brows and lids.
        lower = self.lower_face() if self.options.swap_region == "lower_face" else None
        terms["swap"] = self.distance_to(batch, swapped, pairing.of_partner(motion), pairing.aligned, lower)
        unaligned = pairing.unaligned
        # Detached: the swapped motion is to give back the content that went in, and the content must not become
        # easier to give back.
        terms["swap"] = terms["swap"] + relative_distance(again, content.detach(), scored & unaligned[:, None])
        target = style[partner].detach()
        terms["swap"] = terms["swap"] + relative_distance(style_again[:, None], target[:, None], unaligned[:, None])
        # Two people do not blink at the same time, so the upper face has the partner's spread over time, not motion.
        upper = self.assets.regions["upper_face"].to(motion.device)
        terms["swap_dynamics"] = dynamics_distance(swapped, motion[partner], scored, scored[partner], apart, upper)
        # Swapped back, D(E_C(D(C_i, S_j)), E_S(D(C_j, S_i))) ≈ M_i
        back = self.decode_scaled(again, style_again[partner], mask)
        terms["cycle"] = self.distance_to(batch, back, motion, scored)
        return terms

    def alignment_allowed(self) -> bool:
        """Whether two clips of a training batch that say the same hold the same words.

        Whole clips do; two windows may not, unless the data set makes them begin at the same sound.
        """
        if not self.training or self._trainer is None:
            return False
        data: SpeechMotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        return data.window is None or data.aligner is not None

    def style_of_window(self, batch: Batch, motion: Tensor) -> Float[Tensor, "batch style_dim"]:
        """The style of a batch's scaled motion, of the frames that count alone."""
        if batch.window is None:
            return self.network.style(motion, batch.mask)
        # The encoder reads a sequence from its first frame, so the windows are brought to the front.
        first, lengths = batch.window[:, 0], batch.window_mask.sum(1)
        frame_numbers = first[:, None] + torch.arange(int(lengths.max()), device=motion.device)
        rows = torch.arange(len(motion), device=motion.device)[:, None]
        cut = motion[rows, frame_numbers.clamp_max(motion.shape[1] - 1)]
        return self.network.style(cut, frame_mask(lengths, frame_numbers.shape[1]))

    def distance_to(
        self, batch: Batch, motion: Tensor, truth: Tensor, mask: Tensor, vertices: Tensor | None = None
    ) -> Tensor:
        """The distance of scaled motions on the frames of a mask and some vertices, or the face if None."""
        pairs, options = self.assets.inner_lip_pairs, self.options
        return motion_distance(
            motion,
            truth,
            mask,
            (options.position_weight, options.velocity_weight, options.lip_gap_weight),
            vertices=self.face() if vertices is None else vertices,
            rest=batch.template * self.scale,
            pairs=None if pairs is None else pairs.to(motion.device),
        )

    def face(self) -> Tensor | None:
        """Indices of the vertices that the losses compare; None for all."""
        return self.assets.regions["face"].to(self.device) if self.network.visible is not None else None

    def lower_face(self) -> Tensor:
        """Indices of the vertices that the losses compare, outside the upper face."""
        lower = torch.ones(self.n_vertices, dtype=torch.bool)
        if self.network.visible is not None:
            lower[:] = False
            lower[self.assets.regions["face"]] = True
        lower[self.assets.regions["upper_face"]] = False
        return lower.nonzero()[:, 0].to(self.device)

    def decode_scaled(self, content: Tensor, style: Tensor, mask: Bool[Tensor, "batch frames"]) -> Tensor:
        """D(C, S): scaled motion (B, T, V, 3); undefined on padding."""
        return self.network.decoder(content, style, mask).view(*content.shape[:2], self.n_vertices, self.dims)

    def encode_style(
        self, reference: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions."""
        return self.network.style(reference * self.scale, mask)

    def decode(
        self,
        content: Float[Tensor, "batch frames content_dim"],
        style: Float[Tensor, "batch style_dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames points dims"]:
        """Offsets from the template, zero on padding, of content and style that may be of different speakers."""
        return self.decode_scaled(content, style, mask) / self.scale * mask[..., None, None]

    def graphs(self) -> Graphs:
        """Speech to content, and content with a style to motion (:mod:`facediff.models.graphs`)."""
        network = self.network
        ratio = Fraction(network.ratio).limit_denominator(1000)

        def steps_of(frames: int) -> int:
            # A step more where the ratio is no whole number: it lies beyond the valid steps, and is zero.
            return frames * ratio.numerator // ratio.denominator + (ratio.denominator > 1)

        speech = speech_graph(self, network.content_of, steps_of)
        features = results_of(speech)
        batch, frames = features.shape[:2]
        width = sum(network.style_encoder.token_dims)
        motion = Graph(
            "motion",
            ContentMotionGraph(self),
            {
                "features": features,
                "mask": torch.ones(batch, frames, dtype=torch.bool),
                "style": torch.zeros(batch, width),
            },
            {"features": FRAMES, "mask": FRAMES, "style": BATCH},
            ("offsets",),
        )
        return Graphs(
            parts=[speech, motion, *style_graphs(self, width)],
            equal_lengths=not network.audio_encoder.takes_padding,
            blending="motion",
            clock=self.clock,
            style="reference",
        )

    def generate_clips(
        self, batch: Batch, *, seed: int = 0, progress: Progress | None = None
    ) -> Float[Tensor, "batch frames points dims"]:
        """Content from the speech, style from the reference; nothing is random, so the seed does not matter."""
        return self.decode(self.network.content_of_speech(batch), self.style_of(batch), batch.mask)


# The model as computation graphs.


class ContentMotionGraph(ModelPart[StyleContentDisentanglement]):
    """Content and style to offsets from the template."""

    def forward(
        self,
        features: Float[Tensor, "batch frames content_dim"],
        mask: Bool[Tensor, "batch frames"],
        style: Float[Tensor, "batch style_dim"],
    ) -> Float[Tensor, "batch frames points dims"]:
        """In the unit of the corpus."""
        return self.model.decode(features, style, mask)
