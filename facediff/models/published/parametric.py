"""Common parts of the published methods in parameters: standardised channels, of which a network sees some."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.data import Batch, Reference, SpeechMotionDataModule
from facediff.errors import OptionError
from facediff.models.checkpoint_content import CheckpointContent
from facediff.models.evaluation import IdentityPolicy
from facediff.models.inference import Style
from facediff.models.layers import Heads, Layers, Width, check_heads
from facediff.models.published.base import NO_STYLE, PublishedModel
from facediff.models.published.clip_style import TABLE_ROWS, ClipStyleEncoder
from facediff.speech.windows import Rule
from facediff.utils.ranges import Range

DEAD = 0.01
"""Smallest divisor of a channel, as a share of the largest deviation: a channel that hardly moves would otherwise be
blown up to noise."""


class ParametricModel(PublishedModel):
    """Base of the published methods that generate parameters, in windows of their own and of speech of any length.

    Class attributes:
        jaw_opens: whether a jaw's axis-angle is generated about x alone, the others being their mean.

    Args:
        head: generate the head's rotation, where the space has one; else it stays at rest.
        shape_dim: coefficients of a person's shape that the network is conditioned on.
        unseen_identity: as in :class:`facediff.models.AnimationModel`; the methods know a speaker by a style clip.
        style_dim: channels of the style.
        style_layers: layers of the style encoder.
        style_heads: its attention heads.
        style_rows: rows of its table of positions.
        options: see :class:`~facediff.models.published.base.PublishedModel`.

    Attributes:
        style_encoder: of a clip; a method makes it by :attr:`make_style_encoder` in its place among its modules, on
            which initial weights depend.
    """

    interpolates: ClassVar[bool] = True
    jaw_opens: ClassVar[bool] = True
    clock_rule: ClassVar[Rule | None] = "rounded"
    style_encoder: ClipStyleEncoder

    motion_mean: Tensor
    motion_std: Tensor
    shapes: Tensor

    def __init__(
        self,
        *,
        head: bool = True,
        shape_dim: Annotated[int, Range(0, 1000)] = 0,
        unseen_identity: IdentityPolicy = "style_only",
        style_dim: Width = 128,
        style_layers: Layers = 4,
        style_heads: Heads = 4,
        style_rows: Annotated[int, Range(2, 100_000)] = TABLE_ROWS,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(unseen_identity=unseen_identity, **options)
        check_heads(style_dim=style_dim, style_heads=style_heads, even=True)
        self.plan_long_speech("extend")  # the methods cut speech into windows by themselves
        numbers = self.coordinates
        turned = () if self.space.is_vertices else self.space.rotations
        still = {channel for turn in turned if turn.joint == "head" and not head for channel in turn.channels}
        for turn in turned:
            if turn.joint == "jaw" and turn.form == "axis_angle" and self.jaw_opens:
                still |= {*turn.channels[1:]}
        self.modelled = tuple(channel for channel in range(numbers) if channel not in still)
        turning = self.space.head if not self.space.is_vertices else ()
        self.head_places = tuple(i for i, channel in enumerate(self.modelled) if channel in turning)
        self.resting = () if head else tuple(turning)
        self.style_dim = style_dim
        self.make_style_encoder = partial(
            ClipStyleEncoder,
            len(self.modelled),
            style_dim,
            num_layers=style_layers,
            num_heads=style_heads,
            feed_forward_dim=4 * style_dim,
            rows=style_rows,
        )
        self.register_buffer("motion_mean", torch.zeros(numbers))
        self.register_buffer("motion_std", torch.ones(numbers))
        self.register_buffer("shapes", torch.zeros(len(self.identities), shape_dim))

    def personal_modules(self) -> list[nn.Module]:
        """The style encoder."""
        return [self.style_encoder]

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """Take the mean and the deviation of every channel from the training split."""
        result = super().measure(data, at_least)
        mean, components = data.principal_motion(len(self.motion_mean))
        deviation = components.square().sum(0).sqrt()
        self.motion_mean.copy_(mean)
        self.motion_std.copy_(deviation.clamp_min(DEAD * float(deviation.max())))
        return result

    def own_styles(self) -> dict[str, Style]:
        """None: the methods take a style from a clip, and know no table of speakers."""
        return {}

    def styled_identities(self) -> list[str]:
        """The speakers with a stored style."""
        return CheckpointContent.styled_identities(self)

    def default_style(self, identity: str) -> Reference | Style:
        """The person's style or the stored reference; no style, as the models train to do without, if there is none."""
        if identity in self.person_styles or identity in self.assets.references:
            return CheckpointContent.default_style(self, identity)
        return NO_STYLE

    def standardised(self, motion: Float[Tensor, "batch frames points dims"]) -> Float[Tensor, "batch frames channels"]:
        """The channels that the network sees, with zero mean and unit deviation."""
        return ((motion.flatten(2) - self.motion_mean) / self.motion_std)[..., list(self.modelled)]

    def absolute(self, motion: Float[Tensor, "frames channels"]) -> Float[Tensor, "frames points dims"]:
        """The inverse of :meth:`standardised`.

        Channels that the network does not see have their mean, and a head that stays still has 0.
        """
        frames = motion.new_zeros(len(motion), len(self.motion_mean))
        frames[:, list(self.modelled)] = motion
        frames = frames * self.motion_std + self.motion_mean
        frames[:, list(self.resting)] = 0.0
        return frames.view(len(frames), self.n_vertices, self.dims)

    def shapes_of(self, batch: Batch) -> Float[Tensor, "batch shape_dim"]:
        """Each clip's coefficients of shape; the first identity's for an unknown one."""
        return self.shapes[batch.identity.clamp_min(0)]


def window_at(
    values: Float[Tensor, "batch frames width"], lengths: Int[Tensor, " batch"], first: Int[Tensor, " batch"], size: int
) -> tuple[Float[Tensor, "batch size width"], Bool[Tensor, "batch size"]]:
    """A window of each clip and which of its frames are the clip's; the others are zero."""
    indices = first[:, None] + torch.arange(size, device=values.device)
    valid = indices < lengths[:, None]
    rows = torch.arange(len(values), device=values.device)[:, None]
    return values[rows, indices.clamp_max(values.shape[1] - 1)] * valid[..., None], valid


def statistics_of(content: Mapping[str, Any], keys: tuple[str, ...]) -> tuple[Tensor, Tensor]:
    """Mean and deviation of some arrays of a file of statistics (``exp_mean``, ``exp_std`` …), one after the other."""
    mean, deviation = (
        torch.cat([torch.as_tensor(content[f"{key}_{name}"]).float().flatten() for key in keys])
        for name in ("mean", "std")
    )
    if not bool((deviation > 0).all()):
        raise OptionError.naming(
            f"{{statistics}}: the deviations of {', '.join(keys)} hold {float(deviation.min()):g}; expected numbers "
            f"above 0, as the authors' file has them"
        )
    return mean, deviation
