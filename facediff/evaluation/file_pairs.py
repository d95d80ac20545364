"""Find the files that are scored, pair them, and find the templates, regions and lip pairs that belong to them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from facediff.data.corpus import ALL, EYELID_PAIRS, LIP_PAIRS, MOTION_FOLDERS, find_region, read_templates
from facediff.errors import FaceDiffError
from facediff.metrics import TOPOLOGIES, EyelidPairs, LipPairs, Region
from facediff.utils.arrays import open_vertices
from facediff.utils.paths import compose


@contextmanager
def errors_of(subject: str) -> Iterator[None]:
    """Errors of metrics inside it name a subject, such as the metric."""
    try:
        yield
    except (ValueError, TypeError, RuntimeError) as error:
        raise FaceDiffError(f"{subject}: {error}") from error


# File names: speaker, sentence, and the condition of a prediction.

DEFAULT_PATTERNS = ("{subject}_{sentence}_condition_{identity}", "{subject}_{sentence}")
"""How predictions are named by default; the first is the released projects'."""

TRUTH_PATTERN = "{subject}_{sentence}"  # How truths are named by default
FIELDS = ("subject", "sentence", "identity")


@dataclass(frozen=True)
class Name:
    """The fields of a file's name."""

    subject: str  # who speaks
    sentence: str
    identity: str | None = None  # the condition of the prediction; None if the name does not say

    @property
    def clip(self) -> str:
        """``<subject>_<sentence>``, by which prediction and truth are paired."""
        return f"{self.subject}_{self.sentence}"


class NamePattern:
    """Reads the fields of names by a pattern such as ``{subject}_{sentence}_condition_{identity}``.

    Names of speakers and sentences may hold underscores. Where a name can be read in several ways, a known speaker
    takes precedence, then a speaker that is also the identity, then the split at the last underscore.

    Args:
        pattern: the name without ``.npy``, or the path below the folder if it has a ``/``. It has ``{subject}`` and
            ``{sentence}`` and may have ``{identity}``.
        subjects: known speakers.
    """

    def __init__(self, pattern: str, subjects: Collection[str] = ()) -> None:
        self.pattern = pattern
        parts = re.split(r"\{(\w*)\}", compose(pattern).removesuffix(".npy"))
        fields = parts[1::2]
        if sorted(fields) not in (sorted(FIELDS), sorted(FIELDS[:2])) or "{" in "".join(parts[::2]):
            raise FaceDiffError(
                f"{pattern}: a pattern of file names has {{subject}} and {{sentence}} once each, may have "
                f"{{identity}} once, and has no other field"
            )
        speakers = "|".join(re.escape(compose(name)) for name in sorted(subjects, key=len, reverse=True))
        readings = [{"subject": speakers, "sentence": "[^/]+"}] if speakers else []
        if "identity" in fields and fields.index("subject") < fields.index("identity"):
            readings.append({"subject": "[^/]+", "sentence": "[^/]+", "identity": "(?P=subject)"})
        readings += [{"subject": "[^/]+", "sentence": "[^/_]+"}, {"subject": "[^/]+", "sentence": "[^/]+"}]
        self._readings = [
            re.compile(
                "".join(
                    f"(?P<{part}>{reading.get(part, '[^/]+')})" if index % 2 else re.escape(part)
                    for index, part in enumerate(parts)
                )
            )
            for reading in readings
        ]

    def match(self, name: str) -> Name | None:
        """The fields of a name; None if it is not of this pattern."""
        match = next((match for reading in self._readings if (match := reading.fullmatch(compose(name)))), None)
        return Name(**match.groupdict()) if match else None


def list_names(
    folder: Path, patterns: Sequence[NamePattern], suffixes: Sequence[str] = (".npy",)
) -> tuple[dict[Path, Name], list[str]]:
    """The motion files of a folder with the fields of their names, sorted, and the names that no pattern fits.

    Hidden files are ignored.
    """
    expected = "files of vertices (frames, 3V) or (frames, V, 3)" if len(suffixes) == 1 else "files of parameters"
    deep = any("/" in pattern.pattern for pattern in patterns)
    files = sorted(
        file
        for file in folder.glob("**/*" if deep else "*")
        if file.suffix.lower() in suffixes and not file.name.startswith(".")
    )
    if not files:
        raise FaceDiffError(f"{folder}: no {' or '.join(suffixes)} file; expected a folder of {expected}")
    names: dict[Path, Name] = {}
    unnamed = []
    for file in files:
        name = file.relative_to(folder).as_posix().removesuffix(file.suffix)
        read = next((match for pattern in patterns if (match := pattern.match(name))), None)
        if read is None:
            unnamed.append(f"{name}{file.suffix}")
        else:
            names[file] = read
    return names, unnamed


# Pairing of predictions and truths.

OWN = "own"  # Scores the prediction that was conditioned on the speaker's own identity


@dataclass(frozen=True)
class Truth:
    """The truth of one clip."""

    path: Path
    name: Name


@dataclass(frozen=True)
class Pair:
    """A clip and the predictions that are scored on it."""

    clip: str
    truth: Truth
    # Files by identity; several only if the mean over conditions is asked for. The identity is "" where the file's name
    # does not say it.
    predictions: dict[str, Path]


@dataclass(frozen=True)
class Missing:
    """Files and clips of one method that were not scored."""

    without_truth: list[str] = field(default_factory=list)  # files of clips that have no truth
    # Clips that have no prediction of the conditions asked for.
    without_prediction: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)  # files under conditions that were not asked for
    unnamed: list[str] = field(default_factory=list)  # files that no pattern fits
    # Clip to reason: unreadable files, other meshes, speakers without a template.
    unusable: dict[str, str] = field(default_factory=dict)


def index_truths(names: Mapping[Path, Name]) -> dict[str, Truth]:
    """Truths by clip."""
    truths: dict[str, Truth] = {}
    for path, name in names.items():
        if name.clip in truths:
            raise FaceDiffError(f"{path}: a second truth of {name.clip}; keep it or {truths[name.clip].path}")
        truths[name.clip] = Truth(path, name)
    return truths


def pair_up(predictions: Mapping[Path, Name], truths: Mapping[str, Truth], identity: str) -> tuple[list[Pair], Missing]:
    """Find each truth's predictions: pairs sorted by clip, and the files and clips without a counterpart.

    ``identity`` is ``own``, the prediction conditioned on the speaker's own identity or else the one without a
    condition in its name; ``all``, every condition; or a condition's name.
    """
    pairs, unscored = list[Pair](), Missing()
    by_clip: dict[str, dict[str, Path]] = {}
    speakers: dict[str, str] = {}
    for path, name in predictions.items():
        if name.clip not in truths:
            unscored.without_truth.append(path.name)
            continue
        files = by_clip.setdefault(name.clip, {})
        if (duplicate := files.get(name.identity or "")) is not None:
            raise FaceDiffError(f"{path}: is the same clip and condition as {duplicate}; keep one, or give --pattern")
        files[name.identity or ""] = path
        if name.identity is not None and name.identity in (name.subject, truths[name.clip].name.subject):
            speakers[name.clip] = name.identity
    for clip, truth in sorted(truths.items()):
        paths = by_clip.get(clip, {})
        if identity == ALL:  # "" stands for a name without a condition
            conditions = sorted(name for name in paths if name) or list(paths)
        else:
            condition = speakers.get(clip, "") if identity == OWN else identity
            conditions = [condition] if condition in paths else []
        unscored.unused.extend(sorted(path.name for name, path in paths.items() if name not in conditions))
        if conditions:
            pairs.append(Pair(clip, truth, {name: paths[name] for name in conditions}))
        else:
            unscored.without_prediction.append(clip)
    return pairs, unscored


# The corpus folder, the mesh's size, regions and lip pairs.


def find_truths(folder: Path) -> tuple[Path, Path | None]:
    """The folder of the truth's files, and its corpus folder if it has one."""
    for name in MOTION_FOLDERS:
        if (folder / name).is_dir():
            return folder / name, folder
    return folder, folder.parent if folder.name in MOTION_FOLDERS else None


def count_vertices(topology: str | None, templates: Path | None, truth: Path) -> int:
    """Vertices of the mesh: as the topology says, else the templates, else the first readable truth."""
    if topology in TOPOLOGIES:
        return TOPOLOGIES[topology].n_vertices
    if templates is not None:
        return len(next(iter(read_templates(templates).values())))
    for path in sorted(truth.glob("**/*.npy")):
        with suppress(FaceDiffError):
            return open_vertices(path).shape[1]
    raise FaceDiffError(f"{truth}: no file says how many vertices the mesh has; say it with --n-vertices")


Part = Literal["lips", "upper_face"]

USUAL: dict[Part, tuple[str, ...]] = {
    "lips": ("lve.txt", "FLAME_masks.pkl:lips"),
    "upper_face": ("fdd.txt", "FLAME_masks.pkl:forehead+eye_region"),
}
"""Sources that are looked for if none is named."""

OPTIONS: dict[Part, str] = {"lips": "--lips", "upper_face": "--upper-face"}


def read_region(part: Part, n_vertices: int, *, folder: Path | None = None, source: str | None = None) -> Region:
    """A region from one of the files that circulate.

    Args:
        part: ``lips`` or ``upper_face``.
        n_vertices: vertices of the mesh.
        folder: where to look; the working folder if None.
        source: a text file of indices; a pickle; ``FLAME_masks.pkl:lips``, one or several (joined by "+") masks of a
            pickle; ``mouth_mask.txt>0.1``, the vertices of a file of weights above a threshold; or ``all``. Without
            one, ``lve.txt`` or ``fdd.txt`` is taken, else the masks of FLAME.
    """
    advice = f"give --regions FOLDER with {USUAL[part][0]} or FLAME_masks.pkl in it, or {OPTIONS[part]} FILE"
    root = folder or Path()
    files = {name: root / name.partition(">")[0].partition(":")[0] for name in ([source] if source else USUAL[part])}
    name = next((name for name, path in files.items() if name == ALL or path.is_file()), None)
    if name is None:
        noun = part.replace("_", " ")
        raise FaceDiffError(f"{' and '.join(map(str, files.values()))}: not there; expected the {noun}; {advice}")
    file, above, threshold = name.partition(">")
    if not above:
        return find_region(root, [name], name, n_vertices)
    with errors_of(OPTIONS[part]):
        region = Region.from_weights(root / file, float(threshold), name=name)
        region.check(n_vertices)
    return region


PAIR_FILES: dict[type[LipPairs], tuple[str, str, str]] = {
    LipPairs: (LIP_PAIRS, "--lip-pairs", "lip"),
    EyelidPairs: (EYELID_PAIRS, "--eyelid-pairs", "eyelid"),
}
"""The corpus's file of pairs, the option for another file, and the kind of vertices."""


def read_pairs(source: str | None, corpus: Path | None, n_vertices: int, kind: type[LipPairs] = LipPairs) -> LipPairs:
    """Pairs of an upper and a lower lip or eyelid vertex: of a file, as in ``3531-3504,1-2``, or the corpus's."""
    file, option, part = PAIR_FILES[kind]
    if source is None and corpus is not None and (corpus / file).is_file():
        source = str(corpus / file)
    if source is None:
        where = f"{corpus / file}: no such file" if corpus is not None else "the truth is no corpus folder"
        raise FaceDiffError(
            f"{where}; give {option}, a file with one upper and one lower {part} vertex a line, or pairs such as "
            f"3531-3504 (the middle of FLAME's lips)"
        )
    with errors_of(f"{option} {source}"):
        if not Path(source).is_file() and all(c.isdecimal() or c in "-," for c in source):
            pairs = kind.from_pairs("given", [[int(i) for i in pair.split("-")] for pair in source.split(",")])
        else:
            pairs = kind.from_file(source)
        pairs.check(n_vertices)
    return pairs
