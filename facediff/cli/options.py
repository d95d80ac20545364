"""Options that several commands share: each has one name, one type and one help text, wherever it appears."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.animation.options import View as View
from facediff.errors import FaceDiffError, OptionError
from facediff.utils import ranges
from facediff.utils.files import valid_text
from facediff.utils.hub import bundled_by_name, check_model_source, is_graphs
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.animation.options import SourceOptions

Output = Annotated[Path, Option(also="-o", metavar="OUT", writes="file")]
OutputFolder = Annotated[Path, Option(also="-o", metavar="OUT", writes="folder")]
Picture = Annotated[Path | None, Option(metavar="PNG", writes="file")]
Checkpoint = Annotated[Path, Option(metavar="C", reads=True)]
Animations = Annotated[list[Path], Option(metavar="ANIMATION", reads=True)]
Corpus = Annotated[str | None, Option(metavar="NAME")]
File = Annotated[Path | None, Option(metavar="FILE", reads=True)]
FileOrList = Annotated[str | None, Option(metavar="FILE", reads=True)]
Folder = Annotated[Path | None, Option(metavar="FOLDER", reads=True)]
Map = Annotated[Path | None, Option(metavar="MAP", reads=True, writes="file")]
Identity = Annotated[str | None, Option(metavar="NAME")]
FrameRate = Annotated[ranges.FrameRate | None, Option(metavar="F")]
Seed = Annotated[ranges.Seed, Option(metavar="N")]
Size = Annotated[ranges.Pixels, Option(metavar="PIXELS")]
Workers = Annotated[ranges.Workers | None, Option(metavar="N")]
Scheduler = Annotated[str | None, Option(metavar="WHERE")]


def check_source(source: SourceOptions, animations: Sequence[Path]) -> None:
    """Refuse, before anything is imported, files that do not exist."""
    for path in animations:
        if not path.is_file():
            raise FaceDiffError(f"{path}: no such file; expected an animation, .npz or .npy")
    if source.checkpoint is not None and not is_graphs(bundled_by_name(source.checkpoint)):
        check_model_source(source.checkpoint, "--checkpoint")
    for option, file in (("mesh", source.mesh), ("speech", source.speech)):
        if file is not None and not Path(file).is_file():
            raise OptionError(option, "no such file", file)


def with_different_names(animations: Sequence[Animation], paths: Sequence[Path]) -> list[Animation]:
    """The animations under their own names; where those are alike, as of one recording, under their files' names."""
    alike = len({animation.name for animation in animations}) < len(animations)
    return [
        replace(animation, name=valid_text(path.stem if alike else animation.name))
        for animation, path in zip(animations, paths, strict=True)
    ]


def check_picture_path(path: Path | None) -> None:
    """Refuse, before any work is done, a picture of another format."""
    if path is not None and path.suffix != ".png":
        raise FaceDiffError(f'--show {path}: unknown suffix "{path.suffix}"; expected a picture .png')


def check_folders(methods: Mapping[str, Path]) -> None:
    """Refuse, before anything is imported, folders of predictions that do not exist."""
    for folder in methods.values():
        if not folder.is_dir():
            raise FaceDiffError(f"{folder}: no such folder; expected the predictions of a method")


def named_folders(
    words: Sequence[str], name_of: Callable[[Path], str] = lambda path: path.resolve().name
) -> dict[str, Path]:
    """Folders by name, from words NAME=FOLDER, or FOLDER, which ``name_of`` names."""
    found: dict[str, Path] = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not equals or Path(word).exists():
            name, folder = name_of(Path(word)), word
        if not name or not folder:
            raise FaceDiffError(f"{word}: expected NAME=FOLDER")
        if name in found:
            raise FaceDiffError(f'{word}: there is already one called "{name}"; name it with NAME=FOLDER')
        found[name] = Path(folder)
    return found
