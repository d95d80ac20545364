"""What a file's name says: who speaks, what is said, and whose style the prediction was given."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from facediff.errors import FaceDiffError

DEFAULT_PATTERNS = ("{subject}_{sentence}_condition_{identity}", "{subject}_{sentence}")
"""How predictions are named unless told otherwise; the first is that of the field's released projects."""

TRUTH_PATTERN = "{subject}_{sentence}"
"""How truths are named unless told otherwise."""

FIELDS = ("subject", "sentence", "identity")


@dataclass(frozen=True)
class Name:
    """What a file's name says.

    Attributes:
        subject: who speaks.
        sentence: what is said.
        identity: whose style the prediction was given; None if the name does not say.
    """

    subject: str
    sentence: str
    identity: str | None = None

    @property
    def clip(self) -> str:
        """``<subject>_<sentence>``, under which prediction and truth find each other."""
        return f"{self.subject}_{self.sentence}"


class NamePattern:
    """Takes names apart by a pattern such as ``{subject}_{sentence}_condition_{identity}``.

    Subjects and sentences may hold underscores themselves. Where a name can be read in several ways, a known subject
    goes first, then a subject that is also the identity, then the split at the last underscore.

    Args:
        pattern: the name without ``.npy``, or the path below the folder if it has a ``/``. It has ``{subject}`` and
            ``{sentence}`` and may have ``{identity}``.
        subjects: known subjects.

    Raises:
        FaceDiffError: if the pattern has other fields, or lacks one.
    """

    def __init__(self, pattern: str, subjects: Collection[str] = ()) -> None:
        self.pattern = pattern
        parts = re.split(r"\{(\w*)\}", pattern.removesuffix(".npy"))
        fields = parts[1::2]
        if sorted(fields) not in (sorted(FIELDS), sorted(FIELDS[:2])) or "{" in "".join(parts[::2]):
            raise FaceDiffError(
                f"{pattern}: a pattern of file names has {{subject}} and {{sentence}} once each, may have "
                f"{{identity}} once, and has no other field"
            )
        known = "|".join(re.escape(name) for name in sorted(subjects, key=len, reverse=True))
        readings = [{"subject": known, "sentence": "[^/]+"}] if known else []
        if "identity" in fields and fields.index("subject") < fields.index("identity"):
            readings.append({"subject": "[^/]+", "sentence": "[^/]+", "identity": "(?P=subject)"})
        readings += [{"subject": "[^/]+", "sentence": "[^/_]+"}, {"subject": "[^/]+", "sentence": "[^/]+"}]
        self._readings = [re.compile(_expression(parts, reading)) for reading in readings]

    def match(self, name: str) -> Name | None:
        """The fields of a name; None if it is not of this pattern."""
        for reading in self._readings:
            found = reading.fullmatch(name)
            if found:
                return Name(**found.groupdict())
        return None


def _expression(parts: Sequence[str], reading: dict[str, str]) -> str:
    """The regular expression of a pattern whose fields read as given."""
    return "".join(
        f"(?P<{part}>{reading.get(part, '[^/]+')})" if place % 2 else re.escape(part)
        for place, part in enumerate(parts)
    )


def list_names(folder: Path, patterns: Sequence[NamePattern]) -> tuple[dict[Path, Name], list[str]]:
    """The ``.npy`` files of a folder by what their names say, sorted, and the names that no pattern fits.

    Files whose names begin with a dot are passed over.

    Raises:
        FaceDiffError: if there is no such folder, or no ``.npy`` file in it.
    """
    if not folder.is_dir():
        raise FaceDiffError(f"{folder}: no such folder; expected one with .npy files of vertices")
    deep = any("/" in pattern.pattern for pattern in patterns)
    files = sorted(file for file in folder.glob("**/*.npy" if deep else "*.npy") if not file.name.startswith("."))
    if not files:
        raise FaceDiffError(f"{folder}: holds no .npy file; expected files of vertices (frames, 3V) or (frames, V, 3)")
    found: dict[Path, Name] = {}
    unnamed = []
    for file in files:
        name = file.relative_to(folder).as_posix().removesuffix(".npy")
        read = next((match for pattern in patterns if (match := pattern.match(name))), None)
        if read is None:
            unnamed.append(f"{name}.npy")
        else:
            found[file] = read
    return found, unnamed
