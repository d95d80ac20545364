"""How many vertices the usual regions of the usual meshes have, to tell a usual region from another.

Counts are facts about files that circulate; the files themselves belong to their data sets and are not
shipped. Indices are counted once each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from facediff.metrics.options import check_option
from facediff.metrics.regions import Region

Part = Literal["lips", "upper"]


@dataclass(frozen=True)
class Topology:
    """A mesh and the regions in use on it.

    Args:
        name: What the data set is called.
        n_vertices: Vertices of the mesh.
        lips: What a lip region with that many vertices is.
        upper: Likewise for the upper face.
    """

    name: str
    n_vertices: int
    lips: dict[int, str]
    upper: dict[int, str]

    def bind(self, region: Region) -> Region:
        """The region as one of this mesh, so that motion of another mesh is refused.

        Raises:
            ValueError: If the region is known to belong to another mesh, or reaches beyond this one.
        """
        region.check(self.n_vertices)
        return replace(region, n_vertices=self.n_vertices)

    def remark(self, part: Part, region: Region) -> str:
        """What is known of a region by its vertex count: whose it is, or that it is not a usual one.

        >>> TOPOLOGIES["biwi"].remark("lips", Region.from_indices("mine", [1, 2]))
        'lips of 2 vertices are not usual on biwi (4996: lve.txt of BIWI)'
        """
        usual = self.lips if part == "lips" else self.upper
        verb = "are" if part == "lips" else "is"
        if region.count in usual:
            return f"{part} of {region.count} vertices {verb} usual on {self.name}: {usual[region.count]}"
        known = "; ".join(f"{count}: {words}" for count, words in usual.items())
        return f"{part} of {region.count} vertices {verb} not usual on {self.name} ({known})"


_FLAME_LIPS = {
    250: "lips of FLAME's masks, as DiffSpeaker",
    428: "lve.txt of FaceDiffuser and ProbTalk3D",
    648: "lip.txt of TalkingStyle",
}
_FLAME_UPPER = {
    827: "forehead and eye region of FLAME's masks, as DiffSpeaker",
    1501: "fdd.txt of FaceDiffuser and ProbTalk3D",
}

TOPOLOGIES: dict[str, Topology] = {
    topology.name: topology
    for topology in (
        Topology("biwi", 23370, {4996: "lve.txt of BIWI"}, {7784: "fdd.txt of BIWI"}),
        Topology("vocaset", 5023, _FLAME_LIPS, _FLAME_UPPER),
        Topology("mead3d", 5023, _FLAME_LIPS, _FLAME_UPPER),
        Topology(
            "multiface",
            6172,
            {1438: "mouth weights above 0.1, as FaceDiffuser's script", 1035: "lve.txt of FaceDiffuser"},
            {656: "forehead weights above 0.4, as FaceDiffuser's script", 1529: "fdd.txt of FaceDiffuser"},
        ),
    )
}
"""Every known mesh by the name of its data set."""


def find_topology(name: str) -> Topology:
    """The topology of that name.

    Raises:
        ValueError: If there is none; the message lists them and the nearest.
    """
    check_option("topology", name, tuple(TOPOLOGIES))
    return TOPOLOGIES[name]
