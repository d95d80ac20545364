"""A model as Python uses it: loaded from anywhere, it animates recordings, arrays and streams of speech.

From top to bottom: :func:`load`; :class:`Animator`, which is the same for every model; and its backends, models with
PyTorch, exported ones and folders of Audio2Face-3D.
"""

from __future__ import annotations

import numbers
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, Unpack, cast, overload

from facediff.animation import Animation
from facediff.animation.options import (
    AnimateKeywords,
    AnimationOptions,
    RecordingKeywords,
    StreamKeywords,
    with_options,
)
from facediff.errors import FaceDiffError, OptionError, check_known, refuse_idle
from facediff.pipelines.animate import AnimationPipeline, check_options
from facediff.pipelines.motion import Samples
from facediff.pipelines.video_styles import with_video_styles
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import check_number
from facediff.utils.hub import check_animating_source, is_audio2face, is_exported, model_or_bundled
from facediff.utils.licences import Commercial, commercial_use, in_words
from facediff.utils.limits import SAMPLE_RATES
from facediff.utils.paths import from_home

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    import torch

    from facediff.animation.options import StyleLike
    from facediff.models import AnimationModel
    from facediff.pipelines.animate import Progress
    from facediff.pipelines.audio2face import Part
    from facediff.runtime import RuntimeModel
    from facediff.runtime.audio2face import Audio2Face
    from facediff.speech.audio import Speech, Waveform

    DType = str | torch.dtype

PRECISIONS: dict[str, Literal["32", "bf16"]] = {"float32": "32", "bfloat16": "bf16"}
"""What ``precision`` is called by PyTorch."""


def load(
    source: str | Path | None = None, device: str = "auto", commercial_only: bool = False, dtype: DType = "float32"
) -> Animator:
    """A model, ready to animate.

    Args:
        source: a checkpoint (.ckpt), a model folder that ``facediff publish`` has written, ``user/name[@revision]`` of
            the Hugging Face hub, or a folder of ``facediff export-model`` or of Audio2Face-3D, which need no PyTorch;
            ``puppet`` or None for the model that comes with facediff.
        device: where it computes: cpu, cuda …; ``auto`` for a CUDA device where there is one.
        commercial_only: refuse a model unless its licence labels allow commercial use.
        dtype: in which it multiplies, float32 or bfloat16.

    Raises:
        FaceDiffError: if there is no such model, it cannot be read, its licence is refused, or the device cannot be
            used.

    Example:
        >>> model = facediff.load("demo/puppet.ckpt")  # doctest: +SKIP
        >>> model.animate("speech.wav", identity="F1").save("speech.mp4")  # doctest: +SKIP
        [PosixPath('speech.mp4')]
    """
    path: str | Path = model_or_bundled(source)
    if is_exported(path):
        options = AnimationOptions(
            checkpoint=path, device=device, commercial_only=commercial_only, precision=precision_of(dtype)
        )
        if is_audio2face(path):
            from facediff.pipelines.audio2face import Audio2FacePipeline

            return Audio2FaceAnimator(Audio2FacePipeline(options).model, path)
        from facediff.pipelines.exported import ExportedPipeline

        return Animator(ExportedPipeline(options).model, path)
    check_animating_source(path)  # before torch is imported
    from facediff.models import load_model
    from facediff.pipelines.trained import usable_device

    module = load_model(path, usable_device(device), commercial_only=commercial_only)
    return Animator(module, path, dtype=dtype)


def import_checkpoint(
    paths: str | Path | Sequence[str | Path],
    *,
    device: str = "auto",
    **options: Any,  # noqa: ANN401
) -> Animator:
    """An author's checkpoint of a published method (FaceFormer, FaceDiffuser …) as a model, ready to animate.

    Args:
        paths: the file, or the files of a method with several stages.
        device: as :func:`load` takes it.
        options: fields of :class:`~facediff.models.published.import_options.ImportOptions`, such as ``templates``; and
            options of the model or its audio encoder, such as ``num_heads=4``.

    Raises:
        FaceDiffError: if a file cannot be read, is of no known method, or lacks something that is not given.

    Example:
        >>> model = facediff.import_checkpoint("vocaset.pth", templates="templates.pkl")  # doctest: +SKIP
        >>> model.animate("speech.wav", condition=model.identities[2]).save("speech.npy")  # doctest: +SKIP
        [PosixPath('speech.npy')]
    """
    from facediff.models import import_checkpoint as import_model
    from facediff.pipelines.trained import usable_device

    paths = [from_home(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    first = Path(paths[0])
    return Animator(import_model(paths, **options).to(usable_device(device)), first)


class Backend(ABC):
    """A kind of model under an :class:`Animator`, with its facts."""

    identities: list[str]
    other_identities: list[str]
    frame_rate: float
    unit: str
    n_vertices: int
    corpus: str
    licence: str
    commercial_use: Commercial
    device: str = "cpu"

    @abstractmethod
    def open(self, options: AnimationOptions) -> AbstractContextManager[AnimationPipeline]:
        """The model with its choices made, for as long as the context lasts."""

    def extract_style(self, clips: list[StyleLike], identity: str) -> npt.NDArray[np.float32]:
        """The mean style vector (S,) of clips; empty where the model has none."""
        import numpy as np

        return np.zeros(0, np.float32)


class TrainedBackend(Backend):
    """A LightningModule with the assets of its corpus; it is in evaluation mode while it animates."""

    def __init__(self, module: AnimationModel) -> None:
        self.module, assets = module, module.assets
        self.identities = list(module.identities)
        self.other_identities = sorted({*assets.templates} - {*module.identities})
        self.frame_rate, self.unit, self.n_vertices = module.frame_rate, assets.unit, module.n_vertices
        self.corpus = f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus
        self.licence, self.commercial_use = in_words(module.licences), commercial_use(module.licences)

    @property
    def device(self) -> str:  # type: ignore[override]
        """Where it computes."""
        return str(self.module.device)

    @contextmanager
    def open(self, options: AnimationOptions) -> Iterator[AnimationPipeline]:
        """The model with its choices made, which are forgotten at the end of the context."""
        from facediff.pipelines.trained import TrainedPipeline

        with self.module.choosing():
            yield TrainedPipeline(options, model=self.module)

    def extract_style(self, clips: list[StyleLike], identity: str) -> npt.NDArray[np.float32]:
        """The mean style vector (S,) of clips; empty where the model has none."""
        from facediff.models.styles import extract_style

        with self.module.choosing():
            return extract_style(clips, identity, self.module).numpy()


class ExportedBackend(Backend):
    """An open folder of ``facediff export-model``, without PyTorch."""

    def __init__(self, model: RuntimeModel) -> None:
        self.model, about = model, model.description
        self.identities = about.known
        self.other_identities = [name for name in about.faces if name not in self.identities]
        self.frame_rate, self.unit, self.n_vertices = model.frame_rate, about.unit, model.arrays["templates"].shape[1]
        self.corpus = f"{about.corpus} (synthetic)" if about.synthetic else about.corpus
        self.licence = about.licences.get("licence", "")
        self.commercial_use = cast("Commercial", about.licences.get("commercial_use", "unknown"))

    @contextmanager
    def open(self, options: AnimationOptions) -> Iterator[AnimationPipeline]:
        """The model with its choices made."""
        from facediff.pipelines.exported import ExportedPipeline

        yield ExportedPipeline(options, model=self.model)

    def extract_style(self, clips: list[StyleLike], identity: str) -> npt.NDArray[np.float32]:
        """The mean style vector (S,) of clips; empty where the model has none."""
        import numpy as np

        from facediff.runtime.styles import style_from

        if self.model.description.style_source != "reference":
            return super().extract_style(clips, identity)
        return np.mean([style_from(clip, self.model, identity).vector for clip in clips], axis=0, dtype=np.float32)


class Audio2FaceBackend(Backend):
    """An open folder of Audio2Face-3D, without PyTorch."""

    def __init__(self, model: Audio2Face) -> None:
        from facediff.pipelines.audio2face import FRAME_RATE, UNIT, licences_of

        self.model, facts = model, model.folder.facts
        self.identities, self.other_identities = [facts.actor or "actor"], []
        self.frame_rate, self.unit, self.n_vertices = FRAME_RATE, UNIT, facts.skin_vertices
        self.corpus = "Audio2Face-3D"
        self.licence, self.commercial_use = in_words(licences_of(model)), commercial_use(licences_of(model))

    @contextmanager
    def open(self, options: AnimationOptions) -> Iterator[AnimationPipeline]:
        """The model with its choices made."""
        from facediff.pipelines.audio2face import Audio2FacePipeline

        yield Audio2FacePipeline(options, model=self.model)


class Animator:
    """A model: ``model.animate("speech.wav", identity="F1")`` makes an animation.

    Every method leaves the model as it was: an option of one call does not change the next one.

    Args:
        model: the model as a LightningModule with the assets of its corpus, or an open exported folder.
        source: the file, folder or name of the hub that it comes from, for the metadata of animations; the name of its
            class if None.
        dtype: in which it multiplies where a call does not choose, float32 or bfloat16.

    Attributes:
        model: the LightningModule, or the open folder.
        identities: those that it was trained on; the first one is the default.
        other_identities: further ones with a known face, without motion in the training data.
        frame_rate: frames a second of its animations; of Audio2Face-3D it may be set.
        unit: unit of length of its animations.
        n_vertices: vertices of its faces.
        corpus: that it was trained on.
        licence: the licences of its data and its weights, in a line; see docs/publishing.md.
        commercial_use: whether the strictest of them allows commercial use: allowed, forbidden or unknown.
    """

    def __init__(
        self,
        model: AnimationModel | RuntimeModel | Audio2Face,
        source: str | Path | None = None,
        *,
        dtype: DType = "float32",
    ) -> None:
        precision_of(dtype)  # refuses other types
        self.model: Any = model
        self.backend = facts = backend_of(model)
        self.identities, self.other_identities = facts.identities, facts.other_identities
        self.frame_rate, self.unit, self.n_vertices = facts.frame_rate, facts.unit, facts.n_vertices
        self.corpus, self.licence, self.commercial_use = facts.corpus, facts.licence, facts.commercial_use
        self.source = type(model).__name__ if source is None else source
        self.dtype = str(dtype).removeprefix("torch.")

    @property
    def module(self) -> AnimationModel:
        """The LightningModule of a trained model."""
        return cast("AnimationModel", self.model)

    @property
    def device(self) -> str:
        """Where it computes: without PyTorch, on the processor."""
        return self.backend.device

    def to(self, device: str, dtype: DType | None = None) -> Self:
        """Move the model: ``model.to("cuda")``.

        Args:
            device: cpu, cuda …; ``auto`` for a CUDA device where there is one.
            dtype: in which it multiplies from now on, float32 or bfloat16; as before if None.

        Returns:
            the model itself.

        Raises:
            FaceDiffError: if the device cannot be used.
        """
        from facediff.pipelines.trained import usable_device

        if dtype is not None:
            precision_of(dtype)
            self.dtype = str(dtype).removeprefix("torch.")
        self.module.to(usable_device(str(device)))
        return self

    @overload
    def animate(
        self,
        speech: Speech,
        rate: float | None = None,
        *,
        samples: Literal[1] = 1,
        name: str | None = None,
        progress: bool | Progress = False,
        dtype: DType | None = None,
        **options: Unpack[RecordingKeywords],
    ) -> Animation: ...

    @overload
    def animate(
        self,
        speech: Speech | list[Any],
        rate: float | None = None,
        *,
        name: str | None = None,
        progress: bool | Progress = False,
        dtype: DType | None = None,
        **options: Unpack[AnimateKeywords],
    ) -> Any: ...  # noqa: ANN401 - Samples where there are several, lists of several recordings

    @with_options(AnimationOptions, AnimateKeywords)
    def animate(
        self,
        speech: Any,
        rate: float | None = None,
        *,
        name: str | None = None,
        progress: bool | Progress = False,
        dtype: DType | None = None,
        **options: Any,
    ) -> Animation | Samples | list[Animation | Samples]:
        """Animate a face with speech. The keywords are the options of ``facediff animate``.

        Args:
            speech: a recording's path (wav, flac, ogg, mp3 or a video) or an open sound file; samples as an array or a
                tensor, (S,) or with several channels, in floating point with full scale 1 or in whole numbers with
                theirs; a pair of samples and their rate, as soundfile, librosa and torchaudio read them; the audio of a
                Hugging Face data set, ``{"array", "sampling_rate"}`` or ``{"bytes", "path"}``; or several recordings:
                a list of any of these, or a folder.
            rate: sample rate of an array; of a tensor 16 kHz if None.
            name: the animation's name; the recording's if None.
            progress: whether there is a progress bar; or a function that is called with the progress and the total.
            dtype: in which the model multiplies, ``float32`` or ``bfloat16``, or PyTorch's of that name; as the
                model if None. The same as ``precision`` 32 or bf16.
            options: listed below. With ``seed=None``, the seed is drawn at random; the metadata names it.

        Returns:
            the animation; a list of them (:class:`Samples`) where ``samples`` is not 1; and for several recordings a
            list with what each of them alone would give.

        Raises:
            FaceDiffError: naming the fault of the speech or of an option.
        """
        settings = self._options(dtype, quiet=progress is not True, **options)
        recordings = recordings_of(speech)
        if recordings is not None:
            refuse_idle(
                "is for one recording",
                alignment=settings.alignment is not None,
                name=name is not None,
            )
        from facediff.speech.audio import speech_of

        animations: list[Animation | Samples] = []
        with self.backend.open(settings) as pipeline:
            pipeline.progress = None if isinstance(progress, bool) else progress
            for recording in [speech] if recordings is None else recordings:
                recording_speech = speech_of(recording, rate, settings.max_seconds)
                with pipeline.animations(replace(recording_speech, name=name or recording_speech.name)) as samples:
                    animations.append(samples[0] if settings.samples == 1 else Samples(samples))
        return animations[0] if recordings is None else animations

    @with_options(AnimationOptions, StreamKeywords)
    def stream(
        self,
        chunks: Iterable[Waveform | bytes],
        rate: int = SAMPLE_RATE,
        *,
        dtype: DType | None = None,
        **options: Unpack[StreamKeywords],
    ) -> Iterator[npt.NDArray[np.float32]]:
        """Animate speech of any length while it arrives, as ``facediff animate --stream`` does.

        The frames equal the windows of the whole recording, however the speech is cut into chunks.

        Args:
            chunks: pieces of mono speech: arrays or tensors (n,), or bytes of 16-bit samples (little endian).
            rate: their sample rate.
            dtype: as :meth:`animate` takes it.
            options: listed below; of ``direction``, keys of blinks, gaze and sway need the whole animation.

        Yields:
            absolute vertices (m, V, 3) of the next frames, as soon as these are certain.

        Raises:
            FaceDiffError: naming the fault of an option or of a chunk.

        Example:
            >>> for frames in model.stream(microphone(), identity="F1"):  # doctest: +SKIP
            ...     show(frames)
        """
        from facediff.speech.audio import stream_piece

        rate = int(check_number("speech", "rate", rate, *SAMPLE_RATES, whole=True, remedy="give the rate in Hz"))
        settings = self._options(dtype, **options)
        with self.backend.open(settings) as pipeline:
            stream = pipeline.stream(rate)

        def frames() -> Iterator[npt.NDArray[np.float32]]:
            received = False
            for chunk in chunks:
                piece = stream_piece(chunk)
                received = received or bool(len(piece))
                vertices = stream.feed(piece)
                if len(vertices):
                    yield vertices
            if received and len(vertices := stream.finish()):
                yield vertices

        return frames()

    def _options(self, dtype: DType | None, **options: Any) -> AnimationOptions:  # noqa: ANN401 - its fields
        precision = precision_of(self.dtype if dtype is None else dtype)
        if dtype is not None and options.get("precision", precision) != precision:
            raise OptionError("precision", f"contradicts dtype {dtype}; give one of them", options["precision"])
        options["style"] = with_video_styles(options.get("style"), lambda: self)
        if self.frame_rate != self.backend.frame_rate:
            options.setdefault("frame_rate", self.frame_rate)
        settings = AnimationOptions(checkpoint=self.source, **{"precision": precision, **options})
        check_options(settings)
        return settings

    def extract_style(
        self, clips: StyleLike | Sequence[str | Path | Animation], *, identity: str | None = None
    ) -> npt.NDArray[np.float32]:
        """The style vector (S,) of clips, their mean if there are several; :meth:`animate` takes it as ``style``.

        Args:
            clips: motion of one speaker: names of clips or styles, files, animations or arrays; one, or a list of them.
            identity: the speaker, unless the clips name it; the first one trained on if None.

        Raises:
            FaceDiffError: if a clip cannot be read, is a style vector already, or the model has no style.
        """
        listed = list(clips) if isinstance(clips, list | tuple) else [clips]
        references = [cast("StyleLike", with_video_styles(clip, lambda: self)) for clip in listed]
        vector = self.backend.extract_style(references, identity or self.identities[0])
        if not len(vector):
            raise FaceDiffError(f"{self.source}: was trained without a dynamic style, so it has no style vectors")
        return vector

    def save_pretrained(
        self,
        folder: str | Path,
        *,
        license: str | None = None,  # noqa: A002 - the hub's word
        name: str | None = None,
    ) -> Path:
        """Write a trained model as a folder that :func:`facediff.load` reads, for others or for the hub.

        Args:
            folder: a folder that does not exist, or is empty.
            license: licence of the weights, such as ``apache-2.0``; as the data if None.
            name: the model's name in the card; the folder's if None.

        Raises:
            FaceDiffError: if the folder is not empty or cannot be written.
        """
        return self.module.save_pretrained(folder, license=license, name=name)

    def __repr__(self) -> str:
        identities = f"identities {', '.join(self.identities)}"
        identities += f" (not trained on: {', '.join(self.other_identities)})" if self.other_identities else ""
        return (
            f"Animator({str(self.source)!r}: {type(self.model).__name__} of {self.corpus}, {identities}, "
            f"{self.frame_rate:g} frames a second, {self.n_vertices} vertices in {self.unit}, on {self.device}; "
            f"{self.licence})"
        )


def backend_of(model: AnimationModel | RuntimeModel | Audio2Face) -> Backend:
    """The backend for a model of any kind; none imports the libraries of the others."""
    from facediff.runtime.audio2face import Audio2Face
    from facediff.runtime.model import RuntimeModel

    if isinstance(model, RuntimeModel):
        return ExportedBackend(model)
    return Audio2FaceBackend(model) if isinstance(model, Audio2Face) else TrainedBackend(model)


class Audio2FaceAnimator(Animator):
    """A folder of Audio2Face-3D, with its blendshapes; ``style="joy:0.7,pain:0.2"`` says how strong each emotion is."""

    def solve(self, part: Part, vertices: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """NVIDIA's weights (T, K) of the folder's blendshapes for vertices.

        Args:
            part: of the face: ``skin`` or ``tongue``.
            vertices: absolute positions (T, V, 3) of all of its vertices.

        Raises:
            FaceDiffError: if the folder has no such shapes, or the vertices are others.
        """
        from facediff.pipelines.audio2face import solve_weights

        return solve_weights(self.model, part, vertices)


def precision_of(dtype: DType) -> Literal["32", "bf16"]:
    """The precision that a data type of PyTorch, or its name, stands for.

    Example:
        >>> precision_of("bfloat16")
        'bf16'
    """
    name = str(dtype).removeprefix("torch.")
    check_known("dtype", "precision", [name], PRECISIONS)
    return PRECISIONS[name]


def recordings_of(speech: Any) -> list[Any] | None:  # noqa: ANN401 - speech in any form
    """Several recordings, from a list or a folder; None for one recording."""
    speech = from_home(speech)
    if isinstance(speech, str | Path) and Path(speech).is_dir():
        from facediff.pipelines.folder import recordings

        return list(recordings([Path(speech)]))
    if not isinstance(speech, list) or (speech and all(isinstance(sample, numbers.Real) for sample in speech)):
        return None
    return speech
