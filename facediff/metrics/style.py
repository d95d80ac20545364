"""Is it the speaker, by the motion's nearness to recordings of known speakers?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import (
    Clip,
    FiniteOptions,
    SequenceMetric,
    UpdateOptions,
    check_range,
    functional,
    whole_numbers,
)
from facediff.registry import metric


@dataclass(frozen=True, eq=False)
class SpeakerGallery:
    """Recordings of known speakers, each by its mean motion.

    Args:
        means: the mean over time of each recording's offsets from its speaker's template, (recordings, vertices, 3).
        speakers: the number of each recording's speaker.
    """

    means: Tensor
    speakers: tuple[int, ...]


@metric.register("nearest_speaker_accuracy")
class NearestSpeakerAccuracy(SequenceMetric):
    """Nearest-speaker accuracy: share of motions with a mean nearest to their own speaker's.

    People differ in how they hold and move their faces, and so in the mean m of their offsets over a sequence. A
    gallery of recordings (the training clips, and recordings of no split for unseen speakers) says how: m is taken in
    the first principal components of the gallery's means; there, with C the covariance within speakers, which mood and
    words cause, and S = C + ``shrinkage`` · tr(C) / K · I, the nearest speaker is the one with a mean m̄ at the
    smallest distance (m − m̄)ᵀ S⁻¹ (m − m̄). Guessing gives 1 / speakers, and the true motion is the
    ceiling, which depends on K: of Puppet's test splits A and B (10 speakers) it names 70 % and 53 % with 16
    components, 92 % and 88 % with 64. Compare with it only. Definition ours.

    Give a model only a reference and no label of the speaker to see whether the reference carries the person:
    ``facediff generation-metrics`` does.

    Args:
        gallery: recordings of known speakers.
        components: principal components K, at most; ``facediff generation-metrics`` takes 64.
        shrinkage: how much of an even covariance is added, so that no direction decides alone.

    >>> means = torch.tensor([[[0.0, 0.0, 0.0]], [[0.0, 2.0, 0.0]], [[5.0, 0.0, 0.0]], [[5.0, 2.0, 0.0]]])
    >>> gallery = SpeakerGallery(means, (0, 0, 1, 1))
    >>> motion = torch.tensor([[4.0, 9.0, 0.0], [4.0, 7.0, 0.0]])[:, None]
    >>> [nearest_speaker_accuracy(motion, [number], gallery).item() for number in (0, 1)]
    [0.0, 1.0]
    """

    higher_is_better = True
    leaves_out = "their speakers have no recording in the gallery"
    needs: ClassVar[tuple[str, ...]] = ("identities", "gallery")
    centre: Tensor
    basis: Tensor
    whitening: Tensor
    speaker_means: Tensor
    numbers: Tensor

    def __init__(
        self,
        gallery: SpeakerGallery,
        *,
        components: int = 16,
        shrinkage: float = 0.1,
        **options: Unpack[FiniteOptions],
    ) -> None:
        check_range("components", components, 1)
        check_range("shrinkage", shrinkage, 1e-12)
        numbers, speaker = torch.unique(torch.tensor(gallery.speakers), return_inverse=True)
        definition = (
            f"share of motions whose mean over time is nearest to that of their own speaker among {len(numbers)}, by "
            f"Mahalanobis distance within speakers in {components} principal components of {len(speaker)} recordings, "
            f"covariance shrunk by {shrinkage:g}; mean over sequences [1]"
        )
        super().__init__(definition=definition, **options)
        means = gallery.means.flatten(1).double().cpu()
        centre = means.mean(0)
        apart = means - centre
        # The products of recordings with one another have the same components as a covariance of (3V, 3V).
        values, vectors = torch.linalg.eigh(apart @ apart.T)
        selected = (values > 1e-10 * values[-1]).nonzero().flatten().flip(0)[:components]
        basis = vectors[:, selected].T @ apart
        basis = basis / basis.norm(dim=1, keepdim=True)
        projections = apart @ basis.T
        centres = torch.stack([projections[speaker == number].mean(0) for number in range(len(numbers))])
        within = projections - centres[speaker]
        covariance = within.T @ within / max(1, len(speaker) - len(numbers))
        even = covariance.diagonal().mean() if bool(within.any()) else torch.ones(())
        shrunk = covariance + shrinkage * even * torch.eye(len(selected), dtype=torch.float64)
        whitening = torch.linalg.cholesky(torch.linalg.inv(shrunk))
        for name, value in (
            ("centre", centre),
            ("basis", basis),
            ("whitening", whitening),
            ("speaker_means", centres @ whitening),
            ("numbers", numbers),
        ):
            self.register_buffer(name, value, persistent=False)

    def check_vertices(self, n_vertices: int) -> None:
        """Refuse motion of another mesh than the gallery's."""
        if 3 * n_vertices != len(self.centre):
            raise ValueError(f"the gallery is of {len(self.centre) // 3} vertices, the motion has {n_vertices}")

    def clip_value(self, clip: Clip) -> Tensor:
        """1 if the nearest speaker is the right one, else 0; NaN if that speaker is not in the gallery."""
        mean = clip.prediction.double().mean(0)
        if clip.template is not None:
            mean = mean - clip.template.double()
        projected = (mean.flatten() - self.centre) @ self.basis.T @ self.whitening
        nearest = self.numbers[(self.speaker_means - projected).square().sum(1).argmin()]
        in_gallery = (self.numbers == clip.identity).any()
        return torch.where(in_gallery, (nearest == clip.identity).double(), torch.nan)

    def update(
        self,
        prediction: Tensor,
        identities: Tensor | Sequence[int],
        *,
        template: Tensor | None = None,
        **batch: Unpack[UpdateOptions],
    ) -> None:
        """Add a batch of sequences (batch, frames, vertices, 3).

        ``identities`` are the numbers of the speakers whom they should show, ``template`` the neutral vertices of an
        absolute prediction. **None means that it is offsets from the template already.**
        """
        clips = self.align(prediction, prediction, **batch)
        clips = clips.attach_templates(template)
        numbers = whole_numbers("identities", identities, len(clips.clips), 2**62)
        self.add(clips.attach("identity", numbers))


nearest_speaker_accuracy = functional(NearestSpeakerAccuracy)
