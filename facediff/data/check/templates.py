"""Looking at ``templates.pkl``, the neutral faces."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.data.check import findings as facts
from facediff.data.check.clip import Array
from facediff.data.check.findings import Finding, counted, few, guarded, number, relative
from facediff.data.check.layouts import View
from facediff.errors import FaceDiffError
from facediff.mesh.mesh import surface_area
from facediff.utils.pickles import load_pickle

if TYPE_CHECKING:
    from facediff.data.corpus import Corpus


# Looking at what depends on the topology: the mesh file and the regions.


def check_mesh(root: Path, view: View, findings: list[Finding]) -> tuple[npt.NDArray[np.int32] | None, str | None]:
    """Check the mesh file.

    Returns:
        its faces (F, 3), None if they cannot be used; and its path relative to the folder, None if there is none.
    """
    from facediff.mesh import read_mesh

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
    from facediff.data.corpus import find_region

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


AREA_TOLERANCE = 1e-3
"""How far a surface area may be from one; float32 templates are within 1e-6."""


def check_templates(root: Path, view: View, findings: list[Finding]) -> tuple[dict[str, Array], dict[str, Any]]:
    """Check ``templates.pkl``.

    Args:
        root: the corpus folder.
        view: the corpus.
        findings: what is wrong is added here.

    Returns:
        the usable templates (V, 3) by subject, float32, and the report's section.
    """
    from facediff.data.corpus import as_template

    path = root / "templates.pkl"
    section: dict[str, Any] = {"file": None, "subjects": [], "broken": [], "blob": None}
    section |= {"origin": None, "areas": None}
    templates: dict[str, Array] = {}
    with guarded(findings, "templates_unreadable", path, root):
        loaded = load_pickle(path)
        if not isinstance(loaded, dict):
            raise FaceDiffError(f"expected a dict from subject to (V, 3) array, got {type(loaded).__name__}")
        section["file"] = "templates.pkl"
        for subject, value in loaded.items():
            try:
                templates[str(subject)] = as_template(value, view.n_vertices)
            except ValueError as error:
                where = f"templates.pkl:{subject}"
                section["broken"].append(str(subject))
                findings.append(Finding("error", "template_broken", where, f"{error}; get templates.pkl again"))
        section["subjects"] = sorted(templates)
        section["blob"] = blob_id(path)
        section["origin"] = _origin(view, str(section["blob"]), findings)
    return templates, section


def blob_id(path: Path) -> str:
    """Git's name for the file's content, by which a file in a repository is found again."""
    content = path.read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def _origin(view: View, blob: str, findings: list[Finding]) -> str | None:
    """Whose templates these are; None for corpora of which nothing circulates."""
    circulating = facts.TEMPLATES.get(view.corpus)
    if circulating is None:
        return None
    origin = next((who for start, who in circulating.items() if blob.startswith(start)), "own")
    others = ", ".join(f"{who} ({start})" for start, who in circulating.items() if who != origin)
    if len(circulating) > 1:
        whose = "by its bytes none of the files that circulate" if origin == "own" else f"the templates of {origin}"
        findings.append(
            Finding(
                "note",
                "templates_origin",
                "templates.pkl",
                f"{whose} (git blob {blob[:8]}); a checkpoint goes with the templates that it was trained with, and "
                f"there are others: {others}",
            )
        )
    return origin


def check_areas(
    view: View, unit: object, templates: dict[str, Array], faces: npt.NDArray[np.int32], findings: list[Finding]
) -> dict[str, float] | None:
    """Surface area of every template; for a corpus whose unit is made by it, it must be one.

    Args:
        view: the corpus.
        unit: unit of length that ``manifest.json`` says, if it does.
        templates: neutral faces (V, 3) by subject.
        faces: triangles (F, 3).
        findings: what is wrong is added here.

    Returns:
        the areas; None for a corpus for which they mean nothing.
    """
    if view.corpus not in facts.UNIT_AREA or not templates:
        return None
    areas = {subject: surface_area(template, faces) for subject, template in sorted(templates.items())}
    other = {subject: area for subject, area in areas.items() if abs(area - 1) > AREA_TOLERANCE}
    if other and (not isinstance(unit, str) or unit.startswith("normalised")):
        told = few(f"{subject} {area:.4g}" for subject, area in other.items())
        findings.append(
            Finding(
                "warning",
                "template_area",
                "templates.pkl",
                f"the surface area is not 1 ({told}): not CodeTalker's normalisation, so scores cannot be held against "
                f"published ones; prepare the folder anew from the raw files if that is not wanted",
            )
        )
    return areas
