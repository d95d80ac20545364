"""Distil a trained model's audio encoder for robustness to other voices, rooms and microphones.

Training the whole model with augmented speech would teach it the same motion again for every voice,
which takes long and costs accuracy on clean speech. Here only the audio encoder is trained: from augmented speech, the
student must reproduce the features that the teacher, the encoder as it was, computes from the clean recording (Li,
Seltzer, Wang, Zhao and Gong 2017, "Large-scale domain adaptation via teacher-student learning"). A step costs a small
part of a training step, and no motion is needed. In the end the weights are interpolated between teacher and student,
which gives back most of the accuracy on clean speech and keeps most of the robustness (Wortsman et al. 2022, "Robust
fine-tuning of zero-shot models"). People's recordings are heard beside the corpus's, so that it knows their voices in
other rooms as well as the teacher knows them in their own.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from facediff.data import SpeechMotionDataModule
from facediff.data.augmentation import Augmenter, read_augmentations
from facediff.errors import FaceDiffError, OptionError
from facediff.models.base import AnimationModel
from facediff.models.layers import frame_mask
from facediff.speech.audio import RECORDINGS, read_speech
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import USUAL_VOICE_STEPS
from facediff.utils.workers import processors, torch_threads

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

MOST_RECORDINGS, LONGEST = 1200, 8.0
"""People's recordings that are used, of more so many are drawn, and seconds of each. They take 0.6 GB at most."""


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
    people: Path | None = None
    recorded_share: float = 0.4


class DistillationBatch(NamedTuple):
    """Speech (batch, samples) of the teacher, the same speech augmented, and valid samples of each clip."""

    clean: Tensor
    augmented: Tensor
    lengths: Tensor


def distil_audio_encoder(
    model: AnimationModel,
    data: SpeechMotionDataModule,
    options: DistillationOptions = DistillationOptions(),  # noqa: B008 - it cannot be changed
    step_done: Callable[[], object] = lambda: None,
) -> float:
    """Distil a trained model's audio encoder in place.

    Args:
        model: a trained model; its audio encoder is the student.
        data: the corpus; of its training clips, only the speech is used.
        options: how.
        step_done: called after each step.

    Returns:
        the remaining error of the student's features, as a share of the teacher features' variance: the mean of the
        last tenth of the steps.
    """
    student = model.speech_encoder
    weights = [weight for weight in student.parameters() if weight.requires_grad]
    if not weights:
        raise FaceDiffError("audio_encoder: all of its weights are frozen; choose one that is trained, such as mel")
    teacher = copy.deepcopy(student).eval().requires_grad_(False)
    before = [weight.detach().clone() for weight in weights]
    recordings = [] if options.people is None else read_recordings(options.people, options.seed)
    pairs = SpeechPairs(data, Augmenter(read_augmentations(options.augmentations)), options, recordings)
    workers = min(options.workers, processors() - 1)
    loader = DataLoader(pairs, batch_size=None, num_workers=workers)
    # A thread that shares its core with a worker keeps the others waiting: two on two cores take half as long again.
    threads = max(1, torch.get_num_threads() - workers)
    optimiser = torch.optim.AdamW(weights, lr=options.learning_rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _rate(step, options.steps))
    errors: list[float] = []
    devices = [] if model.device.type == "cpu" else [model.device]
    # The caller's random numbers go on as if nothing had been drawn here.
    with torch.random.fork_rng(devices), torch_threads(threads):
        torch.manual_seed(options.seed)
        student.train()
        for batch in loader:
            clean, augmented, lengths = (part.to(model.device) for part in batch)
            steps = (lengths * STEP_RATE // SAMPLE_RATE).clamp_min(1)
            with torch.no_grad():
                target = teacher(clean, lengths, steps)
            error = _difference(
                student(augmented, lengths, steps), target, frame_mask(steps, target.shape[1])[..., None]
            )
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


class SpeechPairs(Dataset[DistillationBatch]):
    """Batches of clean speech with the student's version of it.

    A batch follows from its number and the seed, independently of the process that makes it.
    """

    def __init__(
        self,
        data: SpeechMotionDataModule,
        augmenter: Augmenter,
        options: DistillationOptions,
        recordings: Sequence[npt.NDArray[np.float32]] = (),
    ) -> None:
        # Not the data module itself, which may hold what cannot be pickled for a worker.
        self.corpus, self.clips, self.further_speech = data.corpus, data.clips("train"), data.further_speech()
        self.augmenter, self.options, self.recordings = augmenter, options, recordings
        self._further_pieces: dict[int, npt.NDArray[np.float32]] = {}

    def __len__(self) -> int:
        """Number of batches."""
        return self.options.steps

    def __getitem__(self, index: int) -> DistillationBatch:
        """A batch by number."""
        index = range(len(self))[index]
        random = np.random.default_rng([self.options.seed, index])
        clean, augmented = [], []
        for _ in range(self.options.batch_size):
            speech = self._speech(random)
            if self.options.pauses and random.random() < self.options.pauses:
                speech = with_pause(speech, random)
            clean.append(torch.from_numpy(speech))
            if random.random() < self.options.share:
                speech = self.augmenter(speech, int(random.integers(2**31)))
            augmented.append(torch.from_numpy(speech))
        pad = partial(nn.utils.rnn.pad_sequence, batch_first=True)
        return DistillationBatch(pad(clean), pad(augmented), torch.tensor([len(clip) for clip in clean]))

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


def read_recordings(folder: Path, seed: int) -> list[npt.NDArray[np.float32]]:
    """People's recordings in any folders below one, (S,) at 16 kHz each."""
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in RECORDINGS)
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
