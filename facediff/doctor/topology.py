"""Looking at what depends on the topology: the mesh file and the regions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.doctor import facts
from facediff.doctor.findings import Finding, counted, guarded, number, relative
from facediff.doctor.view import View
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.data.corpus import Corpus


def check_mesh(root: Path, view: View, findings: list[Finding]) -> tuple[npt.NDArray[np.int32] | None, str | None]:
    """Check the mesh file.

    Returns:
        its faces (F, 3), None if they cannot be used; and its path relative to the folder, None if there is none.
    """
    from facediff.topology import read_mesh

    places = [folder / file for file in view.mesh_files for folder in (root, root / "templates")]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        if view.mesh_files:
            looked = " or ".join(relative(place, root) for place in places)
            message = f"no mesh file (looked for {looked}): without faces no picture can be drawn; put one there"
            findings.append(Finding("warning", "mesh_missing", view.mesh_files[0], message))
        return None, None
    faces: npt.NDArray[np.int32] | None = None
    with guarded(findings, "mesh_broken", path, root):
        mesh = read_mesh(path)
        if len(mesh.vertices) != view.n_vertices:
            raise FaceDiffError(
                f"has {number(len(mesh.vertices))} vertices, expected {number(view.n_vertices)}; put the corpus's own "
                f"mesh there"
            )
        if mesh.faces.min() < 0 or mesh.faces.max() >= view.n_vertices:
            raise FaceDiffError(f"has faces of vertices beyond {view.n_vertices - 1}; get it anew")
        faces = mesh.faces
    return faces, relative(path, root)


def check_regions(root: Path, view: View, findings: list[Finding]) -> dict[str, dict[str, Any] | None]:
    """Check which vertices the regions are, region by region; None for one that cannot be used."""
    return {name: _check_region(root, view, name, sources, findings) for name, sources in view.region_sources.items()}


def _check_region(
    root: Path, view: View, name: str, sources: Sequence[str], findings: list[Finding]
) -> dict[str, Any] | None:
    from facediff.data.regions import find_region

    source = _used(root, sources)
    path = root / (sources[0] if source is None else source).partition(":")[0]
    section: dict[str, Any] | None = None
    with guarded(findings, "region_missing" if source is None else "region_broken", path, root):
        region = find_region(root, sources, name, view.n_vertices, view.region_help)
        if region.duplicates:
            message = f"{counted(region.duplicates, 'index', 'indices')} of {name} repeated; counted once"
            findings.append(Finding("note", "region_repeats", str(source), message))
        usual = facts.REGIONS.get(view.corpus, {}).get(str(source))
        if usual is not None and usual != region.count:
            findings.append(
                Finding(
                    "note",
                    "region_unusual",
                    str(source),
                    f"{name} has {counted(region.count, 'vertex', 'vertices')}, the list that "
                    f"circulates under this name has {number(usual)}: scores over it are others than published ones",
                )
            )
        section = {
            "source": source,
            "count": region.count,
            "hash": region.hash,
            "duplicates": region.duplicates,
            "circulating_count": usual,
        }
    return section


def _used(root: Path, sources: Iterable[str]) -> str | None:
    """The source that is used: the first whose file is there."""
    return next((source for source in sources if (root / source.partition(":")[0]).is_file()), None)


def check_pairs(opened: Corpus, findings: list[Finding]) -> None:
    """Check the pairs of vertices on the inner lips, where a corpus has them."""
    path = opened.root / "regions" / "inner_lip_pairs.txt"
    with guarded(findings, "region_broken", path, opened.root):
        opened.read_pairs(path.name)
