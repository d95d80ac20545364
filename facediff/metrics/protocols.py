"""Protocols: named settings of the metrics' options, since the same three letters mean different numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Unpack, cast

from torch import Tensor
from torchmetrics import Metric, MetricCollection

from facediff.metrics.base import (
    LENGTH_WORDS,
    POOLING_WORDS,
    Coverage,
    LengthRule,
    Pooling,
    Reduction,
    SequenceMetric,
    SequenceOptions,
    Sign,
    UpdateOptions,
    align,
    check_option,
)
from facediff.metrics.by_name import Request, parse
from facediff.metrics.regions import TOPOLOGIES, Region, RegionLike, as_region
from facediff.metrics.vertex_errors import (
    FaceDynamicsDeviation,
    LipVertexError,
    MeanVertexError,
    dynamics_words,
    vertex_error_words,
)


@dataclass(frozen=True)
class Protocol:
    """A named setting of the metrics' options.

    Args:
        name: printed next to the numbers.
        source: where the setting comes from.
        mve: reduction over vertices of the mean vertex error; None omits the metric.
        mve_squared: whether its distances are squared.
        lve: whether the lip vertex error is taken.
        lve_squared: whether the lip vertex error's distances are squared.
        lve_root: whether it is the root of each sequence's mean.
        fdd: signs of the face dynamics deviation to report; the first is called ``fdd``, a second
            ``fdd_<sign>``; empty omits the metric.
        pooling: of MVE and LVE; FDD is always a mean over sequences.
        length_rule: what to do where prediction and truth differ in length.
        channels: whether these are taken of channels, the formulas of vertices with channels for vertices; else of
            vertices, which motion in parameters is decoded to, with the head at rest.
        unit: unit of lengths in which vertices are scored; the motion's own if None.
        metrics: further scores, each its name and the metric by name with options.
        topology: name of the mesh, one of :data:`TOPOLOGIES`. Then regions and motion of another mesh are refused,
            and the summary says whether the regions are those in use on it. None for any mesh.
    """

    name: str
    source: str
    mve: Reduction | None = None
    mve_squared: bool = False
    lve: bool = True
    lve_squared: bool = True
    lve_root: bool = False
    fdd: tuple[Sign, ...] = ()
    pooling: Pooling = "frames"
    length_rule: LengthRule = "min"
    channels: bool = False
    unit: str | None = None
    metrics: tuple[tuple[str, str], ...] = ()
    topology: str | None = None

    def __post_init__(self) -> None:
        """Check the topology, by which regions and motion of another mesh are refused."""
        if self.topology is not None:
            check_option("topology", self.topology, TOPOLOGIES)

    @property
    def of_parameters(self) -> bool:
        """Whether the protocol is one of motion in parameters, and not only of vertices."""
        return self.channels or self.unit is not None or bool(self.metrics)

    @property
    def needs_vertices(self) -> bool:
        """Whether a score is taken of vertices, so that motion in parameters needs a rig."""
        return not self.channels or any(not request.of_channels for request in self.further().values())

    def further(self, scale: float = 1.0) -> dict[str, Request]:
        """The further scores by name, as requests."""
        return {name: parse(text).scaled(scale) for name, text in self.metrics}

    def describe(self) -> str:
        """The definition in plain words, one line per number."""
        pooling = POOLING_WORDS[self.pooling]
        lines = [f"protocol {self.name}: {self.source}"]
        if self.mve is not None:
            definition = vertex_error_words(reduction=self.mve, squared=self.mve_squared)
            lines.append(f"  mve: {definition.format(region='all vertices', pooling=pooling)}")
        if self.lve:
            definition = vertex_error_words(reduction="max", squared=self.lve_squared, root=self.lve_root)
            lines.append(f"  lve: {definition.format(region='the lip vertices', pooling=pooling)}")
        for name, sign in self.deviations().items():
            lines.append(f"  {name}: {dynamics_words(sign=sign).format(region='the upper-face vertices')}")
        lines += [f"  {name}: {text}" for name, text in self.metrics]
        if self.channels:
            lines.append("  of channels, one number each, in place of vertices")
        if self.unit is not None:
            lines.append(f"  lengths are in {self.unit}")
            lines.append("  vertices of motion in parameters are those of the head at rest")
        lines.append(f"  lengths: {LENGTH_WORDS[self.length_rule]}")
        return "\n".join(lines)

    def deviations(self) -> dict[str, Sign]:
        """Sign of each face dynamics deviation by its name."""
        return {f"fdd_{sign}" if number else "fdd": sign for number, sign in enumerate(self.fdd)}

    def build(self, lips: RegionLike, upper: RegionLike | None = None, *, scale: float = 1.0) -> ProtocolMetrics:
        """The metrics of this protocol for a topology, without the further ones, which :meth:`further` gives.

        Args:
            lips: lip vertices, a :class:`Region` or indices; channels where the protocol is of channels.
            upper: the same of the upper face; needed if the protocol has FDD.
            scale: factor of all lengths, by which the motion's unit becomes the protocol's.
        """
        lips, upper = as_region(lips, "lips"), None if upper is None else as_region(upper, "upper")
        if self.topology is not None:
            topology = TOPOLOGIES[self.topology]
            lips, upper = topology.bind(lips), None if upper is None else topology.bind(upper)
        return ProtocolMetrics(self, lips, upper, scale=1.0 if self.channels else scale)


_PAPER = (
    "the dual-path style diffusion paper, its text and its tables read together: the printed MVE is too far below the "
    "root of the printed LVE to be a mean of per-frame maxima, so it is the mean over vertices"
)
_PAPER_TEXT = "the dual-path style diffusion paper, the formulas of its text to the letter"
_MHD = "mean_vertex_error:squared=true,root=true,pooling=sequences"
_SETTINGS = (
    Protocol("paper", _PAPER, mve="mean", fdd=("absolute",)),
    Protocol("paper_text", _PAPER_TEXT, mve="max", lve_squared=False, fdd=("absolute",)),
    Protocol("codetalker", "CodeTalker's released script", fdd=("signed",), length_rule="prediction"),
    Protocol("facediffuser", "FaceDiffuser's released script", mve="mean", fdd=("signed", "absolute")),
    Protocol("diffspeaker", "DiffSpeaker's released code", fdd=("signed",), pooling="sequences"),
    Protocol("meshtalk", "MeshTalk's paper", lve_squared=False),
    Protocol("unitalker", "UniTalker's code; its L2norm is mve here", mve="mean"),
    Protocol(
        "artalk",
        "ARTalk's code; the root and the mean over sequences are how we read it",
        lve_root=True,
        fdd=("absolute",),
        pooling="sequences",
        unit="mm",
        metrics=(("mhd", _MHD),),
    ),
    Protocol(
        "unils",
        "UniLS's inferencer, frames of speaking (s_) and of listening (l_) apart",
        lve_root=True,
        pooling="sequences",
        unit="mm",
        metrics=tuple(
            (f"{moment}_{name}", f"{moment}_{metric}")
            for moment in ("s", "l")
            for name, metric in (
                ("lve", "lip_vertex_error:root=true,pooling=sequences"),
                ("mhd", _MHD),
                ("fdd", "face_dynamics_deviation"),
                ("pdd", "channel_dynamics_deviation:region=head"),
                ("jdd", "channel_dynamics_deviation:region=jaw"),
            )
        ),
    ),
    Protocol(
        "dualtalk",
        "DualTalk's tables of expression, jaw and head; mve is the mean squared error of all channels",
        mve="mean",
        mve_squared=True,
        lve=False,
        channels=True,
        metrics=tuple(
            (f"{score}_{part}", f"{metric}:region={part}" + more)
            for score, metric, option in (
                ("fd", "frechet_distance", ""),
                ("p_fd", "frechet_distance", ",with_partner=true"),
                ("sid", "shannon_index", ",clusters="),
                ("rpcc", "residual_partner_correlation", ""),
                ("sts", "step_distance", ""),
                ("var", "channel_variance", ""),
                ("div", "frame_pair_distance", ""),
            )
            for part, clusters in (("expression", 40), ("jaw", 10), ("head", 10))
            for more in (f"{option}{clusters}" if score == "sid" else option,)
        ),
    ),
    Protocol(
        "facediffuser_beat",
        "FaceDiffuser's script on BEAT's weights",
        mve="mean",
        fdd=("signed", "absolute"),
        channels=True,
    ),
)

PROTOCOLS: dict[str, Protocol] = {setting.name: setting for setting in _SETTINGS}
"""Every named protocol."""


def protocol(name: str = "paper", *, topology: str | None = None) -> Protocol:
    """The protocol of that name.

    Args:
        name: one of :data:`PROTOCOLS`.
        topology: one of :data:`TOPOLOGIES`: the mesh that is scored, to have regions and motion of another mesh
            refused and unusual regions pointed out. Regions are given to :meth:`Protocol.build` all the same: their
            files belong to the data sets.

    >>> print(protocol("meshtalk").describe())  # doctest: +NORMALIZE_WHITESPACE
    protocol meshtalk: MeshTalk's paper
      lve: in each frame the largest distance over the lip vertices;
      mean over the frames of all sequences [unit]
      lengths: prediction and truth are both cut to the shorter of the two
    >>> metrics = protocol("meshtalk", topology="biwi").build(Region.from_indices("mine", [7, 9]))
    >>> print(metrics.summary())  # doctest: +NORMALIZE_WHITESPACE
    protocol meshtalk: lips mine (2 vertices, 8944bbc1); frames 0, sequences 0;
    lips of 2 vertices are not usual on biwi (4996: lve.txt of BIWI)
    """
    check_option("protocol", name, PROTOCOLS)
    setting = PROTOCOLS[name]
    return setting if topology is None else replace(setting, topology=topology)


@dataclass(frozen=True)
class Summary:
    """The line next to the scores; ``upper`` is None if the protocol does not use the upper face."""

    protocol: str
    lips: Region
    upper: Region | None
    coverage: Coverage
    topology: str | None = None

    @property
    def remarks(self) -> list[str]:
        """Whether each region is one in use on the topology; empty where none is given."""
        if self.topology is None:
            return []
        mesh, upper = TOPOLOGIES[self.topology], self.upper
        return [mesh.remark("lips", self.lips), *([] if upper is None else [mesh.remark("upper", upper)])]

    def __str__(self) -> str:
        """One line for people."""
        regions = f"lips {self.lips}" + (f", upper {self.upper}" if self.upper else "")
        covered = self.coverage
        text = f"protocol {self.protocol}: {regions}; frames {covered.frames}, sequences {covered.sequences}"
        if covered.cut_prediction or covered.cut_truth:
            text += f"; frames cut: prediction {covered.cut_prediction}, truth {covered.cut_truth}"
        return "; ".join([text, *self.remarks])

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON: protocol, regions (name, count, hash, duplicates), coverage, topology."""
        parts = {"lips": self.lips, "upper": self.upper}
        regions = {part: region.as_dict() for part, region in parts.items() if region is not None}
        covered = asdict(self.coverage)
        del covered["left_out"]  # the metrics of protocols have a value on every sequence
        mesh = {} if self.topology is None else {"topology": self.topology, "remarks": self.remarks}
        return {"protocol": self.protocol, "regions": regions} | covered | mesh


class ProtocolMetrics(MetricCollection):
    """The metrics of one protocol, updated together, as a :class:`torchmetrics.MetricCollection`.

    :meth:`compute` gives a flat dictionary: ``mve``, ``lve``, ``fdd`` as far as the protocol has them; a second sign of
    FDD is called ``fdd_absolute`` or ``fdd_signed``. Under several processes :meth:`compute` and :meth:`summary` are
    collective: call them on every rank, also on one that had no sequence.

    Args:
        protocol: the setting; usually made by :meth:`Protocol.build`.
        lips: lip vertices.
        upper: upper-face vertices; may be None if the protocol has no FDD.
        scale: factor of all lengths.
    """

    def __init__(self, protocol: Protocol, lips: Region, upper: Region | None = None, *, scale: float = 1.0) -> None:
        if protocol.fdd and upper is None:
            raise ValueError(f"protocol {protocol.name!r} includes FDD; give the upper-face region")
        # Metrics with equal states must not be merged, and the inputs are checked here once for all of them.
        super().__init__({}, compute_groups=False)
        self.protocol = protocol
        self.lips = lips
        self.upper = upper if protocol.fdd else None
        pooling = protocol.pooling
        options: SequenceOptions = {"length_rule": protocol.length_rule, "check_finite": False}
        scores: dict[str, Metric] = {}
        if protocol.mve is not None:
            scores["mve"] = MeanVertexError(
                reduction=protocol.mve, squared=protocol.mve_squared, pooling=pooling, scale=scale, **options
            )
        if protocol.lve:
            scores["lve"] = LipVertexError(
                lips, squared=protocol.lve_squared, root=protocol.lve_root, pooling=pooling, scale=scale, **options
            )
        for name, sign in protocol.deviations().items():
            scores[name] = FaceDynamicsDeviation(cast(Region, upper), sign=sign, scale=scale, **options)
        for name, score in scores.items():  # one by one: a dictionary would be sorted by name
            self.add_metrics({name: score})

    def update(  # type: ignore[override]  # it is ModuleDict.update that torchmetrics has redefined
        self, prediction: Tensor, truth: Tensor, *, template: Tensor | None = None, **batch: Unpack[UpdateOptions]
    ) -> None:
        """Add a batch of sequences to every metric; see :meth:`FaceDynamicsDeviation.update`."""
        self._check(prediction, truth, template, batch)
        super().update(prediction, truth, template=template, **batch)

    def forward(
        self, prediction: Tensor, truth: Tensor, *, template: Tensor | None = None, **batch: Unpack[UpdateOptions]
    ) -> dict[str, Tensor]:
        """Add a batch like :meth:`update` and return the scores of this batch alone."""
        self._check(prediction, truth, template, batch)
        return cast(dict[str, Tensor], super().forward(prediction, truth, template=template, **batch))

    def summary(self) -> Summary:
        """Regions, frames, sequences and cut frames behind the scores, over all processes."""
        first = next(iter(self.scores().values()))
        return Summary(self.protocol.name, self.lips, self.upper, first.coverage(), self.protocol.topology)

    def scores(self) -> dict[str, SequenceMetric]:
        """The metrics by name, not copies of them."""
        return dict(cast(Sequence[tuple[str, SequenceMetric]], self.items(copy_state=False)))

    def describe(self) -> str:
        """The definition of every number, with the regions."""
        return "\n".join(f"{name}: {metric.describe()}" for name, metric in self.scores().items())

    def _check(self, prediction: Tensor, truth: Tensor, template: Tensor | None, batch: UpdateOptions) -> None:
        """Find every fault of a batch before it is added to the first metric."""
        clips = align(prediction, truth, rule=self.protocol.length_rule, **batch)
        for region in (self.lips, self.upper):
            if region is not None:
                region.check(clips.n_vertices)
        if self.upper is not None:
            clips.attach_templates(template)
        clips.check_finite()
