"""A trained model as Python uses it: loaded from anywhere, it animates recordings, arrays and streams of speech.

From top to bottom: :func:`load`; :class:`Animator`, whose methods are what the command line can do with a model; and
what speech may be given as.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, Unpack, cast, overload

from facediff.animation.options import (
    AnimateKeywords,
    AnimationOptions,
    RecordingKeywords,
    StreamKeywords,
    with_options,
)
from facediff.errors import FaceDiffError
from facediff.pipelines.animate import AnimationPipeline, check_options, check_speech, read_recording, usable_device
from facediff.pipelines.motion import Animation, Samples
from facediff.pipelines.words import in_python_words
from facediff.utils import SAMPLE_RATE
from facediff.utils.hub import EXPECTED, check_model_source
from facediff.utils.licences import Commercial, commercial_use, in_words
from facediff.utils.limits import LIMITS, SAMPLE_RATES, check_number

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from torch import Tensor

    from facediff.models import AnimationModel
    from facediff.models.styles import StyleLike

FULL_SCALE = {"uint8": (128.0, 128), "int16": (32768.0, 0), "int32": (2.0**31, 0)}
"""What whole numbers are divided by to get a full scale of 1, and where they have silence; as .wav files hold them."""

if TYPE_CHECKING:
    Waveform: TypeAlias = npt.NDArray[np.generic] | Tensor
    Speech: TypeAlias = str | Path | Waveform | tuple[Waveform, int] | tuple[int, Waveform]


@in_python_words
def load(source: str | Path, device: str = "auto", commercial_only: bool = False) -> Animator:
    """A trained model, ready to animate.

    Args:
        source: a checkpoint (.ckpt), a model folder that ``facediff publish`` has written, or ``user/name[@revision]``
            of the Hugging Face hub.
        device: where it computes: cpu, cuda …; ``auto`` for a CUDA device where there is one.
        commercial_only: refuse a model whose licence labels do not allow commercial use.

    Raises:
        FaceDiffError: if there is no such model, it cannot be read, its licence is refused, or the device cannot be
            used.

    Example:
        >>> model = facediff.load("demo/puppet.ckpt")  # doctest: +SKIP
        >>> model.animate("speech.wav", identity="F1").save("speech.mp4")  # doctest: +SKIP
        [PosixPath('speech.mp4')]
    """
    if not isinstance(source, str | Path):
        raise FaceDiffError(f"source: is of the type {type(source).__name__}; {EXPECTED}")
    check_model_source(source)  # before torch is imported
    from facediff.models import load_model

    return Animator(load_model(source, usable_device(device), commercial_only=commercial_only), source)


@in_python_words
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

    first = Path(paths) if isinstance(paths, str | Path) else Path(next(iter(paths)))
    return Animator(import_model(paths, **options).to(usable_device(device)), first)


class Animator:
    """A trained model: ``model.animate("speech.wav", identity="F1")`` makes an animation.

    Every method leaves the model as it was: what is chosen for one call does not change the next one.

    Args:
        module: the model as a LightningModule, in evaluation mode, with the assets of its corpus.
        source: the file, folder or name of the hub that it comes from, for the metadata of animations; the name of its
            class if None.

    Attributes:
        module: the LightningModule.
        source: as given.
    """

    def __init__(self, module: AnimationModel, source: str | Path | None = None) -> None:
        self.module = module.eval()
        self.source = type(module).__name__ if source is None else source

    @property
    def identities(self) -> list[str]:
        """The identities that it was trained on; the first one is the default."""
        return list(self.module.identities)

    @property
    def other_identities(self) -> list[str]:
        """Further identities whose face it knows, and whose motion it was not trained on."""
        return sorted({*self.module.assets.templates} - {*self.module.identities})

    @property
    def frame_rate(self) -> float:
        """Frames a second of its animations."""
        return self.module.frame_rate

    @property
    def unit(self) -> str:
        """Unit of length of its animations."""
        return self.module.assets.unit

    @property
    def n_vertices(self) -> int:
        """Vertices of its faces."""
        return self.module.n_vertices

    @property
    def corpus(self) -> str:
        """The corpus that it was trained on."""
        assets = self.module.assets
        return f"{assets.corpus} (synthetic)" if assets.synthetic else assets.corpus

    @property
    def licence(self) -> str:
        """The licences of its data and its weights, in a line; see docs/publishing.md."""
        return in_words(self.module.licences)

    @property
    def commercial_use(self) -> Commercial:
        """Whether the strictest of its licences allows commercial use: allowed, forbidden or unknown."""
        return commercial_use(self.module.licences)

    @property
    def device(self) -> str:
        """Where it computes."""
        return str(self.module.device)

    @overload
    def animate(
        self,
        speech: Speech,
        rate: float | None = None,
        *,
        samples: Literal[1] = 1,
        name: str | None = None,
        progress: bool = False,
        **options: Unpack[RecordingKeywords],
    ) -> Animation: ...

    @overload
    def animate(
        self,
        speech: Speech,
        rate: float | None = None,
        *,
        samples: int,
        name: str | None = None,
        progress: bool = False,
        **options: Unpack[RecordingKeywords],
    ) -> Animation | Samples: ...

    @in_python_words
    @with_options(AnimationOptions, AnimateKeywords)
    def animate(
        self,
        speech: Speech,
        rate: float | None = None,
        *,
        name: str | None = None,
        progress: bool = False,
        **options: Any,
    ) -> Animation | Samples:
        """Animate a face with speech. The keywords are the options of ``facediff animate``.

        Args:
            speech: a recording's path (wav, flac, ogg, mp3 or a video); samples as an array or a tensor, (S,) or with
                several channels, in floating point with full scale 1 or in whole numbers with theirs; or a pair of
                samples and their rate, as soundfile, librosa and torchaudio read them.
            rate: sample rate of an array; that of a tensor is 16 kHz if None.
            name: the animation's name; the recording's if None.
            progress: whether there is a progress bar.
            options: listed below.

        Returns:
            the animation, or a list of them where ``samples`` is not 1.

        Raises:
            FaceDiffError: naming what is wrong with the speech or an option.
        """
        chosen = AnimationOptions(checkpoint=self.source, device=self.device, quiet=not progress, **options)
        check_options(chosen)
        samples_of_speech, usual_name = speech_of(speech, rate, chosen.max_seconds)
        with self.module.choosing():
            pipeline = AnimationPipeline(chosen, model=self.module)
            seed = chosen.seed or 0
            with pipeline.samples(samples_of_speech, name or usual_name, None, seed=seed) as made:
                animations = [
                    Animation.of(pipeline.finished(animation, seed + number)) for number, animation in enumerate(made)
                ]
        return animations[0] if chosen.samples == 1 else Samples(animations)

    @in_python_words
    @with_options(AnimationOptions, StreamKeywords)
    def stream(
        self, chunks: Iterable[Waveform | bytes], rate: int = SAMPLE_RATE, **options: Unpack[StreamKeywords]
    ) -> Iterator[npt.NDArray[np.float32]]:
        """Animate speech of any length while it arrives, as ``facediff animate --stream`` does.

        The frames are those of the recording as a whole by windows, however the speech is cut into chunks.

        Args:
            chunks: pieces of mono speech: arrays or tensors (n,), or bytes of 16-bit samples (little endian).
            rate: their sample rate.
            options: listed below; of ``direction``, keys of blinks, gaze and sway need the whole animation.

        Yields:
            absolute vertices (m, V, 3) of the next frames, as soon as these are certain.

        Raises:
            FaceDiffError: naming what is wrong with an option or a chunk.

        Example:
            >>> for frames in model.stream(microphone(), identity="F1"):  # doctest: +SKIP
            ...     show(frames)
        """
        from facediff.pipelines.stream import LiveAnimation

        rate = int(check_number("speech", "rate", rate, *SAMPLE_RATES, whole=True, remedy="give the rate in Hz"))
        chosen = AnimationOptions(checkpoint=self.source, device=self.device, **options)
        check_options(chosen)
        with self.module.choosing():
            live = LiveAnimation(AnimationPipeline(chosen, model=self.module), rate=rate)

        def frames() -> Iterator[npt.NDArray[np.float32]]:
            heard = False
            for chunk in chunks:
                piece = mono(chunk)
                heard = heard or bool(len(piece))
                part = live.feed(piece)
                if len(part):
                    yield part
            if heard and len(part := live.finish()):
                yield part

        return frames()

    @in_python_words
    def extract_style(
        self, clips: StyleLike | Sequence[str | Path | Animation], *, identity: str | None = None
    ) -> npt.NDArray[np.float32]:
        """The style vector (S,) of clips, their mean if there are several; :meth:`animate` takes it as ``style``.

        Args:
            clips: motion of one speaker: names of clips, files, animations or arrays; one, or a list of them.
            identity: whose motion it is, where nothing else says it; the first one trained on if None.

        Raises:
            FaceDiffError: if a clip cannot be read, is a style vector already, or the model has no style.
        """
        from facediff.models.styles import extract_style

        given: list[StyleLike] = list(clips) if isinstance(clips, list | tuple) else [cast("StyleLike", clips)]
        vector = extract_style(given, identity or self.identities[0], self.module)
        if not len(vector):
            raise FaceDiffError(f"{self.source}: was trained without a dynamic style, so it has no style vectors")
        return vector.numpy()

    def save_pretrained(
        self,
        folder: str | Path,
        *,
        half: bool = False,
        license: str | None = None,  # noqa: A002 - the hub's word
        **card: Any,  # noqa: ANN401
    ) -> Path:
        """Write the model as a folder that :func:`facediff.load` reads, to be handed to others or sent to the hub.

        Args:
            folder: a folder that does not exist, or is empty.
            half: store the parameters in 16 bits; the motion differs a little.
            license: licence of the weights, such as ``apache-2.0``; that of the data if None.
            card: ``name``, ``scores`` (test_scores.csv of ``facediff test``) and ``languages`` for the model card.

        Raises:
            FaceDiffError: if the folder is not empty or cannot be written.
        """
        return self.module.save_pretrained(folder, half=half, license=license, **card)

    def __repr__(self) -> str:
        known = f"identities {', '.join(self.identities)}"
        known += f" (not trained on: {', '.join(self.other_identities)})" if self.other_identities else ""
        return (
            f"Animator({str(self.source)!r}: {type(self.module).__name__} of {self.corpus}, {known}, "
            f"{self.frame_rate:g} frames a second, {self.n_vertices} vertices in {self.unit}, on {self.device}; "
            f"{self.licence})"
        )


def speech_of(
    speech: Speech, rate: float | None = None, max_seconds: float | None = None
) -> tuple[npt.NDArray[np.float32], str]:
    """Speech (S,) at 16 kHz and its name, from whatever speech may be given as; see :meth:`Animator.animate`.

    Raises:
        FaceDiffError: naming the file or the argument, if it is nothing of that kind, or lasts too short or too long.
    """
    if isinstance(speech, str | Path):
        if rate is not None:
            raise FaceDiffError(f"rate {rate:g}: belongs to an array, and {speech} says its own; omit it")
        return read_recording(Path(speech), max_seconds), Path(speech).stem
    import torch

    from facediff.speech.audio import to_speech

    if isinstance(speech, tuple):
        if rate is not None or len(speech) != 2:
            raise FaceDiffError("speech: expected samples and their rate, as a pair or as speech and rate=")
        first, second = speech
        speech, rate = (second, first) if isinstance(first, int | float) else (first, second)  # type: ignore[assignment]
    if rate is None:
        if not isinstance(speech, torch.Tensor):
            raise FaceDiffError("rate: is missing; give the array's sample rate, as in animate(samples, rate=48000)")
        rate = SAMPLE_RATE
    rate = check_number("speech", "rate", rate, *SAMPLE_RATES, remedy="give the rate in Hz")
    samples = waveform(speech, "speech")  # type: ignore[arg-type]
    seconds = len(samples) / rate
    if max_seconds is not None and seconds > max_seconds:
        raise FaceDiffError(
            f"speech: lasts {seconds:.0f} s, more than max_seconds {max_seconds:g}; cut it or raise the limit"
        )
    LIMITS.check("seconds", seconds, "speech")
    made = to_speech(samples, rate, "speech")
    check_speech(made, "speech")
    return made, "speech"


def waveform(samples: Waveform, name: str) -> npt.NDArray[np.float32]:
    """Samples (S,) with full scale 1 from an array or a tensor; channels, along the shorter axis, are averaged.

    Raises:
        FaceDiffError: naming ``name``, if it holds no samples or is of another kind.
    """
    import numpy as np
    import torch

    if isinstance(samples, torch.Tensor):
        samples = samples.detach().cpu()
        samples = samples.float() if samples.is_floating_point() else samples  # NumPy has no bfloat16
    array = np.asarray(samples)
    scale = FULL_SCALE.get(array.dtype.name)
    if (array.dtype.kind != "f" and scale is None) or array.ndim not in (1, 2) or not array.size:
        raise FaceDiffError(
            f"{name}: is {array.dtype} of shape {array.shape}; expected samples (S,) or (S, channels) in floating "
            f"point, int16, int32 or uint8, or the path of a recording"
        )
    with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, and is refused
        plain = (
            array.astype(np.float32)
            if scale is None
            else ((array.astype(np.float64) - scale[1]) / scale[0]).astype(np.float32)
        )
    if plain.ndim == 2:
        plain = plain.mean(axis=int(np.argmin(plain.shape)))
    return plain


def mono(chunk: Waveform | bytes) -> npt.NDArray[np.float32]:
    """A piece (n,) of a stream, which may be empty.

    Raises:
        FaceDiffError: if it has several channels, holds samples that are not finite, or is of another kind.
    """
    import numpy as np

    if isinstance(chunk, bytes):
        from facediff.speech.pcm import samples_of

        if len(chunk) % 2:
            raise FaceDiffError(f"chunks: one has {len(chunk)} bytes, half a sample too much; give 16-bit samples")
        return samples_of(chunk)
    if np.ndim(chunk) != 1:
        raise FaceDiffError(f"chunks: one has the shape {np.shape(chunk)}; expected mono samples (n,)")
    if not len(chunk):
        return np.zeros(0, np.float32)
    samples = waveform(chunk, "chunks")
    if not np.isfinite(samples).all():
        raise FaceDiffError("chunks: one holds samples that are not finite numbers; give a full scale of 1")
    return samples
