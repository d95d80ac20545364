"""The training losses of the dual-path style diffusion paper, section 1.5, as their definitions (eq. 15 to 19).

All take padded batches with a frame mask; padding never counts, so that a clip's loss does not depend on how far it
is padded. Motion is (batch, frames, vertices, 3): offsets from the template.

Training computes the same numbers in one pass over the vertices: :mod:`facediff.models.losses_fused`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

Motion = Float[Tensor, "batch frames points dims"]
Mask = Bool[Tensor, "batch frames"]
Scalar = Float[Tensor, ""]

TERMS = ("reconstruction", "velocity", "acceleration", "face")


def training_losses(
    prediction: Motion, truth: Motion, mask: Mask, region: Int[Tensor, " upper_face"], weights: Mapping[str, float]
) -> dict[str, Tensor]:
    """The four terms by name, and ``loss``: L = L_recon + λ_vel L_vel + λ_acc L_acc + λ_face L_face (eq. 15)."""
    terms = {
        "reconstruction": reconstruction_loss(prediction, truth, mask),
        "velocity": velocity_loss(prediction, truth, mask),
        "acceleration": acceleration_loss(prediction, truth, mask),
        "face": face_dynamics_loss(prediction, truth, mask, region),
    }
    return {**terms, "loss": torch.stack([weights[name] * term for name, term in terms.items()]).sum()}


def reconstruction_loss(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """L_recon = Huber(M⁰, M̂⁰) (eq. 16).

    Example:
        >>> truth, mask = torch.zeros(1, 4, 5, 3), torch.ones(1, 4, dtype=torch.bool)
        >>> reconstruction_loss(truth + 2, truth, mask)
        tensor(1.5000)
    """
    return huber(prediction, truth, mask)


def velocity_loss(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """L_vel: Huber loss of the first differences over time (eq. 17); 0 for a single frame."""
    # A difference exists only between two valid frames: the one over a clip's end would compare motion with padding.
    pairs = mask[:, 1:] & mask[:, :-1]
    return huber(prediction.diff(dim=1), truth.diff(dim=1), pairs)


def acceleration_loss(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """L_acc: Huber loss of the second differences over time (eq. 18); exactly 0 below three frames."""
    if prediction.shape[1] < 3:
        return prediction.new_zeros(())
    all_three = mask[:, 2:] & mask[:, 1:-1] & mask[:, :-2]
    return huber(prediction.diff(n=2, dim=1), truth.diff(n=2, dim=1), all_three)


def face_dynamics_loss(prediction: Motion, truth: Motion, mask: Mask, region: Int[Tensor, " upper_face"]) -> Scalar:
    """L_face: mean over upper-face vertices of |σ − σ̂| (eq. 19).

    σ is the standard deviation over time of the length of a vertex's displacement.
    """
    # Only the length of the displacement, not its direction: the upper face hardly follows from speech (blinks, brows),
    # so its liveliness can be asked for, but not its course.
    true, predicted = (
        masked_std(torch.linalg.vector_norm(motion[:, :, region], dim=-1), mask) for motion in (truth, prediction)
    )
    return (true - predicted).abs().mean()


def huber(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """Mean Huber loss (δ = 1) over the coordinates of all valid frames; 0 if there is none."""
    loss = F.huber_loss(prediction, truth, reduction="none").mean((2, 3))
    # The mean over all valid frames of the batch and not the mean of clips' means: a long clip weighs as its frames do,
    # and the result does not depend on how far clips are padded.
    return (loss * mask).sum() / mask.sum().clamp_min(1)


def masked_std(values: Float[Tensor, "batch frames vertices"], mask: Mask) -> Float[Tensor, "batch vertices"]:
    """Population standard deviation over each clip's valid frames; its gradient is 0 where it is 0."""
    weight = mask[..., None].to(values.dtype)
    count = weight.sum(1).clamp_min(1)
    mean = (values * weight).sum(1) / count
    variance = ((values - mean[:, None]).square() * weight).sum(1) / count
    # The square root's slope is infinite at 0: the inner `where` keeps it out of the gradient, the outer one gives 0.
    positive = variance > 0
    return torch.where(positive, variance.where(positive, torch.ones_like(variance)).sqrt(), 0.0)


def preconditioned_losses(
    prediction: Float[Tensor, "batch frames coordinates"],
    truth: Float[Tensor, "batch frames coordinates"],
    mask: Mask,
    importance: Float[Tensor, "batch coordinates"],
    weights: Mapping[str, float],
) -> dict[str, Tensor]:
    """Squared errors of motion, velocity and acceleration in a motion space, and their weighted sum ``loss``.

    Squared and not Huber's, and without L_face: the mean of the motions that are possible is the minimum of the first
    alone, and a sampler needs this mean. Huber's minimum lies nearer to the median, L_face's at the liveliness of
    a whole motion, which a mean over many does not have.
    """
    # Differences over time are linear, so the error's differences are the errors of velocity and acceleration.
    gap, valid = prediction - truth, mask
    terms = {}
    for name in ("reconstruction", "velocity", "acceleration"):
        squared = (gap.square() * importance[:, None]).sum(-1)
        terms[name] = (squared * valid).sum() / valid.sum().clamp_min(1)
        gap, valid = gap[:, 1:] - gap[:, :-1], valid[:, 1:] & valid[:, :-1]
    return {**terms, "loss": torch.stack([weights[name] * term for name, term in terms.items()]).sum()}


def style_contrast(styles: Float[Tensor, "clips dim"], identities: Sequence[str], temperature: float = 0.1) -> Scalar:
    """Pulls styles of one identity together and styles of different identities apart.

    For every style, the mean negative log-probability of picking another one of the same identity among all others,
    with cosine similarities over the temperature as logits (supervised contrast, Khosla et al. 2020, eq. 2). Pulling
    alone would be satisfied by one style for all. 0 if no identity has two styles, or there is one identity.
    """
    same = torch.tensor([[first == second for second in identities] for first in identities], device=styles.device)
    diagonal = torch.eye(len(identities), dtype=torch.bool, device=styles.device)
    same &= ~diagonal
    directions = torch.nn.functional.normalize(styles.float(), dim=1)
    # A style is not compared with itself: its logit of −∞ takes it out of the softmax. The sum below leaves it out
    # by choice, since −∞ times a mask's 0 would be NaN.
    logits = (directions @ directions.T / temperature).masked_fill(diagonal, -torch.inf)
    chances = logits.log_softmax(1)
    counts = same.sum(1)
    # No identity has two styles, or all styles are of one identity: there is nothing to contrast.
    if not counts.any() or bool(same.logical_or(diagonal).all()):
        return styles.new_zeros(())
    # Each style is an anchor that weighs the same however many others of its identity the batch has (L_out of the
    # paper); a sum over all pairs would let identities with many clips dominate.
    clip_losses = -chances.where(same, 0.0).sum(1) / counts.clamp_min(1)
    return clip_losses[counts > 0].mean()


def style_identity_loss(logits: Float[Tensor, "clips identities"], identity: Int[Tensor, " clips"]) -> Scalar:
    """Mean cross-entropy of a style's speaker; clips of unseen speakers (−1) do not count."""
    total = F.cross_entropy(logits.float(), identity, ignore_index=-1, reduction="sum")
    return total / (identity >= 0).sum().clamp_min(1)
