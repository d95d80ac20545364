"""``facediff export-model``: a trained model as a folder that animates without PyTorch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from facediff.cli.options import File, NewFolder
from facediff.cli.process import tell
from facediff.errors import refuse_idle
from facediff.utils import ranges
from facediff.utils.hub import BUNDLED, bundled_by_name, model_or_bundled
from facediff.utils.option import Option


def export_model(
    model: Annotated[Path | None, Option(metavar="MODEL", reads=True)] = None,
    *,
    output: NewFolder,
    weights: Literal["float32", "float16", "int8"] = "float32",
    sampler: Annotated[str | None, Option(metavar="NAME")] = None,
    steps: Annotated[ranges.Steps | None, Option(metavar="N")] = None,
    quick_steps: Annotated[ranges.Steps | None, Option(metavar="N")] = None,
    speech: File = None,
    identities: Annotated[list[str] | None, Option(metavar="NAME", many=True)] = None,
) -> None:
    """Write a model for ONNX Runtime: graphs, templates, styles, and a description.

    The folder animates without PyTorch, in Python, on the command line and in the browser. It is
    compared with the model before it appears.

    For example:
      facediff export-model demo/puppet.ckpt -o puppet-onnx
      facediff animate speech.wav --checkpoint puppet-onnx -o speech.glb

    Args:
        model: checkpoint (.ckpt); without one, the model that comes with facediff is written as it is
        output: folder to write
        weights: how they are stored: float32, float16, or int8 (the audio encoder's in 8 bits, the others in 16)
        sampler: sampler of the exported model; the checkpoint's own by default
        steps: its denoising steps
        quick_steps: its denoising steps at low latency (default: 2)
        speech: recording that the folder is compared with the model on; a made-up sound by default
        identities: speakers of the folder's faces and styles (default: all that the model knows)
    """
    if model is None or bundled_by_name(model) is BUNDLED:
        options: dict[str, object] = {"sampler": sampler, "steps": steps, "quick_steps": quick_steps, "speech": speech}
        options |= {"identities": identities, "weights": None if weights == "float32" else weights}
        idle = {name: value is not None for name, value in options.items()}
        refuse_idle("is for checkpoints, and the model that comes with facediff is exported already", **idle)
        from facediff.runtime.folder import copy_exported

        copied = copy_exported(model_or_bundled(model), output)
        tell(f"wrote {output}: {copied / 1e6:.1f} MB")
        return
    from facediff.pipelines.export_model import export_model as export
    from facediff.pipelines.export_model import require_onnx

    require_onnx()
    samples = None
    if speech is not None:
        from facediff.speech.audio import read_recording

        samples = read_recording(speech).speech

    from facediff.models import load_model

    loaded = load_model(model)
    if sampler is not None or steps is not None:
        loaded.choose_sampler(sampler, steps)
    if quick_steps is not None:
        refuse_idle(
            f"{type(loaded).__name__} keeps its steps at low latency", quick_steps=loaded.low_latency_steps is None
        )
        loaded.low_latency_steps = quick_steps
    tell(f"recording the graphs of {type(loaded).__name__}, which takes a minute …")
    description = export(loaded, output, precision=weights, speech=samples, identities=identities)
    megabytes = sum(description.sizes.values()) / 1e6
    check = description.check
    unit = f" {description.unit}" if description.motion_space.is_vertices else " of a channel"
    tell(
        f"wrote {output}: {megabytes:.1f} MB, {description.precision}; largest difference from PyTorch "
        f"{check['largest_difference']:.1e}{unit}, {check['share_of_range']:.1e} of the motion's range"
    )
