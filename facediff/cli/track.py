"""``facediff data track`` and ``facediff person``: from videos of people to a corpus, and to a model of one of them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.cli.data import resumable
from facediff.cli.options import CheckpointFile, OutputFolder, WorkOptions
from facediff.cli.process import tell
from facediff.data.track.options import TrackingOptions
from facediff.errors import FaceDiffError
from facediff.utils import SAMPLE_RATE, ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.data.track.recording import Recording
    from facediff.data.track.video import Picture

Videos = Annotated[Path, Option(metavar="VIDEOS", reads=True, exists="file or folder")]
Name = Annotated[str | None, Option(metavar="NAME")]
CONFIG = "configs/experiment/people.yaml"
STEPS = 400
"""Of training by ``facediff person``."""
ONE_PERSON = ("--model.audio_encoder.frozen=false", "--data.augmentations=null", "--data.augmented_share=1.0")
"""Settings that were measured with one person, docs/results/people.md."""
PREVIEW_RATE, CURVES = 25, 96
"""Frames a second, and height of the curves in pixels."""
LAGS, MOST_LAG, ALIKE = 5, 2, 0.4
"""Frames by which sound and mouth are compared; by which they may differ; and the correlation from which on the
comparison counts."""
CLIPS = 8  # of a person, that are compared


def track(
    videos: Videos,
    *,
    output: OutputFolder,
    name: Name = None,
    preview: Annotated[Path | None, Option(metavar="MP4", writes="file", suffixes=(".mp4", ".webm"))] = None,
    tracking: TrackingOptions,
    work: WorkOptions,
) -> int:
    """Track people's faces in videos, and write them as a corpus, or add them to one.

    Only track people who have agreed to it. Hidden lips, brows and vertical gaze cannot be measured: a mouth behind a
    hand or a microphone is invented.

    Args:
        videos: a video; a folder with videos of one person; or a folder with a folder of videos for each person, whose
            names are the folders'
        output: folder to make, to continue or to add to
        name: the person's name: letters, digits, dashes (default: that of the file or folder)
        preview: video to write: the first video with the points of the face, and curves of lips and lids
        tracking: how faces are tracked.
        work: where the work is done

    Returns:
        0 if all videos were used, 1 if some could not.
    """
    from facediff.data.track.corpus import find_videos, track_people

    recordings = find_videos(videos, name)
    with resumable(output):
        report = track_people(
            recordings,
            output,
            tracking,
            workers=work.workers,
            scheduler=work.scheduler,
            progress=not work.quiet,
        )
    tell(*report.lines(), *sync_warnings(output, [person.name for person in report.people]))
    if preview is not None:
        write_preview(report.first, preview)
        tell(f"{preview}: look whether the points follow lips and lids")
    tell(f"Next: facediff data check {output}")
    return 1 if report.failed else 0


def person(
    video: Annotated[Path, Option(metavar="VIDEO", reads=True, exists="file or folder")],
    *,
    name: Name = None,
    output: CheckpointFile,
    corpus: Annotated[Path | None, Option(metavar="FOLDER", writes="folder")] = None,
    steps: Annotated[ranges.Steps, Option(metavar="N")] = STEPS,
    tracking: TrackingOptions,
    quiet: bool = False,
) -> None:
    """Make a model of a person from a video: track the face, check the corpus, and train on it.

    Only of people who have agreed to it. A minute of video is enough to begin with, ten are better; on two processor
    cores it takes about ten minutes. The same command continues where it was stopped.

    Args:
        video: a video of the person, or a folder of videos
        name: the person's name: letters, digits, dashes (default: that of the file or folder)
        output: checkpoint to write (.ckpt)
        corpus: folder of the corpus that is made on the way (default: maria_corpus next to maria.ckpt)
        steps: training steps
        tracking: how faces are tracked.
        quiet: no progress bars
    """
    from facediff.callbacks.runs import LAST
    from facediff.cli.lightning import run_cli
    from facediff.data import People
    from facediff.data.check import check
    from facediff.data.track.corpus import find_videos, track_people
    from facediff.utils.checksums import sha256

    started, root = time.monotonic(), corpus or output.with_name(f"{output.stem}_corpus")
    videos = find_videos(video, name)
    if len(videos) > 1:
        raise FaceDiffError(f"{video}: holds several people's videos; expected one's, or use `facediff data track`")
    with resumable(output):
        tracked = track_people(videos, root, tracking, workers=None, progress=not quiet)
        tell(*tracked.lines(), *sync_warnings(root, videos))
        if tracked.people[0].clips == 1:
            raise FaceDiffError(
                f"{video}: gives a single clip, and training needs two; expected a minute of video (or, in another "
                f"--corpus, a smaller --clip-seconds)"
            )
        if not check(root, None, progress=not quiet).sound:
            raise FaceDiffError(f"{root}: is not sound; `facediff data check {root}` says why")
        data = People(root=str(root))
        options = ["--config", CONFIG, f"--data.root={root}", f"--trainer.max_steps={steps}", *ONE_PERSON]
        # A stopped training of these clips and steps goes on; another video is another training.
        training = f".training/{sha256(root / 'manifest.json')[:8]}_{steps}"
        options += [f"--trainer.logger.save_dir={root}", f"--trainer.logger.name={training}"]
        options += [] if data.clips("val") else ["--trainer.limit_val_batches=0"]
        options += ["--ckpt_path", "last"] if any((root / training).glob(f"*/{LAST}")) else []
        trained = run_cli("fit", options)
    trained.trainer.save_checkpoint(output, weights_only=False)
    (who,) = videos
    options_of_speaker = f"--checkpoint {output} --identity {who}"
    tell(
        f"{output}: {who}, in {(time.monotonic() - started) / 60:.0f} min",
        f"Next: facediff animate speech.wav {options_of_speaker} -o speech.mp4",
        f"      facediff animate speech.wav {options_of_speaker} --target-mesh avatar.glb -o speech.glb",
    )


def sync_warnings(root: Path, people: Iterable[str]) -> Iterator[str]:
    """Warnings about people of a corpus with sound that is out of step, by the mouth of the bundled model."""
    import numpy as np

    from facediff.data.corpus import LIP_PAIRS, read_manifest
    from facediff.data.track.face import pair_distances
    from facediff.metrics import LipPairs
    from facediff.pipelines.animator import load
    from facediff.speech.audio import read_speech
    from facediff.utils.arrays import open_array
    from facediff.utils.cross_correlation import correlations, peak

    model, rate = load("puppet"), read_manifest(root)["frame_rate"]
    pairs = LipPairs.from_file(root / LIP_PAIRS).pairs
    for person in people:
        scores = []
        for file in sorted((root / "vertices_npy").glob(f"{person}_s*.npy"))[:CLIPS]:
            frames = open_array(file, kinds="f")
            gaps = pair_distances(frames.reshape(len(frames), -1, 3), pairs)
            animation = model.animate(read_speech(root / "wav" / f"{file.stem}.wav"), SAMPLE_RATE, seed=0)
            expected = pair_distances(animation.vertices, np.asarray(animation.inner_lip_pairs))
            times = np.arange(len(expected)) / model.frame_rate
            scores.append(correlations(np.interp(times, np.arange(len(gaps)) / rate, gaps), expected, LAGS, 2 * LAGS))
        mean = np.mean(scores, axis=0)
        late = peak(mean)
        if mean.max() >= ALIKE and abs(late) >= MOST_LAG:
            size = f"about {1000 * abs(late) / model.frame_rate:.0f} ms {'early' if late > 0 else 'late'}"
            yield f"warning: {person}: the sound is {size}; shift it in the video"


def write_preview(recording: Recording, path: Path) -> None:
    """Write a video with the points of its face, and below it curves of lips (red) and lids (blue)."""
    from facediff.render import write_video

    write_video(path, preview_frames(recording), PREVIEW_RATE, recording.speech, SAMPLE_RATE)


def preview_frames(recording: Recording) -> Iterator[Picture]:
    """The pictures of a video at a constant rate, with points and curves."""
    import cv2
    import numpy as np

    from facediff.data.track.face import pair_distances
    from facediff.data.track.topology import EYELID_PAIRS, LIP_PAIRS
    from facediff.data.track.video import read_pictures

    landmarks, times = recording.landmarks, recording.times
    widths = np.linalg.norm(landmarks[:, 234] - landmarks[:, 454], axis=-1)
    curves = [pair_distances(landmarks, pairs) / widths for pairs in (LIP_PAIRS, EYELID_PAIRS)]
    written = 0
    for number, (_, picture) in enumerate(read_pictures(recording.source)):
        canvas = np.concatenate([picture, np.zeros((CURVES, picture.shape[1], 3), np.uint8)])
        for x, y in landmarks[number, :, :2] if np.isfinite(recording.presence[number]) else ():
            cv2.circle(canvas, (round(float(x)), round(float(y))), 1, (0, 255, 0), -1)
        for curve, colour in zip(curves, ((255, 80, 80), (80, 160, 255)), strict=True):
            window = curve[max(0, number - picture.shape[1] // 2) : number + 1]
            heights = canvas.shape[0] - 2 - (CURVES - 4) * window / max(float(np.nanmax(curve)), 1e-6)
            line = np.stack([2 * np.arange(len(window)), heights], axis=1)[np.isfinite(heights)]
            cv2.polylines(canvas, [line.round().astype(np.int32)], False, colour, 1, cv2.LINE_AA)
        end = times[number + 1] if number + 1 < len(times) else times[number] + 1 / PREVIEW_RATE
        while written < end * PREVIEW_RATE - 1e-6:
            written += 1
            yield canvas
