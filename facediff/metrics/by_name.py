"""Metrics by name: ``lip_vertex_error:squared=false`` becomes a metric that is made for a corpus and fed from it.

A metric states its ``needs`` as class data (the lips, the speech, several samples …). A :class:`Context` has the data
of the corpus or the run; :meth:`Request.build` brings the two together, and :func:`feed` hands
each metric the inputs of a batch that its :meth:`update` takes.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from torchmetrics import Metric

from facediff.errors import FaceDiffError, check_known, damaged
from facediff.metrics.base import INTERNAL, SequenceMetric
from facediff.metrics.channels import Moment, split_frames
from facediff.metrics.regions import Region
from facediff.registry import metric as metrics

NEEDS: dict[str, str] = {
    "lips": "the lip vertices",
    "upper_face": "the upper-face vertices",
    "lip_pairs": "pairs of inner-lip vertices",
    "lid_pairs": "pairs of eyelid vertices",
    "channels": "motion in parameters",
    "partner": "the motion of the other person in the conversation",
    "speaking": "who speaks when",
    "gallery": "recordings of all speakers",
    "template": "each speaker's neutral face",
    "closures": "the times of bilabial phonemes",
    "speech": "the speech of each clip",
    "identities": "who speaks in each clip",
    "samples": "several samples of each clip",
    "conditions": "predictions of each clip in the styles of several identities",
    "time": "how long inference took",
}
"""Needs of metrics, in words.

The regions come as the constructor's ``lips`` and ``upper``, either sort of pairs as ``pairs`` (with
``frames_per_second`` for eyelids), channels as ``region``, recordings as ``gallery``; ``speech`` as ``sample_rate`` and
``frames_per_second``, ``identities`` as ``n_identities``, ``time`` as ``hardware``. With each batch come ``template``
(of absolute vertices) or ``offsets_from``, ``partner``, ``closures``, ``waveform``, ``identities``, ``samples``,
``predictions`` (in several styles), and ``computing`` with ``speech``, both in seconds.
"""

MOMENTS: dict[str, Moment] = {"s_": "speaking", "l_": "listening"}
"""Prefixes of metrics that are taken in some frames only."""
OF_ALL_FRAMES = {"closures", "waveform"}
"""Inputs that belong to certain frames of a clip, so that no frames can be left out."""

_HIDDEN = INTERNAL | {"n_identities", "sample_rate"}


@dataclass(frozen=True)
class Context:
    """The data that a corpus or a run has for metrics.

    Args:
        has: by need, the constructor arguments that meet it; empty where the need is met with each batch.
        reasons: by need, the reason why it is not met, or the way to meet it.
        channels: regions of channels by name, for metrics that read channels; ``all`` among them.
    """

    has: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
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
        """The metric's needs, keys of :data:`NEEDS`."""
        implementation = metrics.get(self.name)
        inputs = tuple(getattr(implementation, "needs", ()))
        by_option = getattr(implementation, "option_needs", {})
        inputs += tuple(need for option, need in by_option.items() if self.options.get(option))
        return inputs if self.moment == "all" else (*inputs, "speaking")

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
            problems = "; ".join(
                f"{NEEDS.get(need, need)} ({context.reasons.get(need, 'not available here')})" for need in lacking
            )
            raise FaceDiffError(f"metric {self.text}: needs {problems}")
        implementation = metrics.get(self.name)
        accepted = inspect.signature(implementation).parameters
        arguments = {key: value for need in self.needs for key, value in context.has[need].items() if key in accepted}
        options = dict(self.options)
        region = options.get("region", "all" if self.of_channels else None)
        if isinstance(region, str):  # a region that is given as an option by the name of its need
            regions = {need: value for need in ("lips", "upper_face") for value in context.has.get(need, {}).values()}
            regions = dict(context.channels) if self.of_channels else regions
            check_known(f"metric {self.text}", "region", [region], regions)
            options["region"] = regions[region]
        with damaged(f"metric {self.text}", "change its options"):
            return cast(Metric, implementation(**arguments | options))


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
    # An unknown name is an AttributeError too, which a torch module that parses in a property would report as its own.
    with damaged(f"metric {text.strip()}", "choose another"):
        name, options = metrics.read(plain)
        if hidden := sorted(options.keys() & _HIDDEN):
            raise ValueError(f"{name} takes its {hidden[0]} from the corpus")
    if moment != "all":
        parameters = inspect.signature(metrics.get(name).update).parameters.keys()
        ordered = getattr(metrics.get(name), "in_order", False)
        if not {"prediction", "truth"} <= parameters or OF_ALL_FRAMES & parameters or ordered:
            raise FaceDiffError(
                f"metric {text}: {name} scores no frames of prediction and truth by themselves; omit the prefix"
            )
    return Request(text.replace(" ", ""), name, options, moment)


def feed(metric: Metric, inputs: Mapping[str, Any], moment: Moment = "all") -> None:
    """Update a metric with the inputs that its :meth:`update` takes."""
    parameters = inspect.signature(type(metric).update).parameters
    count = None
    if moment != "all":
        count = len(inputs["speaking"])
        inputs = split_frames(dict(inputs), inputs["speaking"], moment)
    frames = inputs.get("kept", [0])
    if frames:
        metric.update(**{name: value for name, value in inputs.items() if name in parameters})
    if count is not None and isinstance(metric, SequenceMetric) and (not frames or metric.latest is not None):
        values = torch.full((count,), torch.nan, dtype=torch.float64)
        if frames and metric.latest is not None:
            values[frames] = metric.latest.cpu()
        metric.latest = values


def parse_all(texts: Sequence[str]) -> list[Request]:
    """Read several metrics, each once, as :func:`parse` does."""
    return list({request.text: request for request in map(parse, texts)}.values())
