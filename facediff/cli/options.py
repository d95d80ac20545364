"""Options that several commands share: each has one name, one type and one help text, wherever it appears."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.animation.options import View as View
from facediff.cli.process import tell
from facediff.errors import FaceDiffError, OptionError
from facediff.utils import ranges
from facediff.utils.files import valid_text
from facediff.utils.hub import bundled_by_name, check_model_source, is_graphs
from facediff.utils.jobs import check_scheduler
from facediff.utils.option import Option
from facediff.utils.server import LOOPBACK

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.animation.options import SourceOptions

Output = Annotated[Path, Option(also="-o", metavar="OUT", writes="file")]
OutputFolder = Annotated[Path, Option(also="-o", metavar="OUT", writes="folder")]
NewFolder = Annotated[Path, Option(also="-o", metavar="OUT", writes="folder", new=True)]
CheckpointFile = Annotated[Path, Option(also="-o", metavar="OUT", writes="file", suffixes=(".ckpt",))]
Picture = Annotated[Path | None, Option(metavar="PNG", writes="file", suffixes=(".png",))]
Checkpoint = Annotated[Path, Option(metavar="C", reads=True)]
Animations = Annotated[list[Path], Option(metavar="ANIMATION", reads=True, exists="file")]
Corpus = Annotated[str | None, Option(metavar="NAME")]
File = Annotated[Path | None, Option(metavar="FILE", reads=True)]
FileOrList = Annotated[str | None, Option(metavar="FILE", reads=True)]
Folder = Annotated[Path | None, Option(metavar="FOLDER", reads=True)]
Map = Annotated[Path | None, Option(metavar="MAP", reads=True, writes="file")]
Identity = Annotated[str | None, Option(metavar="NAME")]
FrameRate = Annotated[ranges.FrameRate | None, Option(metavar="F")]
Seed = Annotated[ranges.Seed, Option(metavar="N")]
Workers = Annotated[ranges.Workers | None, Option(metavar="N")]
Scheduler = Annotated[str | None, Option(metavar="WHERE", check=check_scheduler)]
Text = Annotated[str | None, Option(metavar="NAME")]


def require_truth(path: Path | None) -> None:
    """Refuse a path that is neither a folder nor the name of the built-in corpus."""
    if path is not None and not path.is_dir() and str(path) != "puppet":
        raise FaceDiffError(f"{path}: no such folder; expected a corpus, a folder of truths or animations, or puppet")


Truth = Annotated[Path, Option(metavar="TRUTH", reads=True, check=require_truth)]


@dataclass(frozen=True)
class WorkOptions:
    """Where the work is done.

    Attributes:
        workers: clips or videos at a time (default: as many as processors)
        scheduler: where tasks run: processes, threads, or tcp://HOST:PORT of a Dask cluster (docs/cluster.md)
        quiet: no progress bars
    """

    workers: Workers = None
    scheduler: Scheduler = None
    quiet: bool = False


@dataclass(frozen=True)
class PageServer:
    """Page (of a command that serves one).

    Attributes:
        host: address to listen at; by default only this machine reaches it
        port: to listen at; 0 for any free one (default: 8000 for a study, 8010 for a model)
        open: open the page in the browser
    """

    host: Annotated[str, Option(metavar="ADDRESS")] = "127.0.0.1"
    port: Annotated[ranges.Port | None, Option(metavar="N")] = None
    open: bool = False

    def announce(self, text: str, action: str) -> Callable[[str], None]:
        """A callback that gets the page's address once it is served, prints the text, and opens the page.

        ``action`` of visitors is in the note if others can reach the page.
        """

        def ready(address: str) -> None:
            tell(f"{address} {text}")
            if self.host not in LOOPBACK:
                tell(f"note: all who reach {self.host} may {action}, without encryption")
            if self.open:
                import webbrowser

                webbrowser.open(address)

        return ready


def check_source(source: SourceOptions) -> None:
    """Refuse, before anything is imported, files that do not exist."""
    if source.checkpoint is not None and not is_graphs(bundled_by_name(source.checkpoint)):
        check_model_source(source.checkpoint, "--checkpoint")
    for option, file in (("mesh", source.mesh), ("speech", source.speech)):
        if file is not None and not Path(file).is_file():
            raise OptionError(option, "no such file", file)


def with_different_names(animations: Sequence[Animation], paths: Sequence[Path]) -> list[Animation]:
    """The animations under their names, or under their files' where those are alike, as of one recording."""
    alike = len({animation.name for animation in animations}) < len(animations)
    return [
        replace(animation, name=valid_text(path.stem if alike else animation.name))
        for animation, path in zip(animations, paths, strict=True)
    ]


def named_folders(
    arguments: Sequence[str], name_of: Callable[[Path], str] = lambda path: path.resolve().name
) -> dict[str, Path]:
    """Folders by name, from words NAME=FOLDER, or FOLDER, which ``name_of`` names; all of them exist."""
    folders: dict[str, Path] = {}
    for word in arguments:
        name, equals, folder = word.partition("=")
        if not equals or Path(word).exists():
            name, folder = name_of(Path(word)), word
        if not name or not folder or not Path(folder).exists():
            raise FaceDiffError(f"{folder or word}: no such folder; expected NAME=FOLDER")
        if name in folders:
            raise FaceDiffError(f'{word}: there is already one called "{name}"; name it with NAME=FOLDER')
        folders[name] = Path(folder)
    return folders
