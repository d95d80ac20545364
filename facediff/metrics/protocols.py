"""Protocols: named settings of the metrics' options, since the same three letters mean different numbers."""

from __future__ import annotations

from dataclasses import dataclass, replace

from facediff.metrics.options import (
    LENGTH_RULES,
    LENGTH_WORDS,
    POOLINGS,
    REDUCTIONS,
    SIGNS,
    LengthRule,
    Pooling,
    Reduction,
    Sign,
    check_option,
    dynamics_words,
    vertex_error_words,
)
from facediff.metrics.protocol_metrics import ProtocolMetrics
from facediff.metrics.regions import Region
from facediff.metrics.topologies import find_topology


@dataclass(frozen=True)
class Protocol:
    """A named setting of the metrics' options.

    Args:
        name: What to print beside the numbers.
        source: Where the setting comes from.
        mve: Reduction over vertices of the mean vertex error; None leaves the metric out.
        mve_squared: Whether its distances are squared.
        lve_squared: Whether the lip vertex error's distances are squared.
        fdd: Signs of the face dynamics deviation to report; the first is called ``fdd``, a second
            ``fdd_<sign>``; empty leaves the metric out.
        pooling: Of MVE and LVE; FDD is always a mean over sequences.
        length_rule: What to do where prediction and truth differ in length.
        topology: Name of the mesh, one of `TOPOLOGIES`. Then regions and motion of another mesh are refused,
            and the summary says whether the regions are those in use on it. None for any mesh.

    Raises:
        ValueError: If an option is unknown.
    """

    name: str
    source: str
    mve: Reduction | None = None
    mve_squared: bool = False
    lve_squared: bool = True
    fdd: tuple[Sign, ...] = ()
    pooling: Pooling = "frames"
    length_rule: LengthRule = "min"
    topology: str | None = None

    def __post_init__(self) -> None:
        """Check the options."""
        if self.mve is not None:
            check_option("reduction", self.mve, REDUCTIONS)
        for sign in self.fdd:
            check_option("sign", sign, SIGNS)
        if len(set(self.fdd)) != len(self.fdd):
            raise ValueError(f"protocol {self.name!r} names a sign of FDD twice: {self.fdd}")
        check_option("pooling", self.pooling, POOLINGS)
        check_option("length rule", self.length_rule, LENGTH_RULES)
        if self.topology is not None:
            find_topology(self.topology)

    def describe(self) -> str:
        """The definition in plain words, one line a number."""
        lines = [f"protocol {self.name}: {self.source}"]
        if self.mve is not None:
            words = vertex_error_words(
                "all vertices", reduction=self.mve, squared=self.mve_squared, pooling=self.pooling
            )
            lines.append(f"  mve: {words}")
        words = vertex_error_words("the lip vertices", reduction="max", squared=self.lve_squared, pooling=self.pooling)
        lines.append(f"  lve: {words}")
        for place, sign in enumerate(self.fdd):
            name = f"fdd_{sign}" if place else "fdd"
            lines.append(f"  {name}: {dynamics_words('the upper-face vertices', sign=sign)}")
        lines.append(f"  lengths: {LENGTH_WORDS[self.length_rule]}")
        return "\n".join(lines)

    def build(self, lips: Region, upper: Region | None = None) -> ProtocolMetrics:
        """The metrics of this protocol for a topology.

        Args:
            lips: Lip vertices.
            upper: Upper-face vertices; needed if the protocol has FDD.

        Raises:
            ValueError: If the upper face is needed and missing, or a region does not fit the topology.
        """
        if self.topology is not None:
            topology = find_topology(self.topology)
            lips, upper = topology.bind(lips), None if upper is None else topology.bind(upper)
        return ProtocolMetrics(self, lips, upper)


_SETTINGS = (
    Protocol(
        "paper",
        "the dual-path style diffusion paper, its text and its tables read together: the printed MVE is too "
        "far below the root of the printed LVE to be a mean of per-frame maxima, so it is the mean over "
        "vertices",
        mve="mean",
        fdd=("absolute",),
    ),
    Protocol(
        "paper_text",
        "the dual-path style diffusion paper, the formulas of its text to the letter",
        mve="max",
        lve_squared=False,
        fdd=("absolute",),
    ),
    Protocol("codetalker", "CodeTalker's released script", fdd=("signed",), length_rule="prediction"),
    Protocol("facediffuser", "FaceDiffuser's released script", mve="mean", fdd=("signed", "absolute")),
    Protocol("diffspeaker", "DiffSpeaker's released code", fdd=("signed",), pooling="sequences"),
    Protocol("meshtalk", "MeshTalk's paper", lve_squared=False),
)

PROTOCOLS: dict[str, Protocol] = {setting.name: setting for setting in _SETTINGS}
"""Every named protocol."""


def protocol(name: str = "paper", *, topology: str | None = None) -> Protocol:
    """The protocol of that name.

    Args:
        name: One of `PROTOCOLS`.
        topology: One of `TOPOLOGIES`: the mesh that is scored, to have regions and motion of another mesh
            refused and unusual regions pointed out. Regions are given to `Protocol.build` all the same: their
            files belong to the data sets.

    Raises:
        ValueError: If there is none; the message lists them and the nearest.

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
    check_option("protocol", name, tuple(PROTOCOLS))
    setting = PROTOCOLS[name]
    return setting if topology is None else replace(setting, topology=topology)
