"""As whom people are animated in a test whom the model was not trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

from facediff.data import Batch, Reference
from facediff.data.batch import pad
from facediff.errors import FaceDiffError

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
            f"unseen_identity=adapted: clip {batch.names[unknown[0]]} is of {batch.subjects[unknown[0]]}, whom the "
            f"model does not know; let it get to know them with `facediff adapt`, or choose another policy"
        )
    found = [("", batch.select(known))] if known else []
    strangers = batch.select(unknown)
    for index, name in enumerate(identities):
        if name not in references:
            raise FaceDiffError(f"unseen_identity=each_seen: the model holds no style reference of {name}")
        motion = references[name].motion.to(strangers.reference)
        length = strangers.reference_lengths.new_full((len(strangers),), len(motion))
        view = replace(
            strangers,
            identity=strangers.identity.new_full((len(strangers),), index),
            reference=pad([motion] * len(strangers)),
            reference_lengths=length,
            reference_names=[references[name].clip] * len(strangers),
        )
        found.append((name, view))
    return found
