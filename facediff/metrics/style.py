"""Is it the speaker? By style embeddings, and by generated motion itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import (
    Clip,
    ExactMetric,
    FiniteOptions,
    ProcessOptions,
    SequenceMetric,
    UpdateOptions,
    check_option,
    check_range,
    functional,
    whole_numbers,
)
from facediff.registry import metric

Closeness = Literal["cosine", "euclidean"]
"""How the nearest embedding is found: largest cosine similarity, or smallest Euclidean distance."""

_ROWS = 1024


@metric.register("style_retrieval_accuracy")
class StyleRetrievalAccuracy(ExactMetric):
    """Style retrieval accuracy: share of style embeddings with the label of their nearest other.

    Leave one out: each embedding is a query for the nearest among all others, and is right if that one carries its
    label, for example the speaker. Where several are equally near it is right by their share, so that order
    does not matter. An embedding with a label of its own cannot be right and is no query, but may be
    found. From 0 to 1; guessing gives about the share of embeddings with the same label.

    The accuracy is a common test of speaker embeddings; nearest neighbour, leaving one out and counting ties
    by share are choices.

    **Memory grows with the number of embeddings**, unlike with every other metric here: each is compared
    with each at the end. They are small, one for each clip, and are kept in float64: 10 000 of 256 numbers
    take 20 MB.

    Args:
        closeness: ``"cosine"`` or ``"euclidean"``.

    >>> metric = StyleRetrievalAccuracy()
    >>> metric.update(torch.tensor([[1.0, 0.0], [0.9, 0.1], [0.0, 1.0], [0.6, 0.6]]), [7, 7, 8, 8])
    >>> metric.compute().item(), metric.queries()
    (0.75, 4)
    """

    higher_is_better = True
    needs = ("style",)
    embeddings: list[Tensor]
    labels: list[Tensor]
    width: Tensor

    def __init__(self, *, closeness: Closeness = "cosine", **options: Unpack[ProcessOptions]) -> None:
        check_option("closeness", closeness, Closeness)
        measure = "largest cosine similarity" if closeness == "cosine" else "smallest Euclidean distance"
        super().__init__(
            definition=f"share of style embeddings whose nearest other ({measure}) has the same label, ties by share, "
            "among those whose label another carries [1]",
            **options,
        )
        self.closeness: Closeness = closeness
        # Flat, and never an empty list: torchmetrics gathers a process without data as one flat float32 tensor.
        self.add_state("embeddings", [], dist_reduce_fx="cat")
        self.add_state("labels", [], dist_reduce_fx="cat")
        self.add_state("width", torch.zeros((), dtype=torch.int64), dist_reduce_fx="max")
        self._seed()

    def _seed(self) -> None:
        device = self.width.device
        self.embeddings.append(torch.empty(0, dtype=torch.float64, device=device))
        self.labels.append(torch.empty(0, dtype=torch.int64, device=device))

    def reset(self) -> None:
        """Forget all embeddings."""
        super().reset()
        self._seed()

    def update(
        self, embeddings: Tensor, labels: Tensor | Sequence[int], *, clip_names: Sequence[str] | None = None
    ) -> None:
        """Add embeddings (batch, dim) with the numbers of their speakers (batch,), and names for messages."""
        if embeddings.ndim != 2 or int(self.width) not in (0, embeddings.shape[1]):
            raise ValueError(
                f"embeddings have shape {tuple(embeddings.shape)}; expected (batch, {int(self.width) or 'dim'})"
            )
        count, width = embeddings.shape
        numbers = torch.tensor(whole_numbers("labels", labels, count, 2**62), device=self.width.device)
        wide = embeddings.detach().to(self.width.device, torch.float64)
        invalid = ~wide.isfinite().all(1)
        if self.closeness == "cosine":
            invalid |= (wide == 0).all(1)
        if bool(invalid.any()):
            row = int(invalid.nonzero()[0])
            name = f"embedding {row} of the batch" if clip_names is None else f"the embedding of {clip_names[row]}"
            raise ValueError(f"{name} holds NaN or infinity, or is all zero; repair it or omit it")
        if not count:
            return
        self.width = torch.full_like(self.width, width)
        self.embeddings.append(wide.flatten())
        self.labels.append(numbers)

    def queries(self) -> int:
        """How many embeddings are queries, over all processes."""
        if self._is_synced:
            return int(_is_query(self._gathered()[1]).sum())
        with self.sync_context(dist_sync_fn=self.dist_sync_fn, should_sync=self.sync_on_compute):
            return int(_is_query(self._gathered()[1]).sum())

    def compute(self) -> Tensor:
        """The accuracy over all embeddings so far, a float64 scalar."""
        flat, labels = self._gathered()
        queries = _is_query(labels)
        if len(flat) != len(labels) * int(self.width) or not bool(queries.any()):
            self.leave_synchronised_state()
            raise ValueError(
                f"{len(labels)} style embeddings, {int(queries.sum())} of them with another of the same label and "
                "size; give at least two of one label"
            )
        points = flat.view(len(labels), -1)
        if self.closeness == "cosine":  # the nearest of unit vectors is the one with the largest cosine
            points = points / points.norm(dim=1, keepdim=True)
        right = torch.zeros((), dtype=torch.float64, device=points.device)
        for rows in torch.split(queries.nonzero().flatten(), _ROWS):
            # Exact, so that equal embeddings are equally near: the quick way over |a|² + |b|² − 2ab ranks by rounding.
            distances = torch.cdist(points[rows], points, compute_mode="donot_use_mm_for_euclid_dist")
            distances[torch.arange(len(rows), device=rows.device), rows] = torch.inf
            nearest = distances == distances.amin(1, keepdim=True)
            same = labels[rows][:, None] == labels[None, :]
            right += ((nearest & same).sum(1).double() / nearest.sum(1)).sum()
        return right / queries.sum()

    def _gathered(self) -> tuple[Tensor, Tensor]:
        """All embeddings, flat, and their labels; after a reduction over processes these are no lists."""
        embeddings, labels = (
            torch.cat(state) if isinstance(state, list) else state for state in (self.embeddings, self.labels)
        )
        return embeddings, labels


style_retrieval_accuracy = functional(StyleRetrievalAccuracy)


def _is_query(labels: Tensor) -> Tensor:
    """Which embeddings have another of their label."""
    _, groups, counts = torch.unique(labels, return_inverse=True, return_counts=True)
    return counts[groups] > 1


# Nearest speaker.


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
