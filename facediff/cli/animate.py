"""``facediff animate``: speech in, animation out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from facediff.animation.options import (
    AnimationControls,
    AnimationOptions,
    DeviceOptions,
    ExportOptions,
    GenerationOptions,
    LicenceOptions,
    RecordingOptions,
    TargetOptions,
    WindowOptions,
)
from facediff.cli.options import Scheduler, Workers
from facediff.cli.parsing import changed
from facediff.cli.process import confirm_cost, tell
from facediff.errors import FaceDiffError, refuse_idle
from facediff.utils import ranges
from facediff.utils.files import example_recordings
from facediff.utils.hub import check_animating_source, model_or_bundled
from facediff.utils.option import Option


@dataclass(frozen=True)
class BatchOptions:
    """Batch (several recordings or a folder; can be resumed).

    Attributes:
        suffix: format of the batch's outputs
        workers: recordings at a time (default: one for each processor)
        scheduler: where tasks run: processes, threads, or tcp://HOST:PORT of a Dask cluster (docs/cluster.md)
        retry_failed: try recordings again that failed before
    """

    suffix: Annotated[str, Option(metavar="SUFFIX")] = ".mp4"
    workers: Workers = None
    scheduler: Scheduler = None
    retry_failed: bool = False


def animate(
    speech: Annotated[
        list[Path] | None, Option(metavar="SPEECH", reads=True, exists="file or folder", dash=True)
    ] = None,
    *,
    example: Annotated[bool, Option(without="speech stream")] = False,
    checkpoint: Annotated[Path | None, Option(metavar="C", reads=True)] = None,
    output: Annotated[Path, Option(also="-o", metavar="OUT", writes="file or folder", dash=True)],
    stream: bool = False,
    rate: Annotated[ranges.SampleRate, Option(metavar="HZ", needs="stream")] = 16_000,
    still: bool = False,
    quiet: bool = False,
    yes: bool = False,
    generation: GenerationOptions,
    windows: WindowOptions,
    recording: RecordingOptions,
    controls: AnimationControls,
    target: TargetOptions,
    files: ExportOptions,
    batch: BatchOptions,
    device: DeviceOptions,
    licence: LicenceOptions,
) -> int:
    """Animate a face with a recording of speech, with many, or with speech as it comes.

    For example:
      facediff animate --example -o speech.html
      facediff animate speech.wav --checkpoint demo/puppet.ckpt -o speech.mp4
      facediff animate speech.wav --checkpoint demo/puppet.ckpt --samples 3 --blinks -o speech.html
      facediff animate recordings/ --checkpoint demo/puppet.ckpt --suffix .glb -o animations/
      arecord -f S16_LE -r 16000 -t raw | facediff animate - --stream --checkpoint demo/puppet.ckpt -o live.npy

    Args:
        speech: recording: wav, flac, ogg, mp3 or a video; several or a folder for a batch; - with --stream
        example: animate the recording that comes with facediff
        checkpoint: trained model (.ckpt), a folder of `facediff publish` or `facediff export-model`, or USER/NAME of
            the Hugging Face hub (default: the model that comes with facediff)
        output: file to write; its suffix chooses the format (`facediff components export_format`); a folder for a batch
        stream: read PCM (16 bit, mono, little endian) from standard input as it comes
        rate: sample rate of that PCM
        still: the model's motion alone in videos, pages and avatars, where the built-in face else has a lively style
            and acts, sways and glances (--style, --acting, --sway, --gaze)
        quiet: no progress bars
        yes: start without a question, however much time or memory it takes
        generation: whose face, in which style, how.
        windows: how long speech is cut.
        recording: options that need the whole recording.
        controls: changes after inference.
        target: another mesh.
        files: how the files are written.
        batch: how several recordings are animated.
        device: where the model computes.
        licence: which models are refused.
    """
    speech = example_recordings()[:1] if example else speech or []
    if not speech:
        raise FaceDiffError("speech: missing; give a recording, a folder of them, - with --stream, or --example")
    streamed = [str(path) for path in speech] == ["-"]
    is_batch = len(speech) > 1 or speech[0].is_dir()
    if streamed != stream:
        raise FaceDiffError(
            f"--stream: reads standard input; give - in place of {speech[0]} (a file needs no --stream)"
            if stream
            else "speech: - is standard input; add --stream, and send samples rather than a file"
        )
    if stream:
        refuse_idle("is for recordings, and a stream ends by itself", max_seconds=recording.max_seconds is not None)
    if is_batch:
        refuse_idle("is for one recording", alignment=recording.alignment is not None)
    else:
        refuse_idle("is for several recordings or a folder of them", **changed(batch))
    checkpoint = model_or_bundled(checkpoint)
    check_animating_source(checkpoint)
    from facediff.export import check_used, is_film

    file = Path(f"a{batch.suffix}") if is_batch else Path("a.npy") if stream else output
    check_used(file.suffix, files.changed())
    is_avatar = target.target_mesh is not None and file.suffix.lower() == ".glb"
    is_seen = file.suffix == ".html" or is_film(file.suffix) or is_avatar
    refuse_idle(
        "is for videos, pages and avatars: other files have the model's motion alone", still=still and not is_seen
    )
    files = replace(files, quiet=quiet)
    if isinstance(generation.style, str):
        from facediff.pipelines.animator import load
        from facediff.pipelines.video_styles import with_video_styles

        generation = replace(generation, style=with_video_styles(generation.style, lambda: load(checkpoint)))
    if target.target_mesh is not None and not target.carry:
        from facediff.export.glb_own_shapes import shapes_to_drive

        target = replace(target, own_shapes=shapes_to_drive(Path(target.target_mesh), file) is not None)
    groups = (generation, windows, recording, controls, target, device, licence)
    options = AnimationOptions.of(*groups, checkpoint=checkpoint, quiet=quiet, alive=is_seen and not still)
    if stream:
        from facediff.pipelines.stream import animate_stream

        animate_stream(options, output, files, rate=rate)
        return 0
    if is_batch:
        from facediff.pipelines.folder import animate_folder

        return animate_folder(options, speech, output, export=files, **vars(batch))
    animate_recording(options, speech[0], output, files, yes=yes)
    return 0


def animate_recording(
    options: AnimationOptions, speech: Path, output: Path, files: ExportOptions, *, yes: bool
) -> None:
    """Animate one recording, and report the files written."""
    from facediff.export import check_export
    from facediff.export.writing import seeks_weights
    from facediff.pipelines.animate import check_options
    from facediff.pipelines.trained import open_pipeline
    from facediff.speech.audio import read_recording
    from facediff.speech.voice_activity import speech_problems
    from facediff.utils.hub import may_have_weights

    check_options(options)
    check_export(output, files, options.samples, weights=may_have_weights(options.checkpoint))
    recording = read_recording(speech, options.max_seconds)  # before the model, which takes longer to load
    for problem in speech_problems(recording.speech):
        tell(f"note: {speech}: {problem}")
    pipeline = open_pipeline(options)
    weights = seeks_weights(output, files) and pipeline.has_weights
    check_export(output, files, options.samples, weights=weights)
    seconds, size = pipeline.cost(recording.seconds, output, files.size)
    confirm_cost(yes, "--samples, --steps or --size", seconds=seconds, size=size)
    written, animation = pipeline.write(recording, output, files)
    metadata = animation.metadata
    facts = {"identity": "identity ", "style": "style of ", "edited": "edited: ", "procedural": "procedural: "}
    notes = [f"{words}{metadata[name]}" for name, words in facts.items() if name in metadata]
    notes += [f"licence: {metadata.get('licence', 'not stated')}"]
    line = f"{len(animation.vertices)} frames, {', '.join(notes)}"
    for path in written:
        tell(f"{path}: {line}")
        line = "next to it"
    if options.target_mesh is not None:
        from facediff.cli.retarget import surface_notes
        from facediff.export.glb_own_shapes import own_shapes

        mesh = Path(options.target_mesh)
        fit_notes = [] if pipeline.retarget is None else pipeline.retarget.notes
        tell(*fit_notes, *surface_notes(mesh, output, animation))
        if options.own_shapes:
            avatar = own_shapes(mesh)
            tell(avatar.summary, *avatar.left_out(animation))
