"""Scores of a model beside what a still face and shuffled speech score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, cast

import torch
from torch import Tensor

from facediff.data import Assets, Batch, Reference
from facediff.data.batch import pad
from facediff.errors import FaceDiffError
from facediff.metrics import ProtocolMetrics, Region, SequenceMetric, protocol

# As whom people are animated in a test whom the model was not trained on.

IdentityPolicy = Literal["style_only", "each_seen", "adapted"]
"""``style_only``: as nobody known, with the style of their own reference. ``each_seen``: as each training identity in
turn, with that identity's own style, and the mean of the scores, as the released test scripts do. ``adapted``: as
themselves, which the model must have been adapted to."""


def conditioned(
    batch: Batch, policy: IdentityPolicy, identities: Sequence[str], references: Mapping[str, Reference]
) -> list[tuple[str, Batch]]:
    """The batches to score in place of one, each with the name of the identity for its unknown people.

    A clip of somebody known comes once.

    Args:
        batch: clips of known and of unknown people.
        policy: what becomes of the unknown ones.
        identities: training identities in the order of the identity index.
        references: their style references.

    Raises:
        FaceDiffError: if the policy is ``adapted`` and somebody is unknown, or an identity has no style to lend.
    """
    known = [clip for clip, index in enumerate(batch.identity.tolist()) if index >= 0]
    unknown = [clip for clip in range(len(batch)) if clip not in known]
    if not unknown or policy == "style_only":
        return [("", batch)]
    if policy == "adapted":
        raise FaceDiffError(
            f"unseen_identity=adapted: clip {batch.names[unknown[0]]} is of {batch.identity_names[unknown[0]]}, whom "
            f"the model does not know; let it get to know them with `facediff adapt`, or choose another policy"
        )
    found = [("", batch.select(known))] if known else []
    unseen = batch.select(unknown)
    for index, name in enumerate(identities):
        if name not in references:
            raise FaceDiffError(f"unseen_identity=each_seen: the model holds no style reference of {name}")
        motion = references[name].motion.to(unseen.reference)
        length = unseen.reference_lengths.new_full((len(unseen),), len(motion))
        view = replace(
            unseen,
            identity=unseen.identity.new_full((len(unseen),), index),
            reference=pad([motion] * len(unseen)),
            reference_lengths=length,
            reference_names=[references[name].clip] * len(unseen),
        )
        found.append((name, view))
    return found


METHODS = ("model", "still", "shuffled")
"""Who is scored: the model, a face that never moves, the model given another sentence's speech."""


class Evaluation:
    """Metrics of one protocol for every split and method.

    No part of the model's module tree: weight averaging copies that tree before the regions are known.

    Args:
        protocol_name: the protocol.
        unseen_identity: as whom people are animated whom the model was not trained on; told beside the scores.
    """

    def __init__(self, protocol_name: str, unseen_identity: str) -> None:
        self.protocol = protocol(protocol_name)
        self.unseen_identity = unseen_identity
        self.splits: list[str] = []
        self.metrics: dict[str, dict[str, ProtocolMetrics]] = {}
        self._sequences: list[dict[str, Any]] = []

    def prepare(self, assets: Assets, splits: Sequence[str], device: torch.device) -> None:
        """Make empty metrics for a corpus's regions, on the device where processes reduce them."""
        regions = {
            name: Region.from_indices(
                f"{assets.corpus}/{name if len(indices) < assets.n_vertices else 'all vertices'}",
                indices,
                n_vertices=assets.n_vertices,
            )
            for name, indices in assets.regions.items()
        }
        self.splits = list(splits)
        self._sequences = []
        methods = METHODS if self.splits != ["val"] else METHODS[:1]
        self.metrics = {
            split: {
                method: self.protocol.build(regions["lips"], regions["upper_face"]).to(device) for method in methods
            }
            for split in self.splits
        }

    def update(self, split: str, method: str, motion: Tensor, batch: Batch, identity: str = "") -> None:
        """Add a batch's motion (offsets from the template), unless another process adds the same clips.

        Args:
            split: the split.
            method: who made the motion.
            motion: offsets from the template.
            batch: the clips with their true motion.
            identity: the identity that all clips were animated as, if it is not their own.
        """
        if batch.repeated:
            return
        metrics = self.metrics[split][method].to(motion.device)
        metrics.update(motion, batch.motion, lengths=batch.frame_lengths, clip_names=batch.names)
        if split == "val":
            return
        scorers = cast(Sequence[tuple[str, SequenceMetric]], metrics.items(copy_state=False))
        values = {name: cast(Tensor, metric.latest).tolist() for name, metric in scorers}
        for place, (clip, frames) in enumerate(zip(batch.names, batch.frame_lengths.tolist(), strict=True)):
            own = {name: each[place] for name, each in values.items()}
            told = {"split": split, "method": method, "clip": clip, "identity": identity, "frames": frames}
            self._sequences.append({**told, **own})

    def sequences(self) -> list[dict[str, Any]]:
        """One row per test clip and method with its own scores, of all processes; collective under several."""
        rows = self._sequences
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            shares: list[Any] = [None] * torch.distributed.get_world_size()
            torch.distributed.all_gather_object(shares, rows)
            rows = [row for share in shares for row in share]
        return sorted(rows, key=lambda row: (row["split"], METHODS.index(row["method"]), row["clip"], row["identity"]))

    def scalars(self, split: str) -> dict[str, float]:
        """``<split>/<metric>`` of the model and ``<split>/<method>/<metric>`` of the others; empties the metrics."""
        found: dict[str, float] = {}
        for row in self.rows(split):
            for name in map(str, self.metrics[split]["model"]):
                prefix = split if row["method"] == "model" else f"{split}/{row['method']}"
                found[f"{prefix}/{name}"] = row[name]
        for metrics in self.metrics[split].values():
            metrics.reset()
        return found

    def rows(self, split: str) -> list[dict[str, Any]]:
        """One row per method: scores, and what they were taken over; collective under several processes."""
        table = []
        for method, metrics in self.metrics[split].items():
            summary = metrics.summary()
            if not summary.coverage.sequences:
                continue  # no clip of the split had speech of another sentence to shuffle with
            scores = {name: float(value) for name, value in metrics.compute().items()}
            told = {"split": split, "method": method, "unseen_identity": self.unseen_identity}
            table.append({**told, **scores, **summary.as_dict()})
        return table
