"""Checking the files that all clips share: those of the manifest, templates, mesh and regions."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.data.check.clip import Array
from facediff.data.check.findings import Findings, few, relative
from facediff.data.check.layouts import MANIFEST, CorpusView
from facediff.errors import counted
from facediff.mesh.mesh import surface_area
from facediff.utils.checksums import sha256
from facediff.utils.paths import compose

if TYPE_CHECKING:
    from facediff.data.corpus import Corpus

AREA_TOLERANCE = 1e-3  # float32 templates are within 1e-6


def check_files(
    root: Path, files: Mapping[str, Any], hashes: Mapping[str, str], findings: Findings, *, quick: bool
) -> dict[str, list[str]]:
    """Compare the files with their sizes (``quick``), or their SHA-256, in ``manifest.json``.

    ``hashes`` holds the SHA-256 of files that were read already. Returns the names of the files that are not as
    recorded: ``changed`` and ``missing``.
    """
    differing: dict[str, list[str]] = {"changed": [], "missing": []}
    for name, recorded in files.items():
        path = root / name
        with findings.guard("file_unreadable", path, root):
            # An untrusted manifest must not have other files opened.
            if not isinstance(recorded, dict) or not path.resolve().is_relative_to(root.resolve()):
                message = f'"{name}" is no entry of a file below the folder; prepare the folder again'
                findings.error("manifest_entry", MANIFEST, message)
            elif not path.is_file():
                differing["missing"].append(name)
                message = "is in manifest.json but not there; prepare the folder again"
                findings.error("file_missing", name, message)
            elif path.stat().st_size != recorded.get("bytes") or not (
                quick or (hashes.get(name) or sha256(path)) == recorded.get("sha256")
            ):
                differing["changed"].append(name)
                message = "is not what was written (manifest.json): changed since, or damaged; prepare the folder again"
                findings.error("file_changed", name, message)
    return differing


# Templates, the neutral faces.


def check_templates(root: Path, view: CorpusView, findings: Findings) -> tuple[dict[str, Array], dict[str, Any]]:
    """Check ``templates.pkl``; returns its usable templates (V, 3) by subject, and the report's section."""
    from facediff.data.corpus import as_template, load_template_dict

    path = root / "templates.pkl"
    section: dict[str, Any] = {"file": None, "subjects": [], "broken": [], "blob": None, "origin": None, "areas": None}
    templates: dict[str, Array] = {}
    with findings.guard("templates_unreadable", path, root):
        loaded = load_template_dict(path)
        section["file"] = path.name
        for subject, value in loaded.items():
            with findings.guard("template_broken", path, root):
                templates[compose(str(subject))] = as_template(path, subject, value, view.n_vertices)
        section["broken"] = sorted({compose(str(subject)) for subject in loaded} - templates.keys())
        section["subjects"] = sorted(templates)
        content = path.read_bytes()
        # Git's name for the file's content, by which a file in a repository can be found.
        section["blob"] = hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()
        section["origin"] = _origin(view, section["blob"], findings)
    return templates, section


def _origin(view: CorpusView, blob: str, findings: Findings) -> str | None:
    """The project that the templates come from; None for corpora without circulating copies."""
    circulating = {} if view.circulating is None else view.circulating.templates
    if not circulating:
        return None
    origin = next((project for start, project in circulating.items() if blob.startswith(start)), "own")
    if len(circulating) > 1:
        projects = ", ".join(f"{project} ({start})" for start, project in circulating.items() if project != origin)
        owner = "none of the files that circulate" if origin == "own" else f"the templates of {origin}"
        message = (
            f"{owner} (git blob {blob[:8]}); a checkpoint needs the templates that it was trained with, and there are "
            f"others: {projects}"
        )
        findings.note("templates_origin", "templates.pkl", message)
    return origin


def check_areas(
    view: CorpusView, unit: object, templates: dict[str, Array], faces: npt.NDArray[np.int32], findings: Findings
) -> dict[str, float] | None:
    """Surface area of every template, which defines the unit of some corpora and must be one there; None in others.

    ``unit`` is that in ``manifest.json``, if it has one.
    """
    if view.circulating is None or not view.circulating.unit_area or not templates:
        return None
    areas = {subject: surface_area(template, faces) for subject, template in sorted(templates.items())}
    unequal = [f"{subject} {area:.4g}" for subject, area in areas.items() if abs(area - 1) > AREA_TOLERANCE]
    if unequal and (not isinstance(unit, str) or unit.startswith("normalised")):
        message = (
            f"the surface area is not 1 ({few(unequal)}): not "
            f"CodeTalker's normalisation, so scores are not comparable with published ones; prepare the folder again "
            f"from the raw files unless this is intended"
        )
        findings.warning("template_area", "templates.pkl", message)
    return areas


# Mesh and regions.


def check_mesh(opened: Corpus, view: CorpusView, findings: Findings) -> tuple[npt.NDArray[np.int32] | None, str | None]:
    """Check the mesh file; returns its faces (F, 3) if they can be used, and its path relative to the folder."""
    root = opened.root
    paths = [folder / file for file in view.mesh_files for folder in (root, root / "templates")]
    path = next(filter(Path.is_file, paths), None)
    if path is None:
        if paths:
            names = " or ".join(relative(path, root) for path in paths)
            message = f"no mesh file (looked for {names}): without faces no picture can be drawn; put one there"
            findings.warning("mesh_missing", view.mesh_files[0], message)
        return None, None
    faces: npt.NDArray[np.int32] | None = None
    with findings.guard("mesh_broken", path, root):
        mesh = opened.read_mesh(view.mesh_files)
        faces = None if mesh is None else mesh.faces
    return faces, relative(path, root)


def check_regions(root: Path, view: CorpusView, findings: Findings) -> dict[str, dict[str, Any] | None]:
    """Check which vertices the regions are, region by region; None for one that cannot be used."""
    from facediff.data.corpus import find_region
    from facediff.metrics.regions import TOPOLOGIES

    sections: dict[str, dict[str, Any] | None] = dict.fromkeys(view.region_sources)
    topology = TOPOLOGIES.get(view.corpus)
    for name, sources in view.region_sources.items():
        # The first source with a file is used, as in training.
        source = next((source for source in sources if (root / source.partition(":")[0]).is_file()), None)
        path = root / (source or sources[0]).partition(":")[0]
        with findings.guard("region_missing" if source is None else "region_broken", path, root):
            region = find_region(root, sources, name, view.n_vertices, view.region_help)
            if region.duplicates:
                message = f"{counted(region.duplicates, 'index', 'indices')} of {name} repeated; counted once"
                findings.note("region_repeats", str(source), message)
            counts = {} if topology is None else topology.lips if name == "lips" else topology.upper
            published = region.count if region.count in counts else next(iter(counts), None)
            if topology is not None and published != region.count:
                remark = topology.remark("lips" if name == "lips" else "upper", region)
                findings.note("region_unusual", str(source), f"{remark}: scores over it differ from published ones")
            facts = {"source": source, "count": region.count, "hash": region.hash, "duplicates": region.duplicates}
            sections[name] = facts | {"circulating_count": published}
    return sections
