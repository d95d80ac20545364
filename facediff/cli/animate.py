"""``facediff animate``: speech in, animation out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from facediff.cli.options import (
    Checkpoint,
    ControlOptions,
    File,
    Identity,
    Map,
    OutputOptions,
    Scheduler,
    Seed,
    Workers,
    confirm_cost,
)
from facediff.cli.parsing import Option, changed, refuse_idle
from facediff.cli.process import tell
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.hub import check_model_source
from facediff.utils.jobs import check_scheduler


@dataclass(frozen=True)
class WindowOptions:
    """Long speech (animated by sliding windows).

    Attributes:
        window: seconds of a window (default: 4)
        overlap: seconds that neighbouring windows share (default: 1)
        low_latency: answer at once: windows of one frame, 0.12 s of look-ahead, two denoising steps
        max_seconds: refuse speech that lasts longer
        stream: read PCM (16 bit, mono, little endian) from standard input as it comes
        rate: sample rate of that PCM
    """

    window: Annotated[ranges.Window | None, Option(metavar="S")] = None
    overlap: Annotated[ranges.Window | None, Option(metavar="S")] = None
    low_latency: bool = False
    max_seconds: Annotated[ranges.Duration | None, Option(metavar="S")] = None
    stream: bool = False
    rate: Annotated[ranges.SampleRate, Option(metavar="HZ")] = 16_000


@dataclass(frozen=True)
class SpeechOptions:
    """Speech (what is done about pauses and noise).

    Attributes:
        voice_gate: what finds the pauses, in which the mouth comes to rest: energy or webrtc, with options
            (energy:release=0.3); off for the model's own motion there
        denoise: take steady noise out of the recording before the model hears it (the file keeps the recording)
        alignment: when which phoneme is spoken, .TextGrid or .csv (start, end, ipa): the lips touch at each p, b and m
        transcript: the English words that are spoken, from which these times are found
        closure_budget: mm that a vertex is moved by at most for that (default: 12)
    """

    voice_gate: Annotated[str, Option(metavar="GATE")] = "energy"
    denoise: bool = False
    alignment: File = None
    transcript: Annotated[str | None, Option(metavar="TEXT")] = None
    closure_budget: Annotated[ranges.Millimetres | None, Option(metavar="MM")] = None


@dataclass(frozen=True)
class BatchOptions:
    """Batch (several recordings or a folder; can be resumed).

    Attributes:
        suffix: format of the batch's outputs
        workers: recordings at a time (default: one for each processor)
        scheduler: where tasks run: processes, threads, tcp://HOST:PORT of a Dask cluster, or slurm (docs/cluster.md)
        retry_failed: try recordings again that failed before
    """

    suffix: Annotated[str, Option(metavar="SUFFIX")] = ".mp4"
    workers: Workers = None
    scheduler: Scheduler = None
    retry_failed: bool = False


def animate(
    speech: Annotated[list[Path], Option(metavar="SPEECH", reads=True, dash=True)],
    *,
    checkpoint: Checkpoint,
    output: Annotated[Path, Option(also="-o", metavar="OUT", writes="file or folder", dash=True)],
    identity: Identity = None,
    condition: Identity = None,
    style: Annotated[str | None, Option(metavar="STYLE", reads=True)] = None,
    style_template: Annotated[str | None, Option(metavar="FACE", reads=True)] = None,
    samples: Annotated[ranges.Samples, Option(metavar="N")] = 1,
    sampler: Annotated[str | None, Option(metavar="NAME")] = None,
    steps: Annotated[ranges.Steps | None, Option(metavar="N")] = None,
    expressivity: Annotated[str | None, Option(metavar="E")] = None,
    guidance: Annotated[str | None, Option(metavar="SCALES")] = None,
    seed: Seed = 0,
    device: str = "cpu",
    commercial_only: bool = False,
    precision: Literal["32", "bf16"] = "32",
    target_mesh: File = None,
    correspondence: Map = None,
    quiet: bool = False,
    yes: bool = False,
    files: OutputOptions,
    sound: SpeechOptions,
    windows: WindowOptions,
    batch: BatchOptions,
    controls: ControlOptions,
) -> int:
    """Animate a face with a recording of speech, with many, or with speech as it comes.

    For example:
      facediff animate speech.wav --checkpoint demo/puppet.ckpt -o speech.mp4
      facediff animate speech.wav --checkpoint demo/puppet.ckpt --samples 3 --blinks -o speech.html
      facediff animate recordings/ --checkpoint demo/puppet.ckpt --suffix .glb -o animations/
      arecord -f S16_LE -r 16000 -t raw | facediff animate - --stream --checkpoint demo/puppet.ckpt -o live.npy

    Args:
        speech: recording: wav, flac, ogg, mp3 or a video; several or a folder for a batch; - with --stream
        checkpoint: trained model (.ckpt)
        output: file to write; its suffix chooses the format (see `facediff export --help`); a folder for a batch
        identity: whose face and identity; by default the first one trained on
        condition: the training identity that the model is conditioned on, where it is not that of the face
        style: the speaking style: a motion (.npy of absolute vertices, .npz animation), a vector of `facediff style
            extract`, a clip's name (F1_e03), or a mixture of them (a.npy:0.3,b.npy:0.7); by default the identity's
            stored reference
        style_template: neutral face (mesh or .npy) of the speaker whose motion --style holds, where the checkpoint does
            not know them; or the word median
        samples: how many animations, with seeds one after another
        sampler: sampler by name; see `facediff components sampler`
        steps: denoising steps of the sampler
        expressivity: 0 for the mean of what the model finds possible, 1 for a sample, up to 2 for more than that; or by
            region, lips=0.5,upper_face=1.2 (default: the checkpoint's, usually 1)
        guidance: follow conditions more than the model would by itself, style=1.5,speech=1.2,identity=1.3, where it was
            trained for that (default: the checkpoint's, usually 1)
        seed: seed of the noise
        device: cpu, cuda …; auto for CUDA where there is one
        commercial_only: refuse a model that is not cleared for commercial use
        precision: bf16 multiplies in 16 bits, where the processor is faster at it; the motion differs a little
        target_mesh: transfer the motion to this mesh
        correspondence: with --target-mesh: .npz to use if it exists, else to write
        quiet: no progress bars
        yes: start without a question, however much time or memory it takes
        files: how the files are written.
        sound: what is done about pauses and noise.
        windows: how long speech is cut.
        batch: how several recordings are animated.
        controls: what is changed after inference.

    Returns:
        the exit status: 1 if a recording of a batch failed.
    """
    streamed = [str(path) for path in speech] == ["-"]
    if windows.stream and not streamed:
        raise FaceDiffError(
            f"--stream: reads standard input; give - in place of {speech[0]} (a file needs no --stream)"
        )
    if streamed and not windows.stream:
        raise FaceDiffError("speech: - is standard input; add --stream, and send samples rather than a file")
    if windows.stream:
        refuse_idle("is for recordings, and a stream ends by itself", max_seconds=windows.max_seconds is not None)
    else:
        refuse_idle("is for --stream", rate=changed(windows)["rate"])
    if len(speech) > 1 or speech[0].is_dir():
        refuse_idle(
            "is for one recording", alignment=sound.alignment is not None, transcript=sound.transcript is not None
        )
    if windows.stream or (len(speech) == 1 and not speech[0].is_dir()):
        refuse_idle("is for several recordings or a folder of them", **changed(batch))
    if not streamed and len(speech) == 1 and not speech[0].exists():
        raise FaceDiffError(f"{speech[0]}: no such sound file or folder of recordings")
    check_model_source(checkpoint)
    check_scheduler(batch.scheduler)
    from facediff.pipelines.animate import AnimationOptions, AnimationPipeline, direction_for, read_recording
    from facediff.speech.voice_activity import speech_problems

    several = len(speech) > 1 or speech[0].is_dir()
    files.check(batch.suffix if several else ".npy" if windows.stream else output.suffix)
    wanted = controls.controls()
    if wanted.direction is not None and not several:
        wanted = replace(wanted, direction=direction_for(wanted.direction, speech[0], streamed=streamed))
    options = AnimationOptions(
        checkpoint=checkpoint,
        identity=identity,
        condition=condition,
        style=style,
        style_template=style_template,
        samples=samples,
        sampler=sampler,
        steps=steps,
        expressivity=expressivity,
        guidance=guidance,
        device=device,
        commercial_only=commercial_only,
        precision=precision,
        window=windows.window,
        overlap=windows.overlap,
        low_latency=windows.low_latency,
        voice_gate=sound.voice_gate,
        denoise=sound.denoise,
        alignment=sound.alignment,
        transcript=sound.transcript,
        closure_budget=sound.closure_budget,
        controls=wanted,
        target_mesh=target_mesh,
        correspondence=correspondence,
        export=files.export(quiet=quiet),
        quiet=quiet,
    )
    if windows.stream:
        from facediff.pipelines.stream import animate_stream

        animate_stream(options, output, rate=windows.rate, seed=seed)
        return 0
    if several:
        from facediff.pipelines.folder import animate_folder

        return animate_folder(
            options,
            speech,
            output,
            batch.suffix,
            seed=seed,
            max_seconds=windows.max_seconds,
            workers=batch.workers,
            scheduler=batch.scheduler,
            retry_failed=batch.retry_failed,
        )
    options.check(output)
    samples_of_speech = read_recording(speech[0], windows.max_seconds)  # before the model, which takes longer to load
    for problem in speech_problems(samples_of_speech):
        tell(f"note: {speech[0]}: {problem}")
    pipeline = AnimationPipeline(options, seed=seed)
    seconds, size = pipeline.cost(samples_of_speech, output)
    confirm_cost(yes, "--samples, --steps or --size", seconds=seconds, size=size)
    written, animation = pipeline.write(samples_of_speech, speech[0].stem, output, seed=seed)
    metadata = animation.metadata
    notes = "".join(f", {name}: {metadata[name]}" for name in ("edited", "procedural") if name in metadata)
    notes += f", licence: {metadata['licence']}"
    line = f"{len(animation.vertices)} frames, identity {metadata['identity']}, style of {metadata['style']}{notes}"
    for path in written:
        tell(f"{path}: {line}")
        line = "next to it"
    return 0
