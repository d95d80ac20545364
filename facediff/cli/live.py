"""``facediff live``: animate live speech and send the frames to other programs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.animation.options import (
    AnimationControls,
    AnimationOptions,
    DeviceOptions,
    GenerationOptions,
    WindowOptions,
)
from facediff.errors import FaceDiffError
from facediff.live.options import LiveOptions
from facediff.utils.hub import BUNDLED, check_animating_source, is_audio2face, model_or_bundled
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.live.model import LiveModel


def live(
    model: Annotated[Path | None, Option(metavar="MODEL", reads=True)] = None,
    speech: Annotated[Path | None, Option(metavar="SPEECH", reads=True, dash=True)] = None,
    *,
    checkpoint: Annotated[Path | None, Option(metavar="C", reads=True)] = None,
    performance: LiveOptions,
    generation: GenerationOptions,
    windows: WindowOptions,
    controls: AnimationControls,
    device: DeviceOptions,
) -> None:
    """Animate live speech, and send it to engines, browsers and other programs.

    Frames leave at their rate, each at its time; late frames are dropped. The lag behind the speech is reported every
    few seconds and at the end. Ctrl-C ends the performance. Frames are generated one by one, with low latency, unless
    --window or --overlap are given. --blinks, --gaze and --sway need whole recordings: they are for `facediff animate`.

    For example:
      facediff live --microphone --to browser
      facediff live speech.wav --to livelink://127.0.0.1:11111
      facediff live speech.wav --checkpoint demo/puppet.ckpt --to vmc --shapes puppet
      arecord -q -f S16_LE -r 16000 -t raw | facediff live puppet-onnx - --to jsonl:-

    Args:
        model: the model, unless --checkpoint names it (default: the one that comes with facediff)
        speech: recording, played in real time; - for 16-bit samples (mono, little endian) on standard input
        checkpoint: trained model (.ckpt), a folder of `facediff publish` or `facediff export-model`, or USER/NAME of
            the Hugging Face hub
        performance: the source of the speech and the receivers of the frames.
        generation: whose face, in which style, how.
        windows: how long speech is cut.
        controls: changes after inference.
        device: where the model computes.
    """
    from facediff.speech.audio import RECORDINGS

    if checkpoint is not None:
        if speech is not None:
            raise FaceDiffError(f"{model}: one model too many; give it alone, or --checkpoint")
        model, speech = checkpoint, model
    # A recording in the model's place is animated by the bundled model.
    if model is not None and speech is None and (str(model) == "-" or model.suffix.lower() in RECORDINGS):
        model, speech = None, model
    model = model_or_bundled(model)
    check_animating_source(model)
    if speech is not None and str(speech) != "-" and not speech.is_file():
        raise FaceDiffError(f"{speech}: no such sound file; give a recording, - for standard input, or --microphone")
    # Frames of Audio2Face-3D have a window each, and a low latency by themselves.
    if windows.window is None and windows.overlap is None and not is_audio2face(model):
        windows = replace(windows, low_latency=True)
    options = AnimationOptions.of(generation, windows, controls, device, checkpoint=model)
    from facediff.live.command import perform, print_report
    from facediff.pipelines.animate import check_options

    check_options(options)
    shapes = performance.shapes
    if shapes is None and model == BUNDLED:
        from facediff.editing.shapes import BUILT_IN

        shapes = Path(BUILT_IN)
    performance = replace(performance, speech=None if speech is None else str(speech), shapes=shapes)
    perform(performance, lambda: live_model(options), print_report)


def live_model(options: AnimationOptions) -> LiveModel:
    """The model that the options name, ready to perform."""
    import numpy as np

    from facediff.live.model import LiveModel, usual_gate
    from facediff.pipelines.trained import open_pipeline
    from facediff.speech.voice_activity import USUAL_GATE, read_gate

    pipeline = open_pipeline(options)
    if pipeline.rest is not None and pipeline.gate == USUAL_GATE:
        pipeline.rest.mouth.gate = read_gate(usual_gate(pipeline.stream_timing[0])) or pipeline.rest.mouth.gate
    pipeline.stream()  # refuses options that cannot be streamed, before anything is opened
    face = pipeline.facts
    channels = pipeline.decoder is not None and pipeline.face is None  # controls change vertices
    return LiveModel(
        start=partial(pipeline.stream, channels=channels),
        frame_rate=pipeline.frame_rate,
        neutral=face["template"],
        faces=np.zeros((0, 3), np.int32) if face["faces"] is None else face["faces"],
        unit=face["unit"],
        look_ahead=pipeline.look_ahead,
        hop=pipeline.stream_timing[1],
        colours=face.get("colours"),
        decoder=pipeline.decoder if channels else None,
        metadata={name: text for name, text in pipeline.metadata(pipeline.seed).items() if text},
    )
