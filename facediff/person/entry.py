"""Writing a person's corpus entry: all of it, or nothing."""

from __future__ import annotations

import csv
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.audio import fit_length, samples_for
from facediff.errors import FaceDiffError
from facediff.files import check_writable
from facediff.prepare.job import motion_file, speech_file, write_motion, write_speech, write_templates
from facediff.prepare.manifest import MANIFEST, describe_files, version, write_record


@dataclass(frozen=True)
class EntryClip:
    """One clip to write.

    Attributes:
        name: ``<person>_s01``.
        split: ``train``, ``val`` or ``test``.
        start: its first frame.
        stop: the frame after its last one.
    """

    name: str
    split: str
    start: int
    stop: int


def check_output(path: Path) -> None:
    """Refuse, before any work is done, a folder that is not empty or cannot be made.

    Raises:
        FaceDiffError: saying which.
    """
    if path.exists() and not path.is_dir():
        raise FaceDiffError(f"{path}: is a file; expected the name of a new folder")
    if path.is_dir() and any(path.iterdir()):
        raise FaceDiffError(f"{path}: is not empty; choose a new folder, or remove this one")
    check_writable(path / "manifest.json")
    check_writable(path.with_name(f".{path.name}.probe"))


@contextmanager
def whole_folder(path: Path) -> Iterator[tuple[Path, Path]]:
    """A folder to fill, renamed to ``path`` at the end, and one for scratch files; both vanish if anything fails.

    They lie beside ``path``, and are also removed when the user interrupts.

    Raises:
        FaceDiffError: if it cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    made = [folder for folder in path.parents if not folder.exists()]
    done = False
    try:
        for folder in (partial / "entry", partial / "scratch"):
            folder.mkdir(parents=True)
        yield partial / "entry", partial / "scratch"
        if path.is_dir():
            path.rmdir()  # it was empty before; if it is not any more, this fails
        (partial / "entry").rename(path)
        done = True
    except OSError as error:
        raise FaceDiffError(
            f"{path}: cannot be written ({error.strerror or error}); choose a folder that you may write to and that "
            f"has room"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        for folder in [] if done else made:
            with suppress(OSError):
                folder.rmdir()


def write_entry(
    folder: Path,
    *,
    name: str,
    clips: Sequence[EntryClip],
    frames: npt.NDArray[np.floating],
    speech: npt.NDArray[np.float32],
    template: npt.NDArray[np.floating],
    frame_rate: float,
    facts: dict[str, Any],
) -> None:
    """Write an entry in the layout that every corpus has, and its manifest.

    Args:
        folder: where to.
        name: the person.
        clips: how the frames are cut.
        frames: (T, V, 3) absolute vertices; may be memory-mapped.
        speech: (S,) at 16 kHz; missing samples at its end become zeros.
        template: (V, 3) neutral face.
        frame_rate: frames a second.
        facts: what else the manifest shall say.
    """
    # 16-bit sound ends at full scale: turn down a recording that goes beyond as a whole.
    speech = speech / max(1.0, float(np.abs(speech).max(initial=0.0)))
    for clip in clips:
        write_motion(motion_file(folder, clip.name), frames[clip.start : clip.stop])
        first = samples_for(clip.start, frame_rate)
        write_speech(
            speech_file(folder, clip.name), fit_length(speech[first:], samples_for(clip.stop, frame_rate) - first)
        )
    write_templates(folder / "templates.pkl", {name: template.astype(np.float32)})
    with (folder / "clips.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(["clip", "subject", "sentence", "split"])
        table.writerows([clip.name, name, clip.name.rpartition("_")[2], clip.split] for clip in clips)
    written = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    files = describe_files(folder, written, 2, lambda: None)
    write_record(
        folder / MANIFEST, {"facediff": version(), "corpus": "person", "person": name, **facts, "files": files}
    )
