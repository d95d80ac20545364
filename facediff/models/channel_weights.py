"""Weights of a parametric space's channels in losses and principal components, by the movement of a rig.

Of vertices each coordinate counts by itself. Channels overlap: ``jawOpen`` moves a third of a face and ``eyeBlinkLeft``
an eyelid, and two of them may move the same vertices. With the displacements D of a rig, the squared error of the
vertices is xᵀ (D Dᵀ) x for an error x of the channels: losses by geometry need no vertices.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from facediff.data import Assets

ChannelWeights = Literal["rig", "deviation", "none"]
"""``rig``: by the vertices that they move, where the corpus has a rig, else as ``deviation``; ``deviation``: divided by
their standard deviations; ``none``: as they are."""

SMALLEST = 1e-6
"""Smallest share of the largest variance, or of the largest eigenvalue of a rig's products, that counts: channels that
never move would otherwise count without end, and those that move no vertex could not be told from the weighted ones."""


def channel_weights(
    assets: Assets,
    variances: Float[Tensor, " channels"],
    covariance: Float[Tensor, "channels channels"],
    points: Float[Tensor, "points dims"],
    by: ChannelWeights,
) -> Float[Tensor, "channels channels"]:
    """The matrix W by which channels are multiplied, so that ‖W x‖² is what an error x of the channels counts.

    It keeps the size of the motion: W x has as much variance over the training motion as x. Head and eyes, which turn
    as a whole and which the rig of a face does not know, count as much as its mean channel does.
    """
    count, space = len(variances), assets.space
    weights = torch.eye(count, dtype=torch.float64)
    variances = variances.double()
    if by == "none" or not float(variances.max()) > 0:
        return weights.float()
    spread = variances.clamp_min(SMALLEST * float(variances.max()))
    face = torch.tensor(space.face)
    if by == "rig" and assets.rig is not None:
        values, vectors = torch.linalg.eigh(assets.rig.gram(points))
        # The symmetric root: of all roots of the products the one that mixes channels least.
        root = (vectors * values.clamp_min(SMALLEST * float(values.max())).sqrt()) @ vectors.T
        weights[face[:, None], face] = root
        face_covariance = covariance.double()[face[:, None], face]
        moved = float(torch.einsum("ij,jk,ik->", root, face_covariance, root)) / len(face)
        for channel in sorted({*range(count)} - {*space.face}):
            weights[channel, channel] = (moved / float(spread[channel])) ** 0.5
    else:
        weights = torch.diag(spread.rsqrt() * (points[:, 0].double() if points.shape[1] == 1 else 1.0))
    total = float(torch.einsum("ij,jk,ik->", weights, covariance.double(), weights))
    return (weights * (float(variances.sum()) / total) ** 0.5).float()
