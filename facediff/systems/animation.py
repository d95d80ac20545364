"""What goes into and comes out of animating: a style vector, a sample made of speech, a prediction."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from facediff.data import Assets, Reference, Sample
from facediff.data.audio import SAMPLE_RATE, samples_for
from facediff.errors import FaceDiffError

Progress = Callable[[Iterable[int]], Iterable[int]]
"""Wraps an iteration, e.g. in a progress bar."""


@dataclass(frozen=True)
class Style:
    """A style vector.

    Attributes:
        name: what it was made of.
        vector: as :meth:`SpeechAnimator.encode_style` gives it.
    """

    name: str
    vector: Float[Tensor, " style_dim"]


@dataclass
class Prediction:
    """Predicted motion of one clip; not frozen, since Lightning moves predictions between devices in place.

    Attributes:
        name: the clip.
        identity: whose identity conditioned it: a training identity, or ``unknown``.
        reference_name: the clip that gave the style.
        vertices: absolute vertices.
    """

    name: str
    identity: str
    reference_name: str
    vertices: Float[Tensor, "frames vertices 3"]


def speech_sample(audio: Float[Tensor, " samples"], assets: Assets, subject: str, style: Reference | Style) -> Sample:
    """Speech alone as a sample of the data contract; its motion gives the number of frames only.

    Args:
        audio: speech at 16 kHz.
        assets: of the checkpoint.
        subject: whose face and identity.
        style: whose manner.

    Raises:
        FaceDiffError: if the subject is unknown, the reference does not fit the topology, or the speech is shorter than
            a frame.
    """
    template = assets.template(subject)
    # A vector goes past the style path, which then has nothing to look at.
    nothing = template.new_zeros(1, *template.shape)
    reference = style if isinstance(style, Reference) else Reference(style.name, nothing)
    if reference.motion.shape[1:] != template.shape:
        raise FaceDiffError(
            f"style: the reference {reference.clip} has {reference.motion.shape[1]} vertices, the checkpoint's "
            f"faces have {len(template)}; give a motion of the same topology"
        )
    frames = round(len(audio) * assets.frame_rate / SAMPLE_RATE)
    if frames < 1:
        raise FaceDiffError(f"the speech is shorter than one frame ({1 / assets.frame_rate:.3f} s); give more of it")
    length = samples_for(frames, assets.frame_rate)
    return Sample(
        audio=torch.nn.functional.pad(audio[:length], (0, max(0, length - len(audio)))),
        motion=torch.zeros(frames, *template.shape),
        template=template,
        identity=assets.identity_index(subject),
        reference=reference.motion.float(),
        name="speech",
        subject=subject,
        sentence="",
        reference_name=reference.clip,
        style=style.vector if isinstance(style, Style) else None,
    )
