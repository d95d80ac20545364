"""The pipeline for a model, whichever kind it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from facediff.animation.options import AnimationOptions
from facediff.utils.hub import is_audio2face, is_exported

if TYPE_CHECKING:
    from facediff.pipelines.animate import AnimationPipeline


def open_pipeline(options: AnimationOptions) -> AnimationPipeline:
    """The pipeline for the model that the options name: trained, with PyTorch, or exported, without.

    Example::

        pipeline = open_pipeline(AnimationOptions(checkpoint="demo/puppet.ckpt", identity="F1"))
        pipeline.write(read_recording(Path("speech.wav")), "speech", Path("speech.mp4"), ExportOptions())
    """
    if is_audio2face(options.checkpoint):
        from facediff.pipelines.audio2face import Audio2FacePipeline

        return Audio2FacePipeline(options)
    if is_exported(options.checkpoint):
        from facediff.pipelines.exported import ExportedPipeline

        return ExportedPipeline(options)
    from facediff.pipelines.trained import TrainedPipeline

    return TrainedPipeline(options)
