"""Files that would do harm if anything of them ran."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass
class Harm:
    """An object whose pickle makes a folder when it is opened.

    Attributes:
        path: the folder.
    """

    path: Path

    def __reduce__(self) -> tuple[object, tuple[str]]:
        """Call ``os.mkdir``."""
        import os

        return os.mkdir, (str(self.path),)
