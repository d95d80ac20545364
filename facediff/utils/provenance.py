"""The origin of a folder of scores or of predictions: ``provenance.json`` in the one, next to the other.

It tells whether two folders are of two methods, or of one method that was trained twice: then their difference is
chance between training runs, about which the spread over sentences says nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from facediff.utils.limits import check_format
from facediff.utils.plain_files import load_json, write_json
from facediff.utils.records import read_record

FILE = "provenance.json"
FORMAT = 1
"""Goes up when a field changes its meaning; new fields do not count."""

REMEDY = "expected what `facediff test` or `facediff predict` writes; remove the file, or run the command again"


@dataclass(frozen=True)
class Provenance:
    """One training run, and the source of its scores or predictions.

    Attributes:
        components: their names, by kind.
        recipe: SHA-256 of all options of model and data; runs that differ in the seed alone have the same one.
        seed: of the training run; None where the checkpoint does not know it, as an imported one.
        checkpoint: SHA-256; empty if the model came from none.
        manifest: SHA-256 of the manifest of the scores' corpus, or ``none``.
        parameters: weights of the network, trained and frozen.
    """

    model: str
    components: Mapping[str, str] = field(default_factory=dict)
    recipe: str = ""
    seed: int | None = None
    steps: int | None = None
    checkpoint: str = ""
    corpus: str = ""
    manifest: str = ""
    parameters: int | None = None
    versions: Mapping[str, str] = field(default_factory=dict)

    def same_method(self, run: Provenance) -> bool:
        """Whether two runs are of one method, with equal options and equally many steps: they differ by chance."""
        return bool(self.recipe) and (self.recipe, self.steps) == (run.recipe, run.steps)

    def columns(self) -> dict[str, str]:
        """The run in three cells of a table of scores."""
        parts = " ".join(f"{kind}={name}" for kind, name in self.components.items())
        seed = "" if self.seed is None else str(self.seed)
        return {"seed": seed, "checkpoint": self.checkpoint, "components": f"{self.model} {parts}".strip()}

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {"format": FORMAT, **asdict(self)}

    def write(self, folder: Path) -> None:
        """Write it into a folder, whole or not at all."""
        write_json(folder / FILE, self.as_dict())

    def write_next_to(self, folder: Path) -> None:
        """Write it next to a folder, whole or not at all."""
        write_json(next_to(folder), self.as_dict())


def next_to(folder: Path) -> Path:
    """Where the provenance of a folder of predictions lies."""
    folder = folder.resolve()
    return folder.with_name(f"{folder.name}.{FILE}")


def read_provenance(folder: Path) -> Provenance | None:
    """The origin of a folder; None if it does not say, as folders of other projects do not."""
    path = next((path for path in (folder / FILE, next_to(folder)) if path.is_file()), None)
    return None if path is None else provenance_of(load_json(path, remedy=REMEDY), path)


def provenance_of(content: object, name: object) -> Provenance:
    """Provenance from plain data, which errors call ``name``."""
    stated = content.get("format", FORMAT) if isinstance(content, dict) else None
    check_format(name, stated, FORMAT)
    return read_record(Provenance, content, name, remedy=REMEDY, strict=False)
