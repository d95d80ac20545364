"""From padded batches to pairs of sequences that can be compared frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from facediff.metrics.options import LENGTH_RULES, LengthRule, check_option

Lengths = Tensor | Sequence[int] | int
"""Valid frames of each sequence, (batch,) integers, or a boolean mask of them (batch, frames)."""


@dataclass(frozen=True)
class Clip:
    """One sequence to score, and what some metrics are given beside it.

    Args:
        name: What messages call the sequence.
        prediction: (frames, vertices, 3), a view; (frames, samples, vertices, 3) where there are several.
        truth: (frames, vertices, 3), a view; the prediction itself where a metric has no truth.
        template: Neutral vertices (vertices, 3), as the metric reads them.
        speech: Intensity of the speech in each frame (frames,), float64; empty if none was given.
        closures: Closures of the mouth, each a first frame and the frame after the last.
        identity: Number of the identity.
    """

    name: str
    prediction: Tensor
    truth: Tensor
    template: Tensor | None = None
    speech: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.float64))
    closures: tuple[tuple[int, int], ...] = ()
    identity: int = 0

    @property
    def frames(self) -> int:
        """How many frames are scored."""
        return len(self.truth)


@dataclass(frozen=True)
class Clips:
    """The sequences of one batch, and how many frames the length rule cut from either side."""

    clips: tuple[Clip, ...]
    cut_prediction: int
    cut_truth: int
    n_vertices: int

    def with_templates(self, templates: Sequence[Tensor | None]) -> Clips:
        """The same with a template for each sequence."""
        changed = (replace(clip, template=still) for clip, still in zip(self.clips, templates, strict=True))
        return replace(self, clips=tuple(changed))

    def check_finite(self) -> None:
        """Refuse NaN and infinity in the frames that are scored.

        Raises:
            ValueError: Naming the first clip concerned and the side.
        """
        sides = [
            (clip.name, side, motion)
            for clip in self.clips
            for side, motion in (("truth", clip.truth), ("prediction", clip.prediction))
            if side == "prediction" or motion is not clip.prediction
        ]
        if not sides:
            return
        # A sum is NaN or infinite if any term is, and costs a tenth of looking at every value. It can also
        # overflow by itself, so suspicion is followed by the exact test. One transfer for the whole batch.
        sums = torch.stack([motion.sum(dtype=_wide(motion.dtype)).double() for _, _, motion in sides])
        for (name, side, motion), fine in zip(sides, sums.isfinite().tolist(), strict=True):
            if not fine and not bool(motion.isfinite().all()):
                bad = (~motion.isfinite()).flatten(1).any(1).nonzero()[0].item()
                raise ValueError(
                    f"the {side} of {name} holds NaN or infinity, first in frame {bad}; "
                    "a score over it would mean nothing: repair or leave out this clip"
                )


def _wide(dtype: torch.dtype) -> torch.dtype:
    """A type in which to add up many values of ``dtype``."""
    return torch.float32 if dtype in (torch.float16, torch.bfloat16) else dtype


def align(
    prediction: Tensor,
    truth: Tensor,
    *,
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
    rule: LengthRule = "min",
) -> Clips:
    """Take padding off and bring each prediction and its truth to one length.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3), floating point.
        truth: Likewise; its padded number of frames may differ.
        lengths: Valid frames of the truth, and of the prediction unless ``prediction_lengths`` is given.
            Without it every frame of either tensor is valid.
        prediction_lengths: Valid frames of the prediction. Needed beside ``lengths`` if the two tensors
            differ in their padded number of frames.
        clip_names: One name a sequence, for messages.
        rule: What to do where the lengths differ.

    Raises:
        ValueError: If shapes, types or lengths do not fit, a clip has no frame, or the rule refuses the
            lengths.
    """
    check_option("length rule", rule, LENGTH_RULES)
    prediction, truth = prediction.detach(), truth.detach()  # scores are read, not optimised: keep no graph
    single = truth.ndim == 3
    _check_motion("prediction", prediction, truth.ndim)
    _check_motion("truth", truth, truth.ndim)
    if single:
        prediction, truth = prediction[None], truth[None]
    batch = len(truth)
    if len(prediction) != batch or prediction.shape[2:] != truth.shape[2:]:
        raise ValueError(
            f"prediction {tuple(prediction.shape)} and truth {tuple(truth.shape)} must agree in batch and vertices"
        )
    if prediction.shape[1] != truth.shape[1] and lengths is not None and prediction_lengths is None:
        raise ValueError(
            f"prediction and truth are padded to {prediction.shape[1]} and {truth.shape[1]} frames, "
            "so `lengths` cannot hold for both; give `prediction_lengths` too"
        )
    names = _names(clip_names, batch, single)
    valid = _lengths("lengths", lengths, truth)
    given = prediction_lengths if prediction_lengths is not None else lengths
    predicted = _lengths("prediction_lengths", given, prediction)
    clips, cut_prediction, cut_truth = [], 0, 0
    for place, (name, theirs, ours) in enumerate(zip(names, valid, predicted, strict=True)):
        frames = _common_length(name, theirs, ours, rule)
        cut_prediction += ours - frames
        cut_truth += theirs - frames
        clips.append(Clip(name, prediction[place, :frames], truth[place, :frames]))
    return Clips(tuple(clips), cut_prediction, cut_truth, truth.shape[2])


def _check_motion(name: str, motion: Tensor, ndim: int) -> None:
    if motion.ndim not in (3, 4) or motion.ndim != ndim or motion.shape[-1] != 3:
        raise ValueError(
            f"{name} has shape {tuple(motion.shape)}; prediction and truth must both be "
            "(batch, frames, vertices, 3) or both (frames, vertices, 3)"
        )
    if motion.shape[-2] == 0:
        raise ValueError(f"{name} has no vertex: shape {tuple(motion.shape)}")
    if not motion.is_floating_point():
        raise ValueError(f"{name} must be floating point, not {motion.dtype}")


def _names(clip_names: Sequence[str] | None, batch: int, single: bool) -> list[str]:
    if clip_names is None:
        return ["the clip"] if single else [f"clip {place} of the batch" for place in range(batch)]
    names = [clip_names] if isinstance(clip_names, str) else list(clip_names)
    if len(names) != batch:
        raise ValueError(f"{len(names)} clip_names for {batch} sequences; give one a sequence")
    return names


def _lengths(name: str, lengths: Lengths | None, motion: Tensor) -> list[int]:
    """Valid frames of each sequence as plain integers, checked against the padded motion."""
    batch, padded = motion.shape[:2]
    if lengths is None:
        return [padded] * batch
    values = torch.as_tensor(lengths)
    if values.dtype == torch.bool:
        mask = values.reshape(-1, values.shape[-1]) if values.ndim else values
        if mask.shape != (batch, padded):
            raise ValueError(f"the mask {name} has shape {tuple(values.shape)}, not {(batch, padded)}")
        values = mask.sum(1)
        if not torch.equal(mask, torch.arange(padded, device=mask.device) < values[:, None]):
            raise ValueError(f"the mask {name} must be true from the first frame on, without gaps")
    if values.is_floating_point() or values.ndim > 1 or values.numel() != batch:
        raise ValueError(f"{name} must hold {batch} whole numbers, one a sequence, not {tuple(values.shape)}")
    found = [int(value) for value in values.reshape(-1).tolist()]
    for value in found:
        if not 0 <= value <= padded:
            raise ValueError(f"{name} holds {value}; the motion has {padded} frames, so 0 to {padded} can be valid")
    return found


def _common_length(name: str, truth: int, prediction: int, rule: LengthRule) -> int:
    """Frames of one clip to score under the rule."""
    refused = prediction < truth if rule == "prediction" else prediction != truth
    if rule != "min" and refused:
        raise ValueError(
            f"{name}: the prediction has {prediction} frames, the truth {truth}; the length rule "
            f"{rule!r} refuses this. Predict all frames, or choose a rule that cuts"
        )
    frames = min(prediction, truth)
    if frames == 0:
        raise ValueError(f"{name} has no frame to score: prediction {prediction}, truth {truth} frames; leave it out")
    return frames
