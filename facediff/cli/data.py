"""``facediff data``: prepare, check, pack and import corpora."""

from __future__ import annotations

import importlib
import inspect
import json as json_format
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from facediff.cli.options import Corpus, File, FileOrList, FrameRate, OutputFolder, WorkOptions
from facediff.cli.parsing import Parameters, parameters_of, parse
from facediff.cli.process import tell
from facediff.data import prepare as prepare_package
from facediff.errors import FaceDiffError, check_known, counted, printable
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.data.preparation import PreparationPlan, PreparationReport

Root = Annotated[Path, Option(reads=True, exists="folder")]


def require_folder(source: str) -> None:
    """Refuse a source that is neither a folder nor an address, before anything heavy is imported."""
    if "://" not in source and not Path(source).is_dir():
        raise FaceDiffError(f"{source}: no such folder; expected a corpus folder, or the address of a packed corpus")


Packed = Annotated[str, Option(reads=True, check=require_folder)]
"""A folder, or the address of a packed corpus, such as ``s3://bucket/corpus.zarr``."""
NewFolder = Annotated[Path, Option(writes="folder")]

LISTED = 20
"""Lines of a list on the screen; the whole list is in the manifest."""


def find_own_module(corpus: str | None) -> None:
    """Let ``--corpus module.Class`` import a module of the working folder."""
    if corpus and "." in corpus:
        sys.path.append(os.getcwd())


@contextmanager
def resumable(out: Path) -> Iterator[None]:
    """Say on Ctrl-C that the work can be continued."""
    try:
        yield
    except KeyboardInterrupt:
        print(f"\nstopped; the same command continues where {printable(out)} was left", file=sys.stderr)
        raise


def shortened(lines: Sequence[str], rest: str) -> list[str]:
    """The first lines of a long list, and a line about the rest, in which {} is the number of lines left out."""
    return [*lines[:LISTED], *([rest.format(len(lines) - LISTED)] if len(lines) > LISTED else [])]


def check(
    root: Packed,
    *,
    corpus: Corpus = None,
    quick: bool = False,
    json: bool = False,
    work: WorkOptions,
) -> int:
    """Report which corpus a folder holds, and its missing and damaged files.

    Nothing is changed. Exit status: 0 sound (warnings allowed), 1 not sound, 2 wrong usage.

    Args:
        root: the corpus folder, or a packed corpus: its folder or its address
        corpus: the corpus, if it is not recognised: a name of `facediff components corpus`, flame_clips:LAYOUT, or
            package.module.Class
        quick: read headers only, and compare files by size
        json: machine-readable: one object
        work: where the work is done
    """
    from facediff.data.check import check as check_folder
    from facediff.data.check import text

    find_own_module(corpus)
    report = check_folder(
        root,
        corpus,
        quick=quick,
        workers=work.workers,
        scheduler=work.scheduler,
        progress=not (json or work.quiet),
    )
    lines = json_format.dumps(report.state(), indent=2, allow_nan=False) if json else text(report)
    tell(*lines.split("\n"))
    return 0 if report.sound else 1


def align(
    recordings: Root,
    *,
    output: OutputFolder,
    work: WorkOptions,
) -> int:
    """Write people's recordings with their phones, for the built-in corpus (--data.recordings).

    Phones come from NAME.TextGrid next to NAME.wav, else from pocketsphinx: for English, of words in NAME.txt or in
    LibriSpeech's *.trans.txt, else of words that it recognises.

    Args:
        recordings: folder with a folder of recordings for each speaker; directly in it, each recording is a speaker
        output: folder to make or to continue
        work: where the work is done

    Returns:
        0 if all recordings were used, 1 if some could not.
    """
    from facediff.data.align import align_recordings

    with resumable(output):
        report = align_recordings(
            recordings, output, workers=work.workers, scheduler=work.scheduler, progress=not work.quiet
        )
    tell(*report.lines())
    tell(f"Next: facediff fit --config configs/experiment/puppet.yaml --data.recordings={output}")
    return 1 if report.failed else 0


# ``facediff data prepare``: the options of a corpus are the keyword parameters of its plan.

CORPORA = tuple(module.name for module in pkgutil.iter_modules(prepare_package.__path__))
"""Modules of :mod:`facediff.data.prepare`; each has a ``plan(raw, *, …)`` whose keyword parameters are its options."""
PREPARE = """usage: facediff data prepare <corpus> RAW OUT [options]

Write a corpus folder from a data set as its authors distribute it. A run that was stopped is continued by the same
command.

corpora: {corpora}; `facediff data prepare <corpus> --help` lists the options of a corpus"""


def run(name: str, arguments: Sequence[str]) -> int:
    """``facediff data prepare``: choose the corpus and its plan with the options, and prepare it."""
    if not arguments or arguments[0] in ("-h", "--help"):
        tell(*PREPARE.format(corpora=", ".join(CORPORA)).split("\n"))
        return 0 if arguments else 2
    corpus, *remaining = arguments
    check_known("data prepare", "corpus", [corpus], CORPORA)
    module = importlib.import_module(f"facediff.data.prepare.{corpus}")
    title = (module.__doc__ or "").partition("\n")[0]
    values = parse(options_of(module.plan), remaining, f"facediff data prepare {corpus}", title)
    raw, out, work = values.pop("raw"), values.pop("out"), values.pop("work")
    if out.resolve().is_relative_to(raw.resolve()):  # the next run would read the output as raw data
        raise FaceDiffError(f"{out}: lies in the raw folder {raw}; choose a folder outside it to write to")
    if "quiet" in inspect.signature(module.plan).parameters:  # a long scan has a progress bar
        values["quiet"] = work.quiet
    from facediff.data.preparation import prepare

    with resumable(out):
        report = prepare(module.plan(raw, **values), out, reads=[raw], **vars(work))
    tell(*describe(report))
    return 0 if report.sound else 1


def options_of(plan: Callable[..., PreparationPlan]) -> Parameters:
    """The options of ``facediff data prepare`` for a corpus: the common ones, and the parameters of its plan."""

    def common(raw: Root, out: NewFolder, *, work: WorkOptions) -> None:
        """Prepare.

        Args:
            raw: the raw data set, unpacked
            out: folder to write: a new one, or one that this command has begun
            work: where the work is done
        """

    specific = {name: entry for name, entry in parameters_of(plan).items() if name not in ("raw", "quiet")}
    return {**parameters_of(common), **specific}


def describe(report: PreparationReport) -> list[str]:
    """The report as lines for the screen."""
    totals, manifest = report.totals, report.out / "manifest.json"
    lines = [
        f"{report.out}: {counted(totals['clips'], 'clip')}, {counted(totals['frames'], 'frame')}, "
        f"{totals['seconds'] / 60:.1f} min, {totals['bytes'] / 1e9:.2f} GB; {report.written} written now"
    ]
    for title, entries in (("missing", report.missing), ("failed", report.failed)):
        if entries:
            indented = [f"  {key}: {text}" for key, text in entries.items()]
            lines += [f"{title}: {len(entries)}", *shortened(indented, f"  … and {{}} more, see {manifest}")]
    notes = [f"note: {note}" for note in report.notes]
    return [
        *lines,
        *shortened(notes, f"note: … and {{}} more, see {manifest}"),
        f"Next: facediff data check {report.out}",
    ]


# ``facediff data pack`` and ``facediff data unpack``


def pack(
    root: Root,
    out: NewFolder,
    *,
    corpus: Corpus = None,
    tolerance: Annotated[ranges.Millimetres, Option(metavar="MM")] = 0.01,
    lossless: bool = False,
    exact: Literal["test", "none"] = "test",
    work: WorkOptions,
) -> None:
    """Pack a corpus into one Zarr store, at most a fifth of its size, that can also be read from an address.

    Every data module reads it: --data.root=OUT.zarr, or the address that it was copied to. A run that was stopped is
    continued by the same command.

    Args:
        root: the corpus folder
        out: packed corpus to write (OUT.zarr): a new one, or one that this command has begun
        corpus: the corpus, if it is not recognised: a name of `facediff components corpus`, or package.module.Class
        tolerance: by how many millimetres a stored coordinate may differ, at most
        lossless: keep the motion bit for bit, at about half its size
        exact: keep test clips and their style references bit for bit, so that scores stay the same; or none
        work: where the work is done
    """
    from facediff.data.packed.packing import pack as pack_folder

    find_own_module(corpus)
    with resumable(out):
        report = pack_folder(
            root, out, corpus=corpus, tolerance=tolerance, lossless=lossless, exact=exact, **vars(work)
        )
    left_out = [f"note: left out, since it belongs to no clip: {name}" for name in report.left_out]
    tell(
        f"{out}: {counted(report.clips, 'clip')}, {report.seconds / 60:.1f} min, {report.after / 1e9:.3g} GB "
        f"of {report.before / 1e9:.3g} GB; {counted(report.written, 'shard')} written now",
        *shortened(left_out, "note: … and {} more"),
        f"Next: facediff data check {out}",
    )


def unpack(packed: Packed, out: NewFolder, *, work: WorkOptions) -> None:
    """Write a packed corpus back as a corpus folder.

    Args:
        packed: folder of a packed corpus (.zarr), or its address
        out: folder to make
        work: where the work is done
    """
    from facediff.data.packed.unpacking import unpack as unpack_folder

    clips = unpack_folder(packed, out, **vars(work))
    tell(f"{out}: {counted(clips, 'clip')}", f"Next: facediff data check {out}")


# ``facediff data import-person``


def import_person(
    motion: Annotated[Path, Option(metavar="MOTION", reads=True, exists="file")],
    *,
    audio: File = None,
    name: str,
    corpus: Annotated[Path, Option(metavar="ROOT", reads=True, exists="folder")],
    output: OutputFolder,
    frame_rate: FrameRate = None,
    template: File = None,
    stable: FileOrList = None,
    flame: Annotated[Path | None, Option(metavar="MODEL", reads=True)] = None,
    clip_seconds: Annotated[ranges.ClipLength, Option(metavar="S")] = 8.0,
) -> None:
    """Turn the 3D reconstruction of one person's video, or for a corpus of people the video, into a corpus entry.

    Any data module takes it next to its own speakers (--data.people), and `facediff animate --style` takes a style
    from it.

    Args:
        motion: .npy of (frames, vertices, 3) or (frames, 3 vertices); FLAME parameters: shape_pose_cam.hdf5, or .npy
            of (1, frames, 403); or a video, which is tracked as by `facediff data track`
        audio: the video, or its sound; not for a video
        name: the person's name: letters, digits, dashes
        corpus: corpus of other speakers with the same topology
        output: folder to make
        frame_rate: frames a second of MOTION; not for a video
        template: neutral face (.npy) in MOTION's unit (default: the median of frames in which the person is silent
            and still)
        stable: text file with the indices of vertices that move with the skull only, or FLAME_masks.pkl:scalp+forehead
            (default: the vertices that move least)
        flame: your FLAME model file, for FLAME parameters
        clip_seconds: approximate length of a clip
    """
    from facediff.data.corpus import read_manifest
    from facediff.data.person import import_person as import_motion
    from facediff.speech.audio import VIDEOS

    if motion.suffix.lower() in VIDEOS:
        from facediff.data.track.corpus import import_video

        tell(*import_video(motion, name, corpus, output, clip_seconds).lines())
        return
    if audio is None or frame_rate is None:
        raise FaceDiffError("--audio, --frame-rate: are needed for arrays and parameters; only a video has both")
    report = import_motion(
        motion,
        audio=audio,
        name=name,
        corpus=corpus,
        output=output,
        frame_rate=frame_rate,
        template=template,
        stable=stable,
        flame=flame,
        clip_seconds=clip_seconds,
    )
    tell(f"{output}: {report.name}", *report.lines(read_manifest(output).get("unit")))


# ``facediff data import-take``


def import_take(
    take: Annotated[Path, Option(metavar="TAKE", reads=True, exists="file")],
    sound: Annotated[Path, Option(metavar="SOUND", reads=True, exists="file")],
    *,
    name: str,
    output: OutputFolder,
    offset: Annotated[ranges.TakeOffset | None, Option(metavar="S")] = None,
    most_offset: Annotated[ranges.ClipLength, Option(metavar="S")] = 10.0,
    clip_seconds: Annotated[ranges.ClipLength, Option(metavar="S")] = 8.0,
) -> None:
    """Turn a recording of Live Link Face and its sound into a corpus entry.

    Where the motion begins in the sound is found by how the mouth opens when speech is loud, and reported. Any data
    module of ARKit's shapes takes the entry next to its own speakers (--data.people), `facediff adapt` as --person.

    Args:
        take: the recording, .csv
        sound: its sound or its video
        name: the person's name: letters, digits, dashes
        output: folder to make
        offset: seconds of SOUND before the motion begins (default: found)
        most_offset: largest offset to look for, either way
        clip_seconds: approximate length of a clip
    """
    from facediff.data.person import import_take as import_recording

    report = import_recording(
        take, sound, name=name, output=output, offset=offset, most_offset=most_offset, clip_seconds=clip_seconds
    )
    tell(f"{output}: {report.name}", *report.lines())
