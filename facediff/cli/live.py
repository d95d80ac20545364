"""``facediff live``: somebody speaks now, and a face moves now, in other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.cli.options import Identity, Seed
from facediff.cli.parsing import refuse_idle
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.live.command import LiveOptions
    from facediff.live.model import LiveModel


def live(
    model: Annotated[Path, Option(metavar="MODEL", reads=True)],
    speech: Annotated[Path | None, Option(metavar="SPEECH", reads=True, dash=True)] = None,
    *,
    microphone: Annotated[str | None, Option(metavar="DEVICE", bare="default")] = None,
    rate: Annotated[ranges.SampleRate, Option(metavar="HZ")] = 16_000,
    to: Annotated[list[str] | None, Option(metavar="ADDRESS")] = None,
    identity: Identity = None,
    condition: Identity = None,
    style: Annotated[str | None, Option(metavar="STYLE", reads=True)] = None,
    seed: Seed = 0,
    steps: Annotated[ranges.Steps | None, Option(metavar="N")] = None,
    expressivity: Annotated[str | None, Option(metavar="E")] = None,
    voice_gate: Annotated[str, Option(metavar="GATE")] = "energy",
    window: Annotated[ranges.Window | None, Option(metavar="S")] = None,
    overlap: Annotated[ranges.Window | None, Option(metavar="S")] = None,
    shapes: Annotated[Path | None, Option(metavar="SHAPES", reads=True)] = None,
    sound: Annotated[str | None, Option(metavar="WHERE")] = None,
    seconds: Annotated[ranges.Duration | None, Option(metavar="S")] = None,
    threads: Annotated[ranges.Threads, Option(metavar="N")] = 0,
    device: str = "cpu",
    quiet: bool = False,
) -> None:
    """Animate a face while somebody speaks, and send it to engines, browsers and other programs.

    Frames leave at their rate, each at its time; frames that come too late are dropped. How long after the speech that
    is (the lag) is reported every few seconds and at the end. Ctrl-C ends the performance.

    For example:
      facediff live puppet-onnx --microphone --to browser
      facediff live puppet-onnx speech.wav --to livelink://127.0.0.1:11111 --shapes puppet
      arecord -q -f S16_LE -r 16000 -t raw | facediff live puppet-onnx - --to jsonl:-

    Args:
        model: folder of `facediff export-model`; or a trained model (.ckpt), through PyTorch
        speech: recording, played in real time; - for 16-bit samples (mono, little endian) on standard input
        microphone: sound device by its number or a part of its name, in place of SPEECH (default: the system's)
        rate: sample rate of samples on standard input
        to: where the frames go: scheme://host:port, a scheme alone, or scheme:file; may be repeated (docs/live.md, and
            `facediff components receiver`)
        identity: whose face and identity; by default the first one trained on
        condition: the training identity that the model is conditioned on, where it is not that of the face
        style: name of a style in the folder; of a trained model whatever `facediff animate --style` takes
        seed: seed of the noise
        steps: denoising steps of a trained model; those of a folder are fixed
        expressivity: 0 for the mean of what the model finds possible, 1 for a sample, up to 2 for more than that
        voice_gate: what finds the pauses, in which the mouth comes to rest: energy (which waits no longer than the
            windows) or webrtc, with options (energy:ahead=0.3); off for the model's own motion there
        window: seconds of a window, where frames need not be made one by one at low latency
        overlap: seconds that neighbouring windows share
        shapes: blendshapes for receivers that take weights: folder of meshes, .glb with targets, or "puppet" (built in)
        sound: where the speech is played, delayed to match: off, out (a sound device; out:NAME for one by its name), or
            receivers (the page in the browser) (default: receivers for a recording, else off)
        seconds: end after so much speech
        threads: of the processor (default: its cores)
        device: of a trained model: cpu, cuda …; auto for CUDA where there is one
        quiet: report at the end only
    """
    exported = (model / "model.json").is_file()
    if exported:
        refuse_idle("is for a trained model (.ckpt)", steps=steps is not None, device=device != "cpu")
    else:
        from facediff.utils.hub import check_model_source

        check_model_source(model)
        refuse_idle("is for a folder of `facediff export-model`", threads=threads != 0)
    if speech is not None and str(speech) != "-" and not speech.is_file():
        raise FaceDiffError(f"{speech}: no such sound file; give a recording, - for standard input, or --microphone")
    from facediff.live.command import LiveOptions, exported_model, perform, reporter

    options = LiveOptions(
        model=model,
        speech=None if speech is None else str(speech),
        microphone=microphone,
        rate=rate,
        to=to or [],
        identity=identity,
        condition=condition,
        style=style,
        seed=seed,
        expressivity=expressivity,
        voice_gate=voice_gate,
        window=window,
        overlap=overlap,
        shapes=shapes,
        sound=sound,
        seconds=seconds,
        threads=threads,
        quiet=quiet,
    )
    perform(
        options,
        exported_model if exported else lambda chosen: trained_model(chosen, steps, device),
        reporter("facediff live"),
    )


def trained_model(options: LiveOptions, steps: int | None, device: str) -> LiveModel:
    """The trained model that the options name, with PyTorch.

    Raises:
        FaceDiffError: naming the option.
    """
    import numpy as np

    from facediff.animation.options import AnimationOptions
    from facediff.live.model import LiveModel
    from facediff.models import load_model
    from facediff.pipelines.trained import TrainedPipeline, usable_device
    from facediff.speech.windows import LOW_LATENCY
    from facediff.utils.licences import licence_metadata

    model = load_model(options.model, usable_device(device))
    plan = LOW_LATENCY if options.low_latency else model.windows.chosen(options.window, options.overlap)
    chosen = AnimationOptions(
        checkpoint=options.model,
        identity=options.identity,
        condition=options.condition,
        style=options.style,
        steps=steps,
        expressivity=options.expressivity,
        voice_gate=options.gate(plan.look_ahead),
        window=options.window,
        overlap=options.overlap,
        low_latency=options.low_latency,
        seed=options.seed,
        device=device,
    )
    pipeline = TrainedPipeline(chosen, model=model)
    facts = pipeline.facts
    corpus = model.assets.corpus
    return LiveModel(
        start=pipeline.stream,
        frame_rate=model.frame_rate,
        neutral=facts["template"],
        faces=np.zeros((0, 3), np.int32) if facts["faces"] is None else facts["faces"],
        unit=facts["unit"],
        look_ahead=pipeline.look_ahead,
        hop=plan.in_frames(model.frame_rate).hop / model.frame_rate,
        colours=facts["colours"],
        metadata={
            "model": type(model).__name__,
            "corpus": f"{corpus} (synthetic)" if model.assets.synthetic else corpus,
            **licence_metadata(model.licences),
            "identity": pipeline.identity,
        },
    )
