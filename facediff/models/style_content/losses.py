"""Distances of motions, contents and styles, and which recording goes with which, on padded batches with a mask.

First the distances in the objectives of style-content disentanglement, then the pairs of clips that they
compare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from facediff.data import Batch
from facediff.models.losses import masked_std
from facediff.models.squared_errors import neighbours, squared_errors
from facediff.speech.cepstra import align_features, cepstra

Motion = Float[Tensor, "batch frames points dims"]
Mask = Bool[Tensor, "batch frames"]
EPSILON = 1e-6
"""Added to denominators and under roots, so that gradients are finite."""


def motion_distance(
    motion: Motion,
    truth: Motion,
    mask: Mask,
    weights: Sequence[float],
    *,
    vertices: Int[Tensor, " region"] | None = None,
    rest: Float[Tensor, "batch points dims"] | None = None,
    pairs: Int[Tensor, "pairs 2"] | None = None,
) -> Float[Tensor, ""]:
    """How far two motions are apart: weighted mean squared differences; 0 for equal motions.

    Args:
        motion: offsets from the template.
        truth: their target.
        mask: frames that count.
        weights: of the positions, of the differences from frame to frame, and of the distance between the inner lips.
        vertices: vertices that count; all if None.
        rest: the templates in the motion's unit, for that distance.
        pairs: upper and lower vertices of the inner lips; None if the corpus lists none.
    """
    columns = None
    if vertices is not None:
        columns = torch.zeros(motion.shape[2], motion.shape[3], dtype=torch.bool, device=motion.device)
        columns = columns.index_fill(0, vertices, True).flatten()
    squares = squared_errors(motion.flatten(2), truth.flatten(2), mask, columns)
    width = motion.shape[3] * (motion.shape[2] if vertices is None else len(vertices))
    moved, changed = (
        total / (valid.sum() * width).clamp_min(1)
        for total, valid in zip(squares, (mask, neighbours(mask)), strict=True)
    )
    position, velocity, lip_gap = weights
    total = position * moved + velocity * changed
    if not lip_gap or pairs is None or rest is None:
        return total
    gap = (_gaps(motion, rest, pairs) - _gaps(truth, rest, pairs)).square().mean(-1)
    return total + lip_gap * frame_mean(gap, mask)


def _gaps(motion: Motion, rest: Tensor, pairs: Tensor) -> Float[Tensor, "batch frames pairs"]:
    """Distances between the paired vertices; its gradient is finite where they touch."""
    ends = (motion.index_select(2, pairs.T.flatten()) + rest.index_select(1, pairs.T.flatten())[:, None]).chunk(2, 2)
    # The root's slope is infinite at 0, which closed lips reach in every p, b and m.
    return ((ends[0] - ends[1]).square().sum(-1) + EPSILON).sqrt()


def frame_mean(values: Float[Tensor, "batch frames"], mask: Mask) -> Float[Tensor, ""]:
    """Mean over valid frames; 0 if there is none."""
    return (values * mask).sum() / mask.sum().clamp_min(1)


def squared_distance(
    values: Float[Tensor, "batch frames dim"], target: Float[Tensor, "batch frames dim"], mask: Mask
) -> Float[Tensor, ""]:
    """Mean squared difference on valid frames, as it is; 0 if there is none."""
    return frame_mean((values - target).square().mean(2), mask)


def relative_distance(
    values: Float[Tensor, "batch frames dim"], target: Float[Tensor, "batch frames dim"], mask: Mask
) -> Float[Tensor, ""]:
    """Mean squared difference as a share of the variance of the values.

    A share, so that it is not made small by making all values small.
    """
    first, second = values[mask], target[mask]
    # A single frame has no variance to be a share of.
    if len(first) < 2:
        return values.new_zeros(())
    # Two independent values of one distribution are twice its variance apart, hence the factor 2: unrelated contents
    # then have the distance 2, and equal ones 0.
    spread = first.var(0, correction=0).mean() + second.var(0, correction=0).mean()
    return 2 * (first - second).square().mean() / (spread + EPSILON)


def style_distance(styles: Float[Tensor, "clips dim"], identities: Sequence[str]) -> Float[Tensor, ""]:
    """Mean squared difference of two styles of one identity, over all such pairs; 0 if no identity has two styles."""
    count = len(identities)
    pairs = [(i, k) for i in range(count) for k in range(i + 1, count) if identities[i] == identities[k]]
    if not pairs:
        return styles.new_zeros(())
    first, second = torch.tensor(pairs, device=styles.device).T
    return (styles[first] - styles[second]).square().mean()


def dynamics_distance(
    motion: Motion,
    truths: Motion,
    mask: Mask,
    truth_mask: Mask,
    counted: Bool[Tensor, " batch"],
    vertices: Int[Tensor, " region"],
) -> Float[Tensor, ""]:
    """Mean over vertices of (σ − σ̂)² / σ̄², σ the spread over time of a vertex's squared displacement, as in FDD.

    σ̄ is the mean of σ̂ over vertices and clips. The motions need not be aligned, nor be of one length: two speakers
    who say the same do not blink at the same time, but one may blink more.

    Args:
        motion: (B, T, V, 3).
        truths: (B, T, V, 3), with the spread that the motions should have.
        mask: valid frames of the motions.
        truth_mask: valid frames of the truths.
        counted: True on the clips that count.
        vertices: vertices that count.
    """
    if not counted.any():
        return motion.new_zeros(())
    # FDD's own quantity is the spread of the squared displacement, so the loss compares the same one.
    squared = [clips.index_select(2, vertices)[counted].square().sum(-1) for clips in (motion, truths)]
    spread, true_spread = masked_std(squared[0], mask[counted]), masked_std(squared[1], truth_mask[counted])
    return (spread - true_spread).square().mean() / (true_spread.mean().square() + EPSILON)


@dataclass(frozen=True)
class Pairing:
    """Each clip's partner, and which of the partner's frames goes with each of its frames.

    Attributes:
        partner: index of the partner; a clip without one is its own.
        frames: for each frame the partner's frame of the same sound; 0 where the two are not aligned.
        aligned: True on valid frames of clips with a partner that says the same sentence.
    """

    partner: Int[Tensor, " batch"]
    frames: Int[Tensor, "batch frames"]
    aligned: Mask

    def of_partner(self, values: Tensor) -> Tensor:
        """Values (batch, frames, …) of the partners, in the timing of the clips themselves."""
        rows = self.partner[:, None].expand_as(self.frames)
        return values[rows, self.frames]

    @property
    def unaligned(self) -> Bool[Tensor, " batch"]:
        """Clips with a partner who says something else."""
        unpaired = self.partner == torch.arange(len(self.partner), device=self.partner.device)
        return ~unpaired & ~self.aligned.any(1)


def pair_up(batch: Batch, alignments: Alignments | None) -> Pairing:
    """Neighbours 2k and 2k + 1 are partners; those that say the same sentence are aligned in time.

    There is nothing to swap between two sentences of one speaker: each clip is its own partner then.

    Args:
        batch: clips; one that is left over is its own partner.
        alignments: aligns recordings of one sentence; None aligns no pairs.
    """
    count, frames = batch.mask.shape
    partner = torch.arange(count)
    for clip in range(0, count - 1, 2):
        if (
            batch.identity_names[clip] != batch.identity_names[clip + 1]
            or batch.sentences[clip] == batch.sentences[clip + 1]
        ):
            partner[clip], partner[clip + 1] = clip + 1, clip
    partner_frames = torch.zeros(count, frames, dtype=torch.long)
    aligned = torch.zeros(count, frames, dtype=torch.bool)
    if alignments is not None and batch.partner_frames is not None:
        # Windows of clips, which the data set has aligned already, from the speech of the whole clips.
        partner_frames = batch.partner_frames.cpu().clamp_min(0)
        aligned = (batch.partner_frames >= 0).cpu() & (partner != torch.arange(count))[:, None]
        device = batch.motion.device
        return Pairing(partner.to(device), partner_frames.to(device), aligned.to(device) & batch.window_mask)
    for clip, second_clip in enumerate(partner.tolist()):
        same = clip != second_clip and batch.sentences[clip] == batch.sentences[second_clip]
        if alignments is not None and same and batch.names[clip] != batch.names[second_clip]:
            # Dynamic time warping of the speech: two recordings of one sentence differ in timing, and comparing frame
            # by frame would teach the swapped motion the partner's timing.
            matches = alignments.frames(batch, clip, second_clip)
            partner_frames[clip, : len(matches)] = matches
            aligned[clip, : len(matches)] = True
    device = batch.motion.device
    return Pairing(partner.to(device), partner_frames.to(device), aligned.to(device))


class Alignments:
    """Alignments of pairs of clips, each computed once and kept.

    Args:
        frame_rate: motion frames a second.
    """

    def __init__(self, frame_rate: float) -> None:
        self.frame_rate = frame_rate
        self._found: dict[tuple[str, str], Tensor] = {}

    def __call__(self, speech: Tensor, frames: int, second_speech: Tensor, second_frames: int) -> Tensor:
        """For each frame of one recording the frame of another one, indices (frames,).

        Args:
            speech: of the one recording, (samples,) at 16 kHz.
            frames: motion frames of it.
            second_speech: of the other.
            second_frames: motion frames of the other.
        """
        return torch.from_numpy(
            align_features(
                cepstra(speech.numpy(), frames, self.frame_rate),
                cepstra(second_speech.numpy(), second_frames, self.frame_rate),
            )
        )

    def frames(self, batch: Batch, clip: int, second_clip: int) -> Tensor:
        """For each valid frame of a clip of the batch the frame of another one, indices (frames,)."""
        names = (batch.names[clip], batch.names[second_clip])
        if names not in self._found:
            self._found[names] = self(*self._recording(batch, clip), *self._recording(batch, second_clip))
        return self._found[names]

    def _recording(self, batch: Batch, clip: int) -> tuple[Tensor, int]:
        audio = batch.audio[clip, : int(batch.audio_lengths[clip])].float().cpu()
        return audio, int(batch.frame_lengths[clip])
