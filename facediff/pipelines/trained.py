"""The pipeline for a model of any kind; and the one for a trained model, which generates with PyTorch.

Short speech is generated in one pass, long speech and streams by windows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facediff.animation.animation import WITHOUT_FACE
from facediff.animation.options import AnimationOptions
from facediff.errors import OptionError, refuse_idle
from facediff.pipelines.animate import AnimationPipeline, expressivity_of, read_scales
from facediff.registry import name_of
from facediff.spaces.rigs import LinearRig
from facediff.utils import SAMPLE_RATE
from facediff.utils.files import valid_text
from facediff.utils.hub import is_audio2face, is_exported, model_name
from facediff.utils.licences import licence_metadata

if TYPE_CHECKING:
    from facediff.data import Assets, Reference
    from facediff.editing.controls.direction import Direction
    from facediff.models import AnimationModel, Style
    from facediff.pipelines.directing import DirectedStream
    from facediff.pipelines.stages import Array
    from facediff.spaces.decoding import ChannelDecoder


def open_pipeline(options: AnimationOptions) -> AnimationPipeline:
    """The pipeline for the model that the options name: trained, with PyTorch, or exported, without.

    Example::

        pipeline = open_pipeline(AnimationOptions(checkpoint="demo/puppet.ckpt", identity="F1"))
        pipeline.write(read_recording(Path("speech.wav")), Path("speech.mp4"), ExportOptions())
    """
    if is_audio2face(options.checkpoint):
        from facediff.pipelines.audio2face import Audio2FacePipeline

        return Audio2FacePipeline(options)
    if is_exported(options.checkpoint):
        from facediff.pipelines.exported import ExportedPipeline

        return ExportedPipeline(options)
    return TrainedPipeline(options)


class TrainedPipeline(AnimationPipeline):
    """Animates recordings with a trained model."""

    takes_style_keys = True

    def __init__(self, options: AnimationOptions, *, model: AnimationModel | None = None) -> None:
        refuse_idle("is for an exported model", threads=bool(options.threads))
        if model is None:
            from facediff.models import load_model

            model = load_model(
                Path(options.checkpoint), usable_device(options.device), commercial_only=options.commercial_only
            )
        self.model = model
        if options.low_latency:
            model.choose_low_latency()
        if options.sampler is not None or options.steps is not None:
            model.choose_sampler(options.sampler, options.steps)
        if options.guidance is not None:
            model.choose_guidance(read_scales(options.guidance))
        model.windows = model.windows.chosen(options.window, options.overlap)
        self.identity = options.identity or model.identities[0]
        model.check_condition(options.condition)
        assets = self.assets = with_rig(model.assets)
        self.corpus = f"the checkpoint's corpus {assets.corpus}"
        face = facts_of(assets.mesh, self.identity)
        self.options, self.facts = options, face
        if options.expressivity is not None:
            self._choose_expressivity()
        self.style: Reference | Style | None = None
        if options.style is not None and not (isinstance(options.style, str) and not options.style):
            from facediff.models.styles import style_from

            self.style = style_from(options.style, self.identity, model, template=options.style_template)

        def rest_weights() -> Array:
            from facediff.editing.controls.expressiveness import rest_weights

            return rest_weights(face["template"], face["regions"])

        super().__init__(
            options,
            face=face,
            windows=model.windows,
            model=type(model).__name__,
            samples=model.samples,
            usual_gate=model.usual_gate,
            rest_weights=rest_weights,
            decoder=decoder_of(assets, self.identity),
        )
        steps = getattr(getattr(model, "sampler", None), "steps", 1)
        self.step_seconds *= steps * len(self.runs)

    def direct(self, direction: Direction | None) -> None:
        """Follow other keys over time from now on."""
        from facediff.pipelines.directing import plan_runs

        if direction is not None and self.style is not None:
            direction.refuse_both("style")
        self.runs = plan_runs(direction, self.model, self.identity, self.style, self.options.style_template)
        super().direct(direction)

    def frames_of(self, samples: int) -> int:
        """How many frames the model gives for so many samples of speech."""
        return self.model.frames_of(samples)

    def generate(self, speech: Array, seeds: Sequence[int]) -> tuple[int, Iterator[Sequence[Array]]]:
        """Frames, and absolute points: in one part for short speech, by windows for long speech."""
        if not self.windows.in_one_pass(self.frames_of(len(speech)), self.frame_rate):
            stream = self._directed(seeds)
            self.style_name = ", ".join(stream.style_names)
            parts = stream.parts(speech, progress=partial(self.track, description="seconds of speech"))
            return round(len(speech) * self.frame_rate / SAMPLE_RATE), map(list, parts)
        import torch

        audio, motions = torch.from_numpy(speech).to(self.model.device), []
        styles: dict[str, None] = {}
        for run in self.runs:
            with self.precision():
                samples = self.model.animate_samples(
                    audio,
                    identity=self.identity,
                    condition=self.options.condition,
                    style=run.style,
                    seeds=seeds,
                    progress=partial(self.track, description="sampling"),
                )
            motions.append(torch.stack([sample.vertices for sample in samples]))
            styles[samples[0].reference_name] = None
        self.style_name = ", ".join(styles)
        if len(self.runs) > 1:
            from facediff.pipelines.directing import blend

            motions = [blend(motions, self.runs, self.frame_rate)]
        return motions[0].shape[1], iter([[*motions[0].numpy()]])

    @property
    def stream_timing(self) -> tuple[float, float]:
        """As the model's own windows, where it has such."""
        return self.model.stream_timing or super().stream_timing

    def generator(self, seed: int) -> FirstSample:
        """The model at the beginning of a stream."""
        return FirstSample(self._directed([seed]))

    def metadata(self, seed: int) -> dict[str, str]:
        """What an animation says of the model and its choices."""
        assets, sampler = self.model.assets, getattr(self.model, "sampler", None)
        trained_on = assets.identity_index(self.identity) >= 0
        is_half = self.options.precision == "bf16"
        metadata = {
            "model": type(self.model).__name__,
            "checkpoint": valid_text(model_name(self.options.checkpoint)),
            "corpus": f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus,
            **licence_metadata(self.model.licences),
            "identity": self.identity if trained_on else f"{self.identity} (not trained on)",
            "style": self.style_name,
            "seed": str(seed),
            "precision": "bfloat16 and float32" if is_half else "float32",
        }
        if self.model.assets.rig is None and self.model.assets.space.kind not in ("vertices", "arkit"):
            metadata["face"] = WITHOUT_FACE
        if self.options.condition is not None:
            metadata["condition"] = self.options.condition
        if sampler is not None:
            metadata["sampler"] = f"{name_of(type(sampler))}, {sampler.steps} steps"
        return metadata

    def precision(self) -> AbstractContextManager[object]:
        """Within it the network multiplies in the precision asked for; noise and vertices stay as they are."""
        import torch

        return torch.autocast(self.model.device.type, torch.bfloat16, enabled=self.options.precision == "bf16")

    def _directed(self, seeds: Sequence[int]) -> DirectedStream:
        from facediff.pipelines.directing import DirectedStream

        return DirectedStream(
            self.model,
            self.runs,
            identity=self.identity,
            condition=self.options.condition,
            seeds=seeds,
            precision=self.precision,
        )

    def _choose_expressivity(self) -> None:
        """Take over the options' expressivity, which may differ between the face's regions."""
        from facediff.editing.controls.expressiveness import ALL, region_factors

        factors, name = expressivity_of(self.options), type(self.model).__name__
        if not self.model.samples:
            refuse_idle(
                f"{name} makes one animation and no samples around a mean", expressivity={*factors.values()} != {1.0}
            )
        if {*factors} == {ALL}:
            self.model.choose_expressivity(factors[ALL])
            return
        if not self.model.assets.space.is_vertices:
            raise OptionError(
                "expressivity",
                "regions are of vertices, and this model's motion is channels; give one number for all of it",
                self.options.expressivity,
            )
        import torch

        # A region's number fades into the rest as in expressiveness, so that no edge is visible.
        vertex_factors = region_factors(self.facts["template"], self.facts["regions"], factors, self.corpus)
        self.model.choose_expressivity(torch.from_numpy(vertex_factors).float())


class FirstSample:
    """The only sample of a stream with one seed."""

    def __init__(self, stream: DirectedStream) -> None:
        self._stream = stream

    @property
    def frames(self) -> int:
        """Frames that have been generated so far."""
        return self._stream.frames

    def feed(self, samples: Array) -> Array:
        """The frames (m, points, dims) that more speech (n,) at 16 kHz makes certain."""
        return self._stream.feed(samples)[0]

    def finish(self) -> Array:
        """The frames (m, points, dims) that are left."""
        return self._stream.finish()[0]


def with_rig(assets: Assets) -> Assets:
    """Assets with a rig that can be shown, where their channels have none.

    ARKit's channels get the shapes of the built-in face. Others, such as FLAME's without the user's model, get a point
    for each channel, so that their values can be written; such animations have no face to draw.
    """
    if assets.space.is_vertices or assets.rig is not None:
        return assets
    from facediff.data.batch import Rig
    from facediff.data.puppet import built_in_rig

    if assets.space.kind == "arkit":
        return replace(assets, rig=Rig.of(built_in_rig(), assets))
    names = tuple(assets.space.channels[channel] for channel in assets.space.face)
    points = np.zeros((len(names), 3))
    points[:, 0] = np.arange(len(names))
    moves = np.zeros((len(names), len(names), 3))
    moves[range(len(names)), range(len(names)), 1] = 1.0
    return replace(assets, rig=Rig.of(LinearRig(names, points, moves, None, "m", WITHOUT_FACE), assets))


def decoder_of(assets: Assets, identity: str) -> ChannelDecoder | None:
    """What turns a corpus's channels into the vertices of one of its speakers; None for a corpus of vertices."""
    if assets.space.is_vertices:
        return None
    from facediff.spaces.decoding import ChannelDecoder

    mesh, rig = assets.mesh, assets.rig
    assert rig is not None  # noqa: S101 - or assets.mesh would have raised
    return ChannelDecoder(
        assets.space,
        assets.template(identity).numpy()[:, 0],
        mesh.template(identity).numpy(),
        rig.deltas_of(identity).numpy(),
    )


def facts_of(assets: Assets, identity: str | None = None) -> dict[str, Any]:
    """A checkpoint's assets as :class:`facediff.animation.Animation` takes them.

    The neutral face and its colours belong to ``identity``, the first one trained on if None.
    """

    def array(value: object, kind: type) -> object:
        return None if value is None else np.asarray(value, kind)

    name = identity or assets.identities[0]
    return {
        "template": array(assets.template(name), np.float32),
        "faces": array(assets.faces, np.int32),
        "frame_rate": assets.frame_rate,
        "unit": assets.unit,
        "colours": array(assets.colours_of(name), np.uint8),
        "regions": {name: np.asarray(indices, np.int64) for name, indices in assets.regions.items()},
        "inner_lip_pairs": array(assets.inner_lip_pairs, np.int64),
    }


def on_processor(device: str) -> bool:
    """Whether a device is the processor, of which every process has a share."""
    import torch

    return device == "cpu" or (device == "auto" and not torch.cuda.is_available())


def usable_device(name: str, option: str = "device") -> str:
    """The device's name; ``auto`` is a CUDA device where there is one, and the processor elsewhere."""
    import torch

    if name == "auto":
        name = "cpu" if on_processor(name) else "cuda"
    try:
        # Memory is allocated and read back, which devices that exist in name only cannot do (meta).
        float(torch.ones(1, device=torch.device(name)).sum())
    except Exception as error:  # each backend raises its own, down to NotImplementedError and ImportError
        reason = next(iter(str(error).splitlines()), "")[:200]
        raise OptionError(option, f"not usable on this machine ({reason}); try {{{option}}} cpu", name) from error
    return name
