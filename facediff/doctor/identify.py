"""What a folder is: a corpus, a person's folder, a raw distribution, or nothing that is known."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from facediff.doctor.corpora import by_name, known, named, recognise
from facediff.doctor.findings import Finding, few, guarded, number
from facediff.doctor.folder import Folder
from facediff.doctor.manifest import MANIFEST
from facediff.doctor.raw import LOOKED_FOR, prepare_command, raw_distribution
from facediff.doctor.report import Report
from facediff.doctor.view import View, view_of, view_of_person


def identify(
    report: Report, folder: Folder, said: object, corpus: str | None, split: str | None, manifest: dict[str, Any]
) -> View | None:
    """The corpus that a folder holds; None, with a finding, if it holds none or cannot be told."""
    root, n_vertices = folder.root, folder.n_vertices()
    module = None if corpus is None else by_name(corpus, n_vertices)
    if not folder.motions and (raw := raw_distribution(root)) is not None:
        report.raw = raw[0]
        message = f"this is the raw distribution of {raw[0]} and no corpus yet: run `{prepare_command(raw[0], root)}`"
        report.findings.append(Finding("error", "raw", raw[1], message))
        return None
    if module is None and isinstance(manifest.get("person"), str):
        view: View | None = None
        with guarded(report.findings, "manifest_unreadable", root / MANIFEST, root):
            view = view_of_person(manifest, n_vertices)
        return view
    module = module or recognise(folder, said, n_vertices)
    if module is None:
        report.findings.append(_unrecognised(folder, said, n_vertices))
        return None
    return view_of(module, root, split)


def _unrecognised(folder: Folder, said: object, n_vertices: int | None) -> Finding:
    have = [
        f"no {MANIFEST} names a corpus" if said is None else f"{MANIFEST} names {said!r}, which no data module reads"
    ]
    if folder.names:
        vertices = "unreadable motion" if n_vertices is None else f"{number(n_vertices)} vertices"
        have.append(f"there are clips {few(folder.names)} with {vertices}, which fit none of {few(_corpora())}")
    else:
        patterns = ", ".join(pattern for patterns in LOOKED_FOR.values() for pattern in patterns)
        have.append(f"there is no wav/*.wav or vertices_npy/*.npy, and nothing of a raw distribution ({patterns})")
    message = f"not recognised: {'; '.join(have)}. Give the right folder, or say what it is with --corpus"
    return Finding("error", "unrecognised", str(folder.root), message)


def _corpora() -> Iterable[str]:
    return dict.fromkeys(str(named(module)) for module in known())
