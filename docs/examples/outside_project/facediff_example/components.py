"""The smallest component of each kind that a model is made of; the decoder has a file of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from facediff.models.audio_encoders import AudioEncoder
from facediff.models.fusions import Fusion
from facediff.models.mesh_encoders import MeshEncoder
from facediff.models.motion_space import MotionSpace
from facediff.models.samplers import NoiseProcess, Sampler
from facediff.models.speaker_encoders import IdentityEncoder, StyleEncoder


class LoudnessEncoder(AudioEncoder):
    """The loudness of each frame, mapped to the model's channels.

    Args:
        dim: channels; given by the model.
    """

    def __init__(self, *, dim: int) -> None:
        super().__init__()
        self.map = nn.Linear(1, dim)

    def forward(self, audio: Tensor, audio_lengths: Tensor, frame_lengths: Tensor) -> Tensor:
        """One feature per frame; zero on padding frames."""
        features = audio.new_zeros(len(audio), int(frame_lengths.max()), self.map.out_features)
        for clip, (samples, frames) in enumerate(zip(audio_lengths.tolist(), frame_lengths.tolist(), strict=True)):
            pieces = audio[clip, :samples].tensor_split(frames)
            loudness = torch.stack([piece.square().mean().nan_to_num().sqrt() for piece in pieces])
            features[clip, :frames] = self.map(loudness[:, None])
        return features


class OneHotIdentity(IdentityEncoder):
    """A one-hot label, mapped to the model's channels; zeros for unseen speakers.

    Args:
        dim: channels; given by the model.
        n_identities: training identities; given by the model.
    """

    def __init__(self, *, dim: int, n_identities: int) -> None:
        super().__init__()
        self.map = nn.Linear(n_identities, dim, bias=False)
        self.token_dims = (dim,)

    def forward(self, identity: Tensor) -> Tensor:
        """One row per clip."""
        labels = nn.functional.one_hot(identity.clamp_min(0), self.map.in_features).to(self.map.weight.dtype)
        return self.map(labels * (identity >= 0)[:, None])


class HalvedMotion(MotionSpace):
    """All coordinates of all vertices, at half their size.

    Args:
        n_vertices: points of the motion; given by the model.
        dims: numbers of a point: 3 of a vertex, 1 of a channel; given by the model.
        steps: of the noise process; given by the model.
    """

    def __init__(self, *, n_vertices: int, dims: int, steps: int) -> None:
        super().__init__()
        self.coordinates, self.dims = dims * n_vertices, dims
        self.preconditioning = None

    def encode(self, motion: Tensor) -> Tensor:
        """Halve."""
        return motion.flatten(2) / 2

    def decode(self, coordinates: Tensor) -> Tensor:
        """Double."""
        return 2 * coordinates.unflatten(2, (-1, self.dims))


class DistanceMeshEncoder(MeshEncoder):
    """How far each vertex is from its place in the neutral face, mapped to the model's channels.

    Args:
        dim: channels; given by the model.
        n_vertices: points of the motion; given by the model.
        dims: numbers of a point: 3 of a vertex, 1 of a channel; given by the model.
    """

    def __init__(self, *, dim: int, n_vertices: int, dims: int) -> None:
        super().__init__()
        self.map = nn.Linear(n_vertices, dim)

    def forward(self, motion: Tensor) -> Tensor:
        """One feature per frame."""
        return self.map(motion.norm(dim=-1))


class MeanStyle(StyleEncoder):
    """The mean over the reference's frames.

    Args:
        dim: channels; given by the model.
    """

    def __init__(self, *, dim: int) -> None:
        super().__init__()
        self.token_dims = (dim,)

    def forward(self, reference: Tensor, mask: Tensor) -> Tensor:
        """One vector per clip; padding does not count."""
        return (reference * mask[..., None]).sum(1) / mask.sum(1, keepdim=True).clamp_min(1)


class GatedFusion(Fusion):
    """Speech features, times a gate that the noisy motion opens.

    Args:
        dim: channels; given by the model.
    """

    def __init__(self, *, dim: int) -> None:
        super().__init__()
        self.gate = nn.Linear(dim, dim)

    def forward(self, audio: Tensor, motion: Tensor, mask: Tensor) -> Tensor:
        """Frame by frame, so that padding has no influence."""
        return audio * self.gate(motion).sigmoid() + motion


class OneJump(Sampler):
    """Takes the prediction of every step as the truth and adds fresh noise for the next.

    Args:
        process: the noise process; given by the model.
        steps: denoising steps.
    """

    linear: ClassVar[bool] = True

    def __init__(self, *, process: NoiseProcess, steps: int = 4) -> None:
        super().__init__(process, steps)

    def update(self, i: int, noisy: Tensor, predictions: Sequence[Tensor], noise) -> Tensor:  # noqa: ANN001
        """The last update returns the last prediction, as a linear sampler must."""
        then = self.signal[i + 1]
        clean = predictions[-1]
        return clean if then == 1 else then**0.5 * clean + (1 - then) ** 0.5 * noise(noisy)
