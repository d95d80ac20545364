"""Distil a trained model's audio encoder: for robustness to other voices, rooms and microphones, or for low latency.

**Robustness.** Training the whole model with augmented speech would teach it the same motion again for every voice,
which takes long and costs accuracy on clean speech. Here only the audio encoder is trained: from augmented speech, the
student must reproduce the features that the teacher, the encoder as it was, computes from the clean recording (Li,
Seltzer, Wang, Zhao and Gong 2017, "Large-scale domain adaptation via teacher-student learning"). A step costs a small
part of a training step, and no motion is needed. In the end the weights are interpolated between teacher and student,
which gives back most of the accuracy on clean speech and keeps most of the robustness (Wortsman et al. 2022, "Robust
fine-tuning of zero-shot models"). People's recordings are heard beside the corpus's, so that it knows their voices in
other rooms as well as the teacher knows them in their own.

**Low latency.** The student gets truncated speech, which ends a moment after a frame, and must reproduce the teacher's
features of the whole recording up to that end. Some pieces stay whole, so that recordings sound as before. The student
may be another, smaller encoder than the teacher (Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural
network"): HuBERT takes a fifth of a second for each frame of a stream.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from facediff.data import SpeechMotionDataModule
from facediff.data.augmentation import Augmenter, read_augmentations
from facediff.errors import FaceDiffError, OptionError, refuse_idle
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.base import AnimationModel
from facediff.speech.audio import read_speech
from facediff.speech.windows import QUIETEST, WindowPlan
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import USUAL_VOICE_STEPS
from facediff.utils.workers import processors

ROBUST_AUGMENTATIONS = (
    "voice:share=0.8,semitones=6,formants=0.22",
    "loudness:share=0.3",
    "room:share=0.6,seconds=0.8,direct=-4",
    "tilt:share=0.6",
    "band:share=0.25",
    "codec:share=0.1",
    "noise:share=0.7",
    "hum:share=0.1",
    "babble",
    "music",
)
"""Default augmentations of speech; see docs/voices.md."""

WINDOW = 4.0
"""Seconds of a clip in a batch, at most."""

STEP_RATE = 50
"""Features a second at which student and teacher are compared."""
LOW_LATENCY_WINDOW = (0.6, 1.7)
"""Seconds of speech that a low-latency student gets, at least and at most."""


MOST_RECORDINGS, LONGEST = 1200, 8.0
"""People's recordings that are used, of more so many are drawn, and seconds of each. They take 0.6 GB at most."""
SOUNDS = (".wav", ".flac", ".ogg", ".mp3")


@dataclass(frozen=True)
class DistillationOptions:
    """How an audio encoder is distilled.

    Attributes:
        augmentations: by name with their options, in the order in which they are applied.
        steps: training steps.
        batch_size: clips in a step.
        share: of the clips that are augmented; the others keep the student accurate on clean speech.
        extra_speech: how many pieces of further speech are used in addition to the clips, where the corpus has such
            (:meth:`facediff.data.SpeechMotionDataModule.further_speech`); they are drawn as often as the clips.
        interpolation: of the weights, from the teacher's (0) to the trained student's (1).
        learning_rate: the highest; it rises over the first twentieth of the steps and falls as a cosine.
        seed: of all random numbers.
        pauses: share of the pieces that get a pause, in which the background of augmented speech goes on, so that the
            student takes noise, music and babble for the teacher's silence.
        workers: processes that augment speech; 0 for this one.
        low_latency: the student gets the speech of the model's windows at low latency; the teacher the whole recording.
        complete_share: with ``low_latency``, the share of the pieces of which the student gets all the same everything.
        people: folder of people's recordings, which the teacher hears as they are; None for the corpus alone.
        recorded_share: of the pieces that are such recordings.
    """

    augmentations: Sequence[str] = ROBUST_AUGMENTATIONS
    steps: int = USUAL_VOICE_STEPS
    batch_size: int = 12
    share: float = 0.5
    extra_speech: int = 1200
    pauses: float = 0.4
    interpolation: float = 0.85
    learning_rate: float = 1e-3
    seed: int = 0
    workers: int = 1
    low_latency: bool = False
    complete_share: float = 0.3
    people: Path | None = None
    recorded_share: float = 0.4

    @property
    def goal(self) -> str:
        """The purpose of the adaptation, in words."""
        return "low latency" if self.low_latency else "other voices"


LOW_LATENCY_DISTILLATION = DistillationOptions(
    augmentations=(), share=0.5, pauses=0.2, interpolation=1.0, low_latency=True
)
"""How an audio encoder is distilled for low latency."""


class DistillationBatch(NamedTuple):
    """Speech of the teacher and of the student.

    Attributes:
        clean: the teacher's input (batch, samples).
        lengths: valid samples of each clip.
        student_input: the same speech, augmented, or a part of it with silence after it (batch, samples).
        student_lengths: valid samples of each piece of it.
        teacher_steps: the teacher's step that goes with each of the student's (batch, steps).
        steps: of the student's input.
        compared: the student's steps that are compared, as the first of each clip and the one after the last
            (batch, 2).
        mean: of each clip's speech as far as the student hears it; None without low latency.
        deviation: standard deviation of the same speech.
    """

    clean: Tensor
    lengths: Tensor
    student_input: Tensor
    student_lengths: Tensor
    teacher_steps: Tensor
    steps: Tensor
    compared: Tensor
    mean: Tensor | None = None
    deviation: Tensor | None = None

    def to(self, device: torch.device) -> DistillationBatch:
        """On a device."""
        return DistillationBatch(*(None if part is None else part.to(device) for part in self))  # type: ignore[arg-type]


def distil_audio_encoder(
    model: AnimationModel,
    data: SpeechMotionDataModule,
    options: DistillationOptions = DistillationOptions(),  # noqa: B008 - it cannot be changed
    step_done: Callable[[], object] = lambda: None,
    *,
    teacher: AudioEncoder | None = None,
) -> float:
    """Distil a trained model's audio encoder in place.

    Args:
        model: a trained model; its audio encoder is the student.
        data: the corpus; of its training clips, only the speech is used.
        options: how.
        step_done: called after each step.
        teacher: gives the features to reproduce; a copy of the student if None.

    Returns:
        the remaining error of the student's features, as a share of the teacher features' variance: the mean of the
        last tenth of the steps.
    """
    student = model.speech_encoder
    weights = [weight for weight in student.parameters() if weight.requires_grad]
    if not weights:
        raise FaceDiffError("audio_encoder: all of its weights are frozen; choose one that is trained, such as mel")
    if options.low_latency:
        refuse_idle("is an option of {voices}", people=options.people is not None)
    teacher = (copy.deepcopy(student) if teacher is None else teacher).to(model.device).eval().requires_grad_(False)
    before = [weight.detach().clone() for weight in weights]
    with model.choosing():
        if options.low_latency:
            model.choose_low_latency()
        windows = model.windows
    recordings = [] if options.people is None else read_recordings(options.people, options.seed)
    pairs = SpeechPairs(data, Augmenter(read_augmentations(options.augmentations)), options, windows, recordings)
    workers = min(options.workers, processors() - 1)
    loader = DataLoader(pairs, batch_size=None, num_workers=max(0, workers))
    optimiser = torch.optim.AdamW(weights, lr=options.learning_rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _rate(step, options.steps))
    errors: list[float] = []
    devices = [] if model.device.type == "cpu" else [model.device]
    # The caller's random numbers go on as if nothing had been drawn here.
    with torch.random.fork_rng(devices):
        torch.manual_seed(options.seed)
        student.train()
        for batch in loader:
            speech: DistillationBatch = batch.to(model.device)
            with torch.no_grad():
                target = teacher(speech.clean, speech.lengths, _steps(speech.lengths))
            error = _difference(_features(student, speech), *_compared(target, speech))
            optimiser.zero_grad()
            error.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(weights, 1.0)
            optimiser.step()
            schedule.step()
            errors.append(float(error.detach()))
            step_done()
    student.eval()
    with torch.no_grad():
        for weight, old in zip(weights, before, strict=True):
            # Between the old and the new weights (Wortsman et al. 2022, robust fine-tuning): most of the robustness,
            # and clean speech keeps nearly the old features, which the frozen rest of the model was trained with.
            weight.copy_(torch.lerp(old, weight, options.interpolation))
    return float(np.mean(errors[-max(1, options.steps // 10) :]))


def encoder_weights(model: AnimationModel) -> dict[str, Tensor]:
    """The weights of a model's audio encoder, by their names in its checkpoint."""
    name = next(name for name, module in model.named_modules() if module is model.speech_encoder)
    return {f"{name}.{key}": value.detach().cpu() for key, value in model.speech_encoder.state_dict().items()}


def _steps(samples: Tensor) -> Tensor:
    """Features of so many samples."""
    return (samples * STEP_RATE // SAMPLE_RATE).clamp_min(1)


def _features(student: AudioEncoder, speech: DistillationBatch) -> Tensor:
    """The student's features, standardised by the level of all speech so far as in a stream."""
    arguments = speech.student_input, speech.student_lengths, speech.steps
    if speech.mean is None or speech.deviation is None:
        features: Tensor = student(*arguments)
        return features
    with student.at_level(speech.mean[:, None], speech.deviation[:, None]):
        features = student(*arguments)
    return features


def _compared(target: Tensor, speech: DistillationBatch) -> tuple[Tensor, Tensor]:
    """The teacher's features of the student's steps, and True on the steps that are compared."""
    steps = speech.teacher_steps.clamp_max(target.shape[1] - 1)
    column = torch.arange(steps.shape[1], device=target.device)[None]
    first, last = speech.compared[:, :, None].unbind(1)
    mask = (column >= first) & (column < last)
    return target.gather(1, steps[..., None].expand(-1, -1, target.shape[2])), mask[..., None]


def _difference(features: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Squared difference of features (batch, steps, channels) as a share of their variance, over valid steps."""
    # Dividing by a tiny variance would let channels that carry hardly any information dominate the loss: the variance
    # counts as a twentieth of the mean one at least.
    count = mask.sum()
    mean = (target * mask).sum((0, 1)) / count
    variance = ((target - mean).square() * mask).sum((0, 1)) / count
    least = (variance.mean() / 20).clamp_min(1e-12)
    return (((features - target).square() * mask).sum((0, 1)) / count / variance.clamp_min(least)).mean()


def _rate(step: int, steps: int) -> float:
    """The share of the learning rate at a step."""
    rise = max(1, steps // 20)
    return (step + 1) / rise if step < rise else 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


class Piece(NamedTuple):
    """The student's part of a clip; see :class:`DistillationBatch`."""

    speech: npt.NDArray[np.float32]
    teacher_steps: npt.NDArray[np.int64]
    compared: tuple[int, int]
    mean: float
    deviation: float


class SpeechPairs(Dataset[DistillationBatch]):
    """Batches of clean speech with the student's version of it.

    A batch follows from its number and the seed, independently of the process that makes it.
    """

    def __init__(
        self,
        data: SpeechMotionDataModule,
        augmenter: Augmenter,
        options: DistillationOptions,
        windows: WindowPlan,
        recordings: Sequence[npt.NDArray[np.float32]] = (),
    ) -> None:
        # Not the data module itself, which may hold what cannot be pickled for a worker.
        self.corpus, self.clips, self.further_speech = data.corpus, data.clips("train"), data.further_speech()
        self.augmenter, self.options, self.windows, self.recordings = augmenter, options, windows, recordings
        self._further_pieces: dict[int, npt.NDArray[np.float32]] = {}

    def __len__(self) -> int:
        """Number of batches."""
        return self.options.steps

    def __getitem__(self, index: int) -> DistillationBatch:
        """A batch by number."""
        index = range(len(self))[index]
        random = np.random.default_rng([self.options.seed, index])
        clean, augmented, steps_of = [], [], []
        for _ in range(self.options.batch_size):
            speech = self._speech(random)
            if self.options.pauses and random.random() < self.options.pauses:
                speech = with_pause(speech, random)
            clean.append(speech)
            steps_of.append(np.arange(max(1, len(speech) * STEP_RATE // SAMPLE_RATE)))
            augmented.append(self._augmented(speech, random) if random.random() < self.options.share else speech)
        teacher = _padded(clean), _lengths(clean)
        if not self.options.low_latency:
            counts = _lengths(steps_of)
            compared = torch.stack([torch.zeros_like(counts), counts], 1)
            return DistillationBatch(
                *teacher, _padded(augmented), _lengths(augmented), _padded(steps_of), counts, compared
            )
        pieces = [self._piece(*clip, random) for clip in zip(augmented, map(len, steps_of), strict=True)]
        student, student_steps, *numbers = zip(*pieces, strict=True)
        return DistillationBatch(
            *(*teacher, _padded(student), _lengths(student), _padded(student_steps), _lengths(student_steps)),
            *map(torch.tensor, numbers),
        )

    def _piece(self, speech: npt.NDArray[np.float32], steps: int, random: np.random.Generator) -> Piece:
        """The speech of a window of low latency at a random time; now and then all of it."""
        size, windows = SAMPLE_RATE // STEP_RATE, self.windows
        if random.random() < self.options.complete_share:
            level = _level(speech.astype(np.float64))
            return Piece(speech[: steps * size], np.arange(steps), (0, steps), *level)
        after, ahead = (round(seconds * STEP_RATE) for seconds in (windows.after, windows.ahead))
        silent = max(0, ahead - after)
        end = int(random.integers(min(steps, after + 2), steps + 1))
        shortest, longest = (round(seconds * STEP_RATE) for seconds in LOW_LATENCY_WINDOW)
        start = max(0, end - int(random.integers(shortest, longest + 1)))
        mean, deviation = _level(speech[: end * size].astype(np.float64))
        # At the mean, which is silence once it is standardised, as in a stream.
        piece = np.pad(speech[start * size : end * size], (0, silent * size), constant_values=mean)
        # More than half a second before the frame, steps have enough context already, and would drown the error of the
        # hard ones. Where nothing is animated ahead, those within the look-ahead are context only.
        frame = end - after - start
        compared = (max(0, frame - STEP_RATE // 2), end - start if ahead else frame)
        return Piece(piece, np.arange(start, end + silent), compared, mean, deviation)

    def _speech(self, random: np.random.Generator) -> npt.NDArray[np.float32]:
        """A clip, a person's recording or a piece of further speech, or a random window of it."""
        if self.recordings and random.random() < self.options.recorded_share:
            return _window(self.recordings[int(random.integers(len(self.recordings)))], random)
        limit = max(1, round(WINDOW * self.corpus.frame_rate))
        if self.further_speech is not None and self.options.extra_speech and random.random() < 0.5:
            number = int(random.integers(self.options.extra_speech))
            if number not in self._further_pieces:
                self._further_pieces[number] = self.further_speech(number)
            return _window(self._further_pieces[number], random)
        clip = self.clips[int(random.integers(len(self.clips)))]
        frames = self.corpus.frames(clip)
        start = int(random.integers(frames - limit + 1)) if frames > limit else 0
        return self.corpus.read_audio(clip, start, min(frames, start + limit)).numpy()

    def _augmented(self, speech: npt.NDArray[np.float32], random: np.random.Generator) -> npt.NDArray[np.float32]:
        """Speech of the same length in another voice, another room or with noise."""
        return self.augmenter(speech, int(random.integers(2**31)))


def read_recordings(folder: Path, seed: int) -> list[npt.NDArray[np.float32]]:
    """People's recordings in any folders below one, (S,) at 16 kHz each."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SOUNDS)
    if not files:
        raise OptionError("people", "no recording there; expected .wav or .flac", folder)
    chosen = np.random.default_rng(seed).permutation(len(files))[:MOST_RECORDINGS]
    return [read_speech(files[number])[: round(LONGEST * SAMPLE_RATE)] for number in chosen]


def _window(speech: npt.NDArray[np.float32], random: np.random.Generator) -> npt.NDArray[np.float32]:
    """A random window of :data:`WINDOW` seconds at most."""
    size = round(WINDOW * SAMPLE_RATE)
    start = int(random.integers(max(1, len(speech) - size + 1)))
    return speech[start : start + size]


def with_pause(speech: npt.NDArray[np.float32], random: np.random.Generator) -> npt.NDArray[np.float32]:
    """Speech (S,) with a faint pause of 0.3 to 1.5 s, often at an end; what no longer fits is cut off."""
    count = min(round(random.uniform(0.3, 1.5) * SAMPLE_RATE), len(speech) // 2)
    start = round(float(np.clip(random.uniform(-0.3, 1.3), 0, 1)) * (len(speech) - count))
    pause = random.standard_normal(count).astype(np.float32) * float(np.abs(speech).max(initial=0)) * np.float32(1e-4)
    return np.concatenate([speech[:start], pause, speech[start : len(speech) - count]])


def _level(speech: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Mean and deviation as a stream takes them."""
    return float(speech.mean()), max(float(speech.std()), QUIETEST)


def _lengths(speech: Sequence[Any]) -> Tensor:
    return torch.tensor([len(clip) for clip in speech])


def _padded(speech: Sequence[Any]) -> Tensor:
    return nn.utils.rnn.pad_sequence([torch.from_numpy(clip) for clip in speech], batch_first=True)
