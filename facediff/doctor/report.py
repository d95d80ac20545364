"""The doctor's report."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from facediff.doctor.findings import Finding, by_severity

FORMAT = 1
"""Goes up when a field of the JSON object changes its meaning; new fields do not count."""


@dataclass
class Report:
    """What a folder is and what is wrong in it.

    Attributes:
        root: the folder.
        quick: whether headers only were read.
        corpus: name of the corpus; None if it was not recognised.
        data_module: import path of the data module that reads it; None for a person's folder, or if unknown.
        raw: name of the raw distribution that the folder holds instead of a corpus; None if it does not.
        frame_rate: motion frames a second that models see; None if unknown, as the next two.
        stored_frame_rate: motion frames a second on disk.
        n_vertices: vertices of the topology.
        findings: errors first, then warnings, then notes.
        splits: one row a split: way, split, expected, present, missing, frames, seconds, missing_clips.
        subjects: one row a subject: subject, trained_on, clips, frames, seconds, template.
        templates: file, subjects, broken (subjects whose template cannot be used), blob (git blob id), origin (whose
            file it is), areas.
        mesh: the mesh file that is used; None if there is none.
        regions: by name: source, count, hash, duplicates, circulating_count; None for one that cannot be used.
        manifest: there, ended (whether preparing has ended), facediff (version that wrote it), changed, missing.
    """

    root: Path
    quick: bool = False
    corpus: str | None = None
    data_module: str | None = None
    raw: str | None = None
    frame_rate: float | None = None
    stored_frame_rate: float | None = None
    n_vertices: int | None = None
    findings: list[Finding] = field(default_factory=list)
    splits: list[dict[str, Any]] = field(default_factory=list)
    subjects: list[dict[str, Any]] = field(default_factory=list)
    templates: dict[str, Any] = field(default_factory=dict)
    mesh: str | None = None
    regions: dict[str, dict[str, Any] | None] = field(default_factory=dict)
    manifest: dict[str, Any] = field(default_factory=dict)

    @property
    def sound(self) -> bool:
        """Whether there is no error; warnings are allowed."""
        return not any(finding.severity == "error" for finding in self.findings)

    def state(self) -> dict[str, Any]:
        """The report as plain data, ready for JSON; the fields are those above with ``format`` and ``sound``."""
        plain = asdict(self) | {"root": str(self.root), "findings": [asdict(f) for f in by_severity(self.findings)]}
        return {"format": FORMAT, "sound": self.sound, **plain}
