"""``facediff figure``: the figures of a paper, one command each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from facediff.cli.options import (
    File,
    FileOrList,
    FrameRate,
    Truth,
    View,
    named_folders,
)
from facediff.cli.process import tell
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from collections.abc import Sequence

    from facediff.evaluation.figures import FigureData, Paper

NOTES = 3
"""Notes that are printed at most."""

Predictions = Annotated[str, Option(metavar="PREDICTIONS", reads=True)]
Clip = Annotated[str | None, Option(metavar="CLIP")]
Highest = Annotated[ranges.Factor | None, Option(metavar="VALUE")]


@dataclass(frozen=True)
class FileOptions:
    """Files.

    PREDICTIONS are folders of .npy files of absolute vertices, (frames, V, 3) or (frames, 3V). TRUTH is a corpus
    folder (its vertices_npy, wav, templates.pkl, regions, phonemes and mesh are used), any folder of .npy files, or
    `puppet`, the built-in corpus.

    Attributes:
        method: a further method, repeatable
        pattern: how predictions are named, repeatable (see `facediff evaluate`)
        truth_pattern: how truths are named (default: {subject}_{sentence})
        identity: whose style predictions were given: own, or an identity's name
        topology: a name of `facediff components corpus`, or package.module.Class
        templates: templates.pkl, each speaker's neutral face
        mesh: .ply or .obj with the faces
        frame_rate: frames a second of the predictions
        truth_stride: use every N-th frame of the truth (default: by the frame rates)
        unit: unit of the vertices, such as m (default: the corpus's)
    """

    method: Annotated[list[str] | None, Option(metavar="NAME=FOLDER", reads=True)] = None
    pattern: Annotated[list[str] | None, Option(metavar="PATTERN")] = None
    truth_pattern: Annotated[str | None, Option(metavar="PATTERN")] = None
    identity: Annotated[str, Option(metavar="NAME")] = "own"
    topology: Annotated[str | None, Option(also="--corpus", metavar="NAME")] = None
    templates: File = None
    mesh: File = None
    frame_rate: FrameRate = None
    truth_stride: Annotated[ranges.Stride | None, Option(metavar="N")] = None
    unit: Annotated[str | None, Option(metavar="U")] = None

    def gather(self, predictions: str, truth: Path, page: PageOptions) -> tuple[Paper, FigureData]:
        """The page and the data to draw."""
        methods = named_folders([predictions, *(self.method or [])])
        paper = page.paper()
        from facediff.evaluation import DEFAULT_PATTERNS, TRUTH_PATTERN
        from facediff.evaluation.figures.gather import gather

        options: dict[str, Any] = {
            name: value for name, value in vars(self).items() if name not in ("method", "pattern")
        }
        options |= {"patterns": self.pattern or DEFAULT_PATTERNS, "truth_pattern": self.truth_pattern or TRUTH_PATTERN}
        return paper, gather(methods, truth, **options)


@dataclass(frozen=True)
class PageOptions:
    """Page.

    Attributes:
        output: .png, .pdf or .svg
        width: mm; 175 fills a page, 85 a column
        dpi: pixels an inch
        font: an installed font; DejaVu Sans has the IPA
    """

    output: Annotated[Path, Option(also="-o", metavar="OUT", writes="file", suffixes=(".png", ".pdf", ".svg"))]
    width: Annotated[ranges.PageWidth, Option(metavar="MM")] = 175.0
    dpi: Annotated[ranges.Resolution, Option(metavar="N")] = 300
    font: Annotated[str, Option(metavar="NAME")] = "DejaVu Sans"

    def paper(self) -> Paper:
        """The page; matplotlib must be there."""
        from facediff.evaluation.figures.page import Paper, matplotlib

        matplotlib()
        return Paper(self.width, self.dpi, self.font)


def frames(
    predictions: Predictions,
    truth: Truth,
    *,
    clip: Clip = None,
    times: Annotated[list[ranges.Seconds] | None, Option(metavar="SECONDS", many=True)] = None,
    phonemes: Annotated[list[str] | None, Option(metavar="IPA", many=True)] = None,
    phoneme_file: Annotated[Path | None, Option(metavar="CSV", reads=True)] = None,
    close_up: bool = False,
    regions: Annotated[Path | None, Option(metavar="FOLDER", reads=True, needs="close_up")] = None,
    lips: Annotated[str | None, Option(metavar="FILE", reads=True, needs="close_up")] = None,
    view: View = "front",
    files: FileOptions,
    page: PageOptions,
) -> None:
    """Faces at chosen times or phonemes, the truth and the methods below one another.

    Args:
        predictions: folder of predictions, or NAME=FOLDER
        truth: corpus folder, folder of truths, or puppet
        clip: <subject>_<sentence> (default: the first that all have)
        times: columns by time
        phonemes: columns by phoneme or viseme; m:2 is the clip's second /m/
        phoneme_file: table of start, end, ipa (default: the corpus's)
        close_up: show the mouth only
        regions: for --close-up: folder with lve.txt or FLAME_masks.pkl
        lips: for --close-up: the lips, as `facediff evaluate` takes them
        view: camera
        files: the files to draw from.
        page: how it is printed.
    """
    if bool(times) == bool(phonemes):
        raise FaceDiffError("expected either --times or --phonemes, which name the columns")
    paper, material = files.gather(predictions, truth, page)
    from facediff.evaluation.figures import Moment, draw_frames, find_phoneme
    from facediff.evaluation.figures.gather import phonemes_of

    name = material.choose([clip] if clip else None)[0]
    track = phonemes_of(material, name, phoneme_file)
    if times:
        moments = [Moment(time, next((p for p in track if p.start <= time < p.end), None)) for time in times]
    else:
        matches = [find_phoneme(selector, track, name) for selector in phonemes or []]
        moments = [Moment(phoneme.middle, phoneme) for phoneme in matches]
    region = None
    if close_up:
        from facediff.evaluation import read_region

        folder = regions or (material.corpus / "regions" if material.corpus else None)
        region = read_region("lips", material.n_vertices, folder=folder, source=lips).indices
    draw_frames(material, name, moments, page.output, paper=paper, view=view, region=region)
    report(page.output)


def heatmap(
    predictions: Predictions,
    truth: Truth,
    *,
    clips: Annotated[list[str] | None, Option(metavar="CLIP", many=True)] = None,
    highest_mean: Highest = None,
    highest_std: Highest = None,
    view: View = "front",
    files: FileOptions,
    page: PageOptions,
) -> None:
    """Mean and standard deviation over time of each vertex's motion.

    Args:
        predictions: folder of predictions, or NAME=FOLDER
        truth: corpus folder, folder of truths, or puppet
        clips: clips to count (default: all that truth and methods have)
        highest_mean: end of the mean's scale in the unit shown
        highest_std: end of the standard deviation's scale
        view: camera
        files: the files to draw from.
        page: how it is printed.
    """
    paper, material = files.gather(predictions, truth, page)
    from facediff.evaluation.figures import draw_heatmap

    highest = (highest_mean, highest_std)
    notes = draw_heatmap(material, material.choose(clips), page.output, paper=paper, view=view, highest=highest)
    report(page.output, notes)


def lips(
    predictions: Predictions,
    truth: Truth,
    *,
    clip: Clip = None,
    lip_pairs: FileOrList = None,
    audio: File = None,
    phoneme_file: Annotated[Path | None, Option(metavar="CSV", reads=True)] = None,
    span: Annotated[tuple[ranges.Seconds, ranges.Seconds] | None, Option(metavar=("FROM", "TO"))] = None,
    files: FileOptions,
    page: PageOptions,
) -> None:
    """Lip opening over time, with phonemes and waveform beneath.

    Args:
        predictions: folder of predictions, or NAME=FOLDER
        truth: corpus folder, folder of truths, or puppet
        clip: <subject>_<sentence> (default: the first that all have)
        lip_pairs: pairs of upper and lower lip vertices (default: the corpus's)
        audio: the clip's speech (default: the corpus's)
        phoneme_file: table of start, end, ipa (default: the corpus's)
        span: seconds to show (default: all)
        files: the files to draw from.
        page: how it is printed.
    """
    paper, material = files.gather(predictions, truth, page)
    from facediff.evaluation.figures import SpeechTrack, draw_lips, opening_curves, read_pairs
    from facediff.evaluation.figures.gather import phonemes_of, sound_of

    name = material.choose([clip] if clip else None)[0]
    curves, note = opening_curves(material, name, read_pairs(lip_pairs, material.corpus, material.n_vertices))
    samples = sound_of(material, name, audio)
    notes = [f"{name}: {note}"] if note else []
    if samples is None:
        notes.append(f"there is no sound of {name}; give --audio to have its waveform")
    phonemes = phonemes_of(material, name, phoneme_file)
    sound = SpeechTrack(phonemes=phonemes) if samples is None else SpeechTrack(samples, phonemes=phonemes)
    draw_lips(curves, sound, page.output, paper=paper, scale=material.scale, span=span, remark=material.remark)
    report(page.output, notes)


def report(output: Path, notes: Sequence[str] = ()) -> None:
    """Print where the figure is, and the first of the notes about it."""
    for note in notes[:NOTES]:
        tell(f"note: {note}")
    if len(notes) > NOTES:
        tell(f"note: {len(notes) - NOTES} more such notes")
    tell(f"written: {output}")
