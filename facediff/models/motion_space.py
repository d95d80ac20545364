"""The motion that a diffusion model noises: all vertices, as in the paper, or principal components of the corpus.

From top to bottom: principal components of the training motion, the two spaces, and the preconditioning that a space
with known variances makes possible. Choosing ``components`` changes three things:

- A frame is a few dozen numbers for any mesh.
- The noise hides the motion: vertices move together, so independent noise on thousands of them averages out, and a
  model reads half of the motion off its noisy input at almost every step without listening to the speech.
- The network predicts the part that the noisy motion leaves open, and no longer the whole motion: a network of
  limited width cannot copy its input, and ancestral sampling repeats that error a thousand times.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.errors import ArgumentError, FaceDiffError
from facediff.models.layers import Share
from facediff.models.samplers import Steps
from facediff.registry import motion_space
from facediff.utils.ranges import Dims, Range, Vertices

Offsets = Float[Tensor, "batch frames points dims"]
"""Scaled offsets from the template."""

Components = Float[Tensor, "batch frames all_components"]
"""Principal components of them, of which the reader of training motion may have taken them."""

Coordinates = Float[Tensor, "batch frames coordinates"]
"""A frame as the numbers that are noised."""

RegionWeight = Annotated[float, Range(1e-3, 1e3)]
PriorFrames = Annotated[int, Range(1, 99)]

SMALLEST = 1e-4
"""Components below this share of the first one's deviation are treated as if they had it."""

SEEN_AROUND = (-4, -2, -1, 0, 1, 2, 4)
"""Frames, counted from its own, of which a network sees the smoothed motion."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Offsets from the template (…, V, dims) to components (…, K).

    Attributes:
        into: the linear map, (dims · V, K).
        offset: subtracted first, (K,).
    """

    into: Float[Tensor, "all components"]
    offset: Float[Tensor, " components"]

    def __call__(self, motion: Float[Tensor, "*frames points dims"]) -> Float[Tensor, "*frames components"]:
        """The components of each frame."""
        return motion.flatten(-2) @ self.into - self.offset


class PrincipalComponents(nn.Module):
    """Motion as numbers of unit variance that are uncorrelated over the training frames, largest movement first.

    A model gives every one of its modules of this class the training motion's statistics when its first training
    begins, and keeps them in its checkpoints. Shapes follow from the sizes alone, since weight averaging copies modules
    before a corpus is known.

    Args:
        n_vertices: points V.
        dims: numbers of a point.
        count: components K; motion outside them is lost.

    Attributes:
        mean: mean of all coordinates, (n,) with n = dims · V, scaled.
        basis: unit components of weighted motion, (K, n); zero where the corpus has fewer.
        weights: what each coordinate is multiplied by before the components are taken, (n,); of channels a matrix
            (n, n), since what two of them move together is more or less than the sum of both.
        unweighted: the inverse of such a matrix; None where weights are numbers.
        deviations: the components' standard deviations, (K,).
    """

    mean: Tensor
    basis: Tensor
    weights: Tensor
    unweighted: Tensor | None
    deviations: Tensor

    def __init__(self, n_vertices: int, dims: int, count: int) -> None:
        super().__init__()
        self.dims = dims
        self.count = count
        size = dims * n_vertices
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("basis", torch.zeros(count, size))
        self.register_buffer("weights", torch.eye(size) if dims == 1 else torch.ones(size))
        self.register_buffer("unweighted", torch.eye(size) if dims == 1 else None)
        self.register_buffer("deviations", torch.ones(count))

    def attach(
        self, mean: Float[Tensor, " all"], shapes: Float[Tensor, "components all"], weights: Float[Tensor, "*all"]
    ) -> None:
        """Take over the training motion's statistics.

        Args:
            mean: mean of all coordinates, scaled.
            shapes: principal components of weighted motion, each as long as its standard deviation, largest first;
                those beyond ``count`` are left out.
            weights: what each coordinate was multiplied by, or the matrix that all were.
        """
        shapes = shapes[: self.count]
        deviations = torch.linalg.vector_norm(shapes, dim=1)
        if not len(deviations) or not float(deviations[0]) > 0:
            raise FaceDiffError(
                "the training motion never changes, so it has no principal components, which motion_space=components "
                "and mesh_encoder=components need; check the corpus with `facediff data check`"
            )
        # Copied into the buffers and not assigned: the optimiser, weight averages and compiled graphs hold these very
        # tensors.
        self.mean.copy_(mean)
        self.weights.copy_(weights)
        if self.unweighted is not None:
            self.unweighted.copy_(torch.linalg.inv(weights.double()))
        self.basis.zero_()[: len(shapes)] = shapes / deviations[:, None]
        # Projection divides by the deviations. A component that hardly varies, or that the corpus does not have, would
        # turn rounding errors into coordinates of unit size.
        smallest = SMALLEST * float(deviations[0])
        self.deviations.fill_(smallest)[: len(shapes)] = deviations.clamp_min(smallest)

    def project(
        self, motion: Float[Tensor, "batch frames points dims"] | Float[Tensor, "batch frames all_components"]
    ) -> Float[Tensor, "batch frames components"]:
        """Components of scaled offsets from the template, each of unit variance over the training frames.

        Training motion may come as components already, of a projection of this or of more components.
        """
        if motion.dim() == 3:
            return motion[..., : self.count]
        with torch.autocast(motion.device.type, enabled=False):
            # Not in mixed precision: a sum over 70 000 products in 16 bits would be off by more than the small
            # components' size. Mean and weights are folded into the map: at 6 000 vertices centring a copy of the
            # motion takes longer than the product.
            return self._projection()(motion)

    def projection(self, scale: float) -> Projection:
        """The same for unscaled offsets, by itself, on the processor and in float32 as clips are read."""
        projection = self._projection()
        return Projection((projection.into * scale).float().cpu(), projection.offset.float().cpu())

    def _projection(self) -> Projection:
        weighted = self.basis * self.weights if self.unweighted is None else self.basis @ self.weights
        into = weighted.T / self.deviations
        return Projection(into, self.mean @ into)

    def expand(self, components: Float[Tensor, "batch frames components"]) -> Float[Tensor, "batch frames points dims"]:
        """The scaled offsets with these components; all other components are the mean's."""
        with torch.autocast(components.device.type, enabled=False):
            back = components.to(self.basis.dtype) * self.deviations
            # The basis is orthonormal in weighted coordinates, so its transpose is its inverse there; then the weights
            # are undone.
            shaped = back @ self.basis
            shaped = shaped / self.weights if self.unweighted is None else shaped @ self.unweighted.T
            motion = shaped + self.mean
            return motion.view(*motion.shape[:2], -1, self.dims)


class MotionSpace(nn.Module, ABC):
    """A linear image of motion, in which it is noised and denoised.

    Attributes:
        coordinates: numbers in a frame.
        preconditioning: the scales around the network; None if it predicts clean motion itself.
        prior_frames: length of the windows of which :meth:`fit` takes the covariance over time; 1 for none.
        region_weights: factors of regions' motion before its principal components are taken.
    """

    coordinates: int
    preconditioning: Preconditioning | None
    prior_frames: int = 1
    region_weights: Mapping[str, float] = MappingProxyType({})

    @property
    def inputs(self) -> int:
        """Noisy coordinates, and smoothed ones of some frames where the preconditioning knows motion over time."""
        return self.coordinates * (1 if self.prior_frames == 1 else 1 + len(SEEN_AROUND))

    def noised_variances(self, variances: Float[Tensor, " components"]) -> Float[Tensor, " components"]:
        """Variances of principal components as the noise sees them, from the motion's variances."""
        return variances

    def fit(  # noqa: B027
        self, signal: Float[Tensor, " steps"], covariance: Float[Tensor, "components window window"] | None = None
    ) -> None:
        """Take over the noise process, once the principal components are known."""

    @abstractmethod
    def encode(self, motion: Offsets) -> Coordinates:
        """From scaled offsets to the coordinates that are noised."""

    @abstractmethod
    def decode(self, coordinates: Coordinates) -> Offsets:
        """The way back."""


class MotionSpaceFactory(Protocol):
    """Makes a space once the model's sizes are known."""

    def __call__(self, *, n_vertices: int, dims: int, steps: int) -> MotionSpace:
        """Make one for motion of ``n_vertices`` points of ``dims`` numbers, noised in ``steps`` steps."""


@motion_space.register("vertices")
class VertexMotion(MotionSpace):
    """All coordinates of all vertices; the network predicts clean motion (the paper's setting)."""

    def __init__(self, *, n_vertices: Vertices, dims: Dims, steps: Steps) -> None:
        super().__init__()
        self.coordinates, self.dims = dims * n_vertices, dims
        self.preconditioning = None

    def encode(self, motion: Offsets) -> Coordinates:
        """Every coordinate."""
        return motion.flatten(2)

    def decode(self, coordinates: Coordinates) -> Offsets:
        """Every coordinate."""
        # A view: 70 000 coordinates a frame are not copied.
        return coordinates.view(*coordinates.shape[:2], -1, self.dims)


@motion_space.register("components")
class ComponentMotion(MotionSpace):
    """Principal components of the training motion; the network predicts the part that noise leaves open.

    A component of standard deviation d is noised at the size d₁ · (d / d₁)^(1 − whitening), with the largest deviation
    d₁. Losses weigh each component as its vertices do, at any size in the noise.

    Args:
        count: components K; motion outside them is lost.
        whitening: 0 keeps the components' sizes, which is vertices up to truncation; at 1 all are of equal size, so
            that noise hides small movements (lids, brows) no earlier than large ones (the jaw).
        upper_face_weight: how much more a movement of the upper face counts than another of the same size, in the
            components and in the losses.
        lips_weight: the same for the lips.
        eyelids_weight: the same for the vertices of the corpus's eyelid pairs, if it lists any; None counts them as the
            upper face. Lids are few vertices: so counted, a short training leaves them to the Gaussian prior, and they
            wander instead of resting and blinking.
        prior_frames: length W of the windows, in frames, in which the preconditioning knows how each component moves
            over time, measured on the training split; odd. 1 takes every frame by itself, so that the noise which a
            network leaves is jitter.
    """

    sizes: Tensor

    def __init__(
        self,
        *,
        n_vertices: Vertices,
        dims: Dims,
        steps: Steps,
        count: Annotated[int, Range(1, 4096)] = 64,
        whitening: Share = 0.5,
        upper_face_weight: RegionWeight = 1.0,
        lips_weight: RegionWeight = 1.0,
        eyelids_weight: RegionWeight | None = None,
        prior_frames: PriorFrames = 1,
    ) -> None:
        super().__init__()
        self.coordinates = count
        self.whitening = whitening
        weights = {"upper_face": upper_face_weight, "lips": lips_weight, "eyelids": eyelids_weight}
        self.region_weights = {name: weight for name, weight in weights.items() if weight is not None}
        self.components = PrincipalComponents(n_vertices, dims, count)
        self.register_buffer("sizes", torch.ones(count))
        if prior_frames % 2 == 0:
            raise ArgumentError(
                {"prior_frames": prior_frames}, "expected an odd number, since a frame is in the middle"
            )
        self.prior_frames = prior_frames
        self.preconditioning: Preconditioning = (
            Preconditioning(steps, count) if prior_frames == 1 else TemporalPreconditioning(steps, count, prior_frames)
        )

    def noised_variances(self, variances: Float[Tensor, " components"]) -> Float[Tensor, " components"]:
        """Sizes squared, of as many components as there are."""
        return self._sizes(variances.sqrt()).square()

    def modes(
        self, covariance: Float[Tensor, "components window window"]
    ) -> tuple[Float[Tensor, " modes"], Float[Tensor, " modes"]]:
        """Variances of the movements over a window, as the noise sees them, and their shares of the middle frame's."""
        deviations = self.components.deviations.cpu().double()
        variances, vectors = torch.linalg.eigh(covariance.double())
        variances = variances.clamp_min(0)
        # The middle frame has the whole window around it; a movement there stands for the visible part.
        mode_variances = vectors[:, self.prior_frames // 2].square() * variances
        noised = variances * self._sizes(deviations).square()[:, None]
        return noised.flatten(), (mode_variances * deviations.square()[:, None]).flatten()

    def _sizes(self, deviations: Float[Tensor, " components"]) -> Float[Tensor, " components"]:
        # In proportion to the largest, so that the unit of the corpus drops out; floored, since a corpus with fewer
        # components than ``count`` leaves deviations of 0, by which decoding would divide.
        share = (deviations / deviations[0]).clamp_min(SMALLEST)
        return deviations[0] * share ** (1 - self.whitening)

    def fit(
        self, signal: Float[Tensor, " steps"], covariance: Float[Tensor, "components window window"] | None = None
    ) -> None:
        """Precondition the network by each component's own variance, or covariance over time."""
        deviations = self.components.deviations
        self.sizes.copy_(self._sizes(deviations))
        # The importance undoes the whitening in the loss: an error of one unit in the noised coordinate is deviation /
        # size on the vertices, however large the component was made for the noise.
        importance = (deviations / self.sizes).square()
        if isinstance(self.preconditioning, TemporalPreconditioning) and covariance is not None:
            covariance = covariance.to(self.sizes) * self.sizes.square()[:, None, None]
            self.preconditioning.fit_covariance(signal, covariance, importance)
        else:
            self.preconditioning.fit(signal, self.sizes.square(), importance)

    def encode(self, motion: Offsets | Components) -> Coordinates:
        """Components of weighted offsets from the mean, in the sizes that are noised."""
        return self.components.project(motion) * self.sizes

    def decode(self, coordinates: Coordinates) -> Offsets:
        """The mean and the sum of the components."""
        return self.components.expand(coordinates / self.sizes)


class Preconditioning(nn.Module):
    """Scales that let a network see and predict numbers of unit variance (Karras et al. 2022, table 1).

    For motion x of known variance λ, noised to y = √ᾱ x + √(1 − ᾱ) ε, the prediction of clean motion is
    skip · y + out · F(into · y). Without any network, F = 0, it is the posterior mean of Gaussian motion; F has to say
    what speech and style tell beyond that, in units of the deviation left open. All four tables are (steps,
    coordinates).

    Attributes:
        into: 1 / √(ᾱλ + 1 − ᾱ), which gives the network's input unit variance.
        skip: √ᾱ λ / (ᾱλ + 1 − ᾱ), the Wiener filter.
        out: √(λ(1 − ᾱ) / (ᾱλ + 1 − ᾱ)), the deviation that the filter leaves open.
        loss: weights of squared errors: the vertices' weights over the variance that the filter leaves in a step, so
            that every step counts alike.
    """

    into: Tensor
    skip: Tensor
    out: Tensor
    loss: Tensor

    def __init__(self, steps: int, coordinates: int) -> None:
        super().__init__()
        for name in ("into", "skip", "out", "loss"):
            self.register_buffer(name, torch.zeros(steps, coordinates))

    def fit(
        self,
        signal: Float[Tensor, " steps"],
        variances: Float[Tensor, " coordinates"],
        importance: Float[Tensor, " coordinates"],
    ) -> None:
        """Fill the tables for motion of given variances.

        Args:
            signal: ᾱ of every step.
            variances: λ of every coordinate.
            importance: weights of squared errors of each coordinate.
        """
        # In float64: 1 − ᾱ loses all digits at the clean end.
        alpha, variance, weights = signal.cpu().double()[:, None], variances.cpu().double(), importance.cpu().double()
        # Gaussian motion y = √ᾱ x + √(1 − ᾱ) ε has the variance ᾱλ + 1 − ᾱ; given y, x has the mean √ᾱ λ y / total and
        # the variance λ (1 − ᾱ) / total. These are the tables.
        total = alpha * variance + 1 - alpha
        left = variance * (1 - alpha) / total
        self.into.copy_(total.rsqrt())
        self.skip.copy_(alpha.sqrt() * variance / total)
        self.out.copy_(left.sqrt())
        # Normalised over the coordinates of a step: near the clean end the filter leaves hardly any error open, and
        # such steps would otherwise not be trained.
        self.loss.copy_(weights / (weights * left).sum(1, keepdim=True))

    def hidden(self) -> Float[Tensor, " steps"]:
        """The share of the motion that noise leaves open in each step, counted as the losses count."""
        # The weights of a step are the last one's, over the variance left open relative to it.
        return self.loss[-1, 0] / self.loss[:, 0]

    def posterior_mean(
        self,
        noisy: Coordinates,
        step: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"],  # noqa: ARG002 - every frame by itself
    ) -> Coordinates:
        """The prediction without any network; ``mask`` is True on valid frames."""
        return self.skip[step][:, None] * noisy

    def inputs(
        self,
        noisy: Coordinates,
        mean: Coordinates,  # noqa: ARG002 - the noisy motion in another size
        step: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"],  # noqa: ARG002
    ) -> Float[Tensor, "batch frames inputs"]:
        """The network's input, given the noisy motion and its posterior mean; of unit variance."""
        return self.into[step][:, None] * noisy

    def clean(
        self,
        mean: Coordinates,
        features: Coordinates,
        step: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"],  # noqa: ARG002
    ) -> Coordinates:
        """The prediction of clean motion from the posterior mean and the network's output."""
        # c_skip and c_out of Karras et al. (2022, eq. 7), one for each component and step. At the clean end skip is 1
        # and out 0, so that a network's errors no longer reach the sample.
        return mean + self.out[step][:, None] * features


class TemporalPreconditioning(Preconditioning):
    """The same for motion with a known covariance over time: the skip is a smoother, and so is the output's scale.

    With the covariance C = V Λ Vᵀ of a coordinate in a window of W frames, noised window y, the posterior mean is
    V [√ᾱ Λ / (ᾱΛ + 1 − ᾱ)] Vᵀ y, and the posterior covariance V [Λ (1 − ᾱ) / (ᾱΛ + 1 − ᾱ)] Vᵀ. The prediction is the
    mean plus the symmetric root of the covariance times the network's output: the network's errors from frame to
    frame come out as small as motion is at that frequency. Without any network it is the posterior mean of Gaussian
    motion with this covariance, and so the exact sampler of it.

    A frame lies in the middle of its window, and nearer to an end only where the clip or the window of a stream ends.
    Shorter motion is taken as if it went on at the mean: without any network, its last frames vary by a quarter
    to a half too little.

    Attributes:
        vectors: V of every coordinate, (coordinates, W, W).
        variances: Λ, (coordinates, W).
        signal: ᾱ of every step.
        into_mean: one over the deviation of the posterior mean, (steps, coordinates).
    """

    vectors: Tensor
    variances: Tensor
    signal: Tensor
    into_mean: Tensor

    def __init__(self, steps: int, coordinates: int, frames: int) -> None:
        super().__init__(steps, coordinates)
        self.frames = frames
        self.register_buffer("into_mean", torch.zeros(steps, coordinates))
        self.register_buffer("vectors", torch.zeros(coordinates, frames, frames))
        self.register_buffer("variances", torch.zeros(coordinates, frames))
        self.register_buffer("signal", torch.zeros(steps))

    def fit_covariance(
        self,
        signal: Float[Tensor, " steps"],
        covariance: Float[Tensor, "coordinates window window"],
        importance: Float[Tensor, " coordinates"],
    ) -> None:
        """Fill the tables for motion of given covariances over time."""
        wide = covariance.cpu().double()
        variances, vectors = torch.linalg.eigh((wide + wide.flip(1, 2)) / 2)  # motion runs both ways alike
        middle = self.frames // 2
        self.fit(signal, wide[:, middle, middle], importance)
        variances = variances.clamp_min(SMALLEST**2 * variances.amax(1, keepdim=True))
        self.vectors.copy_(vectors)
        self.variances.copy_(variances)
        self.signal.copy_(signal)
        alpha, weights = signal.cpu().double()[:, None, None], importance.cpu().double()
        total, shares = alpha * variances + 1 - alpha, vectors[:, middle].square()
        left = (shares * variances * (1 - alpha) / total).sum(2)
        self.into_mean.copy_((shares * alpha * variances.square() / total).sum(2).clamp_min(1e-30).rsqrt())
        self.loss.copy_(weights / (weights * left).sum(1, keepdim=True))

    def posterior_mean(
        self, noisy: Coordinates, step: Int[Tensor, " batch"], mask: Bool[Tensor, "batch frames"]
    ) -> Coordinates:
        """The smoothed motion; ``mask`` is True on valid frames."""
        alpha = self.signal[step][:, None, None]
        return self._filtered(noisy, alpha.sqrt() * self.variances / (alpha * self.variances + 1 - alpha), mask)

    def inputs(
        self,
        noisy: Coordinates,
        mean: Coordinates,
        step: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames inputs"]:
        """The noisy motion, and the smoothed one of the frame and of some around it, of unit variance."""
        # A Gaussian prior takes blinks for drift: the smoothed motion is to be made sharp where it has the course of a
        # blink, and smaller everywhere else. A short training does not find that course in the noise of many frames.
        count, reach = noisy.shape[1], max(SEEN_AROUND)
        around = nn.functional.pad(self.into_mean[step][:, None] * mean * mask[..., None], (0, 0, reach, reach))
        neighbours = [around[:, reach + offset : reach + offset + count] for offset in SEEN_AROUND]
        return torch.cat([super().inputs(noisy, mean, step, mask), *neighbours], -1)

    def clean(
        self,
        mean: Coordinates,
        features: Coordinates,
        step: Int[Tensor, " batch"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Coordinates:
        """The prediction of clean motion from the posterior mean and the network's output."""
        alpha = self.signal[step][:, None, None]
        left = self.variances * (1 - alpha) / (alpha * self.variances + 1 - alpha)
        return mean + self._filtered(features, left.sqrt(), mask)

    def _filtered(
        self,
        values: Coordinates,
        gains: Float[Tensor, "batch coordinates window"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Coordinates:
        """The rows of V diag(gains) Vᵀ, each times the window of its frame."""
        # In the weights' own precision: autocast would round the motion itself to half precision.
        with torch.autocast(values.device.type, enabled=False):
            return self._rows_times_windows(values.to(self.vectors.dtype), gains, mask)

    def _rows_times_windows(self, values: Tensor, gains: Tensor, mask: Tensor) -> Tensor:
        width, half, count = self.frames, self.frames // 2, values.shape[1]
        rows = (self.vectors * gains[:, :, None]) @ self.vectors.transpose(1, 2)  # batch, coordinates, row, window
        values = nn.functional.pad(values * mask[..., None], (0, 0, half, width)).transpose(1, 2)
        inner = torch.einsum("bctw,bcw->btc", values.unfold(2, width, 1)[:, :, :count], rows[:, :, half])
        # The first and the last frames are in the middle of no window: they take other rows of the outermost ones.
        frame, length = torch.arange(count, device=mask.device), mask.sum(1)[:, None]
        start = (length - width).clamp_min(0)
        index = (start + half + torch.arange(width, device=mask.device))[:, None].expand(-1, values.shape[1], -1)
        outermost = [
            torch.einsum("bcw,bcrw->brc", window, rows).gather(
                1, row[..., None].expand(*values.shape[:1], -1, values.shape[1])
            )
            for window, row in (
                (values[..., half : half + width], frame.clamp_max(width - 1)[None]),
                (values.gather(2, index), (frame - start).clamp(0, width - 1)),
            )
        ]
        filtered = torch.where((frame < half)[:, None], outermost[0], inner)
        return torch.where((frame >= length - half)[..., None], outermost[1], filtered)
