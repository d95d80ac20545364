"""Metrics by name: ``lip_vertex_error:squared=false`` becomes a metric that is made for a corpus and fed from it.

A metric states as class data what it ``needs`` (the lips, the speech, several samples …). Whoever scores says in a
:class:`Context` what the corpus or the run has; :meth:`Request.build` brings the two together, and :func:`feed` hands
each metric those of a batch's inputs that its :meth:`update` takes.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from torchmetrics import Metric

from facediff.errors import FaceDiffError, choices
from facediff.metrics.base import SequenceMetric
from facediff.metrics.channels import Moment, split_frames
from facediff.metrics.regions import Region
from facediff.registry import UnknownComponentError
from facediff.registry import metric as metrics

NEEDS: dict[str, str] = {
    "lips": "the lip vertices",
    "upper_face": "the upper-face vertices",
    "lip_pairs": "pairs of inner-lip vertices",
    "lid_pairs": "pairs of eyelid vertices",
    "channels": "motion in parameters",
    "partner": "the motion of whom the person talks with",
    "speaking": "who speaks when",
    "gallery": "recordings of all speakers",
    "template": "each speaker's neutral face",
    "closures": "the times of bilabial phonemes",
    "speech": "the speech of each clip",
    "identities": "who speaks in each clip",
    "samples": "several samples of each clip",
    "conditions": "predictions of each clip in the styles of several identities",
    "style": "style vectors",
    "time": "how long inference took",
}
"""What a metric may need, in words.

The regions come as the constructor's ``lips`` and ``upper``, either sort of pairs as ``pairs`` (with
``frames_per_second`` for eyelids), channels as ``region``, recordings as ``gallery``; ``speech`` as ``sample_rate`` and
``frames_per_second``, ``identities`` as ``n_identities``, ``time`` as ``hardware``. With each batch come ``template``
(of absolute vertices) or ``offsets_from``, ``partner``, ``closures``, ``waveform``, ``identities``, ``samples``,
``predictions`` (in several styles), ``embeddings`` with ``labels``, and ``computing`` with ``speech``, both in seconds.
"""

MOMENTS: dict[str, Moment] = {"s_": "speaking", "l_": "listening"}
"""Prefixes of metrics that are taken in some frames only."""
OF_ALL_FRAMES = {"closures", "waveform"}
"""What metrics compare motion with by its place in the clip, so that no frames can be left out of it."""

_NOT_CHOSEN = {"definition", "check_finite", "sync_on_compute", "process_group", "n_identities", "sample_rate"}


@dataclass(frozen=True)
class Context:
    """What a corpus or a run has for metrics.

    Args:
        has: by need, the constructor arguments that meet it; empty where the need is met with each batch.
        missing: by need, what to do to have it, or why it cannot be had.
        channels: regions of channels by name, for metrics that read channels; ``all`` among them.
    """

    has: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)
    channels: Mapping[str, Region] = field(default_factory=dict)


@dataclass(frozen=True)
class Request:
    """A metric that was asked for by its registered name with options; ``text`` as written is the score's name.

    ``moment`` says in which frames it is taken: all, or those in which the person speaks or listens.
    """

    text: str
    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    moment: Moment = "all"

    @property
    def needs(self) -> tuple[str, ...]:
        """What the metric needs, words of :data:`NEEDS`."""
        implementation = metrics.get(self.name)
        own = tuple(getattr(implementation, "needs", ()))
        by_option = getattr(implementation, "option_needs", {})
        own += tuple(need for option, need in by_option.items() if self.options.get(option))
        return own if self.moment == "all" else (*own, "speaking")

    @property
    def of_channels(self) -> bool:
        """Whether the metric reads channels where motion is decoded to vertices."""
        return bool(getattr(metrics.get(self.name), "of_channels", False))

    def scaled(self, scale: float) -> Request:
        """The same with a factor of lengths, if the metric takes one and none was given."""
        takes = "scale" in inspect.signature(metrics.get(self.name)).parameters and "scale" not in self.options
        return replace(self, options={**self.options, "scale": scale}) if takes and scale != 1.0 else self

    def build(self, context: Context) -> Metric:
        """The metric, made for a corpus."""
        lacking = [need for need in self.needs if need not in context.has]
        if lacking:
            reasons = "; ".join(
                f"{NEEDS.get(need, need)} ({context.missing.get(need, 'not available here')})" for need in lacking
            )
            raise FaceDiffError(f"metric {self.text}: needs {reasons}")
        implementation = metrics.get(self.name)
        accepted = inspect.signature(implementation).parameters
        arguments = {key: value for need in self.needs for key, value in context.has[need].items() if key in accepted}
        options = dict(self.options)
        region = options.get("region")
        if getattr(implementation, "of_channels", False):
            region = region or implementation.usual_channels
        if isinstance(region, str):  # a region that is given as an option by the name of its need
            regions = {need: value for need in ("lips", "upper_face") for value in context.has.get(need, {}).values()}
            if getattr(implementation, "of_channels", False):
                regions = dict(context.channels)
            if region not in regions:
                raise FaceDiffError(f"metric {self.text}: there is no region {region!r}: {choices(region, regions)}")
            options["region"] = regions[region]
        try:
            return cast(Metric, implementation(**arguments | options))
        except (TypeError, ValueError) as error:
            raise FaceDiffError(f"metric {self.text}: {error}") from error


def parse(text: str) -> Request:
    """Read ``NAME:option=value,option=value``.

    Args:
        text: a registered name, which may be followed by options of the metric. ``s_NAME`` and ``l_NAME`` are the
            metric in the frames in which the person speaks, and listens.

    >>> parse("temporal_misalignment:at=path,smoothing=1.5").options
    {'at': 'path', 'smoothing': 1.5}
    """
    moment: Moment = "all"
    plain = text.strip()
    for prefix, frames in MOMENTS.items():
        if plain.startswith(prefix) and plain.partition(":")[0] not in metrics.names():
            plain, moment = plain.removeprefix(prefix), frames
    try:
        name, options = metrics.read(plain, _NOT_CHOSEN)
    except UnknownComponentError as error:
        # It is an AttributeError too, which a torch module that parses in a property would report as one of its own.
        raise FaceDiffError(str(error)) from error
    if moment != "all":
        taken = inspect.signature(metrics.get(name).update).parameters.keys()
        ordered = getattr(metrics.get(name), "in_order", False)
        if not {"prediction", "truth"} <= taken or OF_ALL_FRAMES & taken or ordered:
            raise FaceDiffError(
                f"metric {text}: {name} scores no frames of prediction and truth by themselves; omit the prefix"
            )
    return Request(text.replace(" ", ""), name, options, moment)


def feed(metric: Metric, inputs: Mapping[str, Any], moment: Moment = "all") -> None:
    """Update a metric with those of the inputs, named as in :data:`NEEDS`, that its :meth:`update` takes.

    Args:
        metric: the metric.
        inputs: by name; with a ``moment``, ``speaking`` among them, a mask (frames,) for each sequence.
        moment: in which frames it is taken; sequences without such a frame are left out.
    """
    taken = inspect.signature(type(metric).update).parameters
    count = None
    if moment != "all":
        count = len(inputs["speaking"])
        inputs = split_frames(dict(inputs), inputs["speaking"], moment)
    kept = inputs.get("kept", [0])
    if kept:
        metric.update(**{name: value for name, value in inputs.items() if name in taken})
    if count is not None and isinstance(metric, SequenceMetric) and (not kept or metric.latest is not None):
        values = torch.full((count,), torch.nan, dtype=torch.float64)
        if kept and metric.latest is not None:
            values[kept] = metric.latest.cpu()
        metric.latest = values


def parse_all(texts: Sequence[str]) -> list[Request]:
    """Read several metrics, each once, as :func:`parse` does."""
    return list({request.text: request for request in map(parse, texts)}.values())
