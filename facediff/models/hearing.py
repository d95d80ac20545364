"""A trained model learns to hear other voices, rooms and microphones, or at once, while it moves as before.

Training with changed speech asks of the whole model that it learns the same motion again from every voice, which is
long, and clean speech pays for it. Here only the audio encoder learns: of changed speech it is to make what it made of
the recording itself. The encoder as it was is the teacher, and clean and changed speech run in parallel (Li, Seltzer,
Wang, Zhao and Gong 2017, "Large-scale domain adaptation via teacher-student learning"). Nothing else of the model takes
part, so that a step costs a small part of a training step, and no motion is needed. In the end the weights go most of
the way from the old ones to the new ones, which gives back most of what clean speech has lost and keeps most of what
other voices have gained (Wortsman et al. 2022, "Robust fine-tuning of zero-shot models").

In the same way an encoder learns to hear at once: of speech that ends a moment after a frame it is to make what the
teacher makes of the whole recording. A student of another kind may take the teacher's place, such as a small one that
of HuBERT, which takes a fifth of a second for each frame of a stream (Hinton, Vinyals and Dean 2015, "Distilling the
knowledge in a neural network").
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from facediff.data import SpeechMotionDataModule
from facediff.data.augmentation import Augmenter, Example, SpeechAugmentation, read_augmentations
from facediff.errors import FaceDiffError
from facediff.models.audio_encoders import AudioEncoder
from facediff.models.base import AnimationModel
from facediff.models.layers import frame_mask
from facediff.speech.windows import LOW_LATENCY, QUIETEST
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import USUAL_VOICE_STEPS
from facediff.utils.workers import processors

OTHER_VOICES = (
    "voice:share=0.8,semitones=6,formants=0.22",
    "loudness:share=0.3",
    "room:share=0.6,seconds=0.8,direct=-4",
    "tilt:share=0.6",
    "band:share=0.25",
    "codec:share=0.1",
    "noise:share=0.7",
    "hum:share=0.1",
)
"""How speech is changed unless somebody says otherwise; see docs/voices.md."""

WINDOW = 4.0
"""Seconds of a clip that are heard at a time, at most."""

HEARD_AT_ONCE = (0.6, 1.7)
"""Seconds that a student hears at a time, at least and at most, which learns to hear at once."""

STEP_RATE = 50
"""Features a second that are compared."""


@dataclass(frozen=True)
class HearingOptions:
    """How an audio encoder learns other voices.

    Attributes:
        augmentations: by name with their options, in the order in which they are applied.
        steps: training steps.
        batch_size: clips in a step.
        share: of the clips that are changed; the others are to sound as they did.
        further: how many pieces of further speech are heard besides the clips, where the corpus has such
            (:meth:`facediff.data.SpeechMotionDataModule.further_speech`); as often as the clips.
        moved: how far the weights go from the old ones (0) to those that were learnt (1).
        learning_rate: the highest; it rises over the first twentieth of the steps and falls as a cosine.
        seed: of all that is drawn.
        workers: processes that change speech; 0 for this one.
        ahead: seconds of speech that are heard after a feature, while the teacher hears the whole recording; None for
            the whole recording here too.
    """

    augmentations: Sequence[str] = OTHER_VOICES
    steps: int = USUAL_VOICE_STEPS
    batch_size: int = 12
    share: float = 0.5
    further: int = 1200
    moved: float = 0.85
    learning_rate: float = 1e-3
    seed: int = 0
    workers: int = 1
    ahead: float | None = None


AT_ONCE = HearingOptions(augmentations=(), share=0.0, moved=1.0, ahead=LOW_LATENCY.after)
"""How an audio encoder learns to hear at once."""


class Heard(NamedTuple):
    """A batch of speech as the teacher and as the student hears it.

    Attributes:
        recorded: (batch, samples).
        lengths: valid samples of each.
        changed: what the student hears of it, (batch, fewer samples), from ``start`` to ``end``.
        start: of what the student hears, in steps.
        end: likewise.
        mean: of each clip's speech up to ``end``; None where the student hears all of it.
        deviation: likewise.
    """

    recorded: Tensor
    lengths: Tensor
    changed: Tensor
    start: Tensor
    end: Tensor
    mean: Tensor | None = None
    deviation: Tensor | None = None

    def to(self, device: torch.device) -> Heard:
        """On a device."""
        return Heard(*(None if each is None else each.to(device) for each in self))  # type: ignore[arg-type]


def learn_voices(
    model: AnimationModel,
    data: SpeechMotionDataModule,
    options: HearingOptions = HearingOptions(),  # noqa: B008 - it cannot be changed
    step_done: Callable[[], object] = lambda: None,
    *,
    teacher: AudioEncoder | None = None,
) -> float:
    """Let a trained model's audio encoder learn other voices, or to hear at once, in place.

    Args:
        model: a trained model.
        data: the corpus; its training clips are heard, and their motion is not looked at.
        options: how.
        step_done: called after each step.
        teacher: what the encoder is to become like; as it is now if None.

    Returns:
        what is left of the difference between the student's features and the teacher's, as a share of the features'
        variance; the mean of the last tenth of the steps.

    Raises:
        FaceDiffError: if nothing of the encoder can be trained, or an augmentation is unknown.
    """
    augmentations = read_augmentations(options.augmentations)
    if moving := [each for each in augmentations if not isinstance(each, SpeechAugmentation)]:
        raise FaceDiffError(
            f"augmentations: {type(moving[0]).__name__.lower()} changes the motion with the speech, so that no "
            f"recording says what is to be heard; omit it"
        )
    student = model.speech_encoder
    weights = [weight for weight in student.parameters() if weight.requires_grad]
    if not weights:
        raise FaceDiffError("audio_encoder: all of its weights are frozen; choose one that is trained, such as mel")
    teacher = (copy.deepcopy(student) if teacher is None else teacher).to(model.device).eval().requires_grad_(False)
    before = [weight.detach().clone() for weight in weights]
    pairs = _Pairs(data, Augmenter(augmentations), options)
    workers = min(options.workers, processors() - 1)
    loader = DataLoader(pairs, batch_size=None, num_workers=max(0, workers))
    optimiser = torch.optim.AdamW(weights, lr=options.learning_rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _rate(step, options.steps))
    left: list[float] = []
    devices = [] if model.device.type == "cpu" else [model.device]
    with torch.random.fork_rng(devices):
        torch.manual_seed(options.seed)
        student.train()
        for batch in loader:
            heard: Heard = batch.to(model.device)
            with torch.no_grad():
                wanted = teacher(heard.recorded, heard.lengths, _steps(heard.lengths))
            error = _difference(_features(student, heard), *_compared(wanted, heard, options.ahead))
            optimiser.zero_grad()
            error.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(weights, 1.0)
            optimiser.step()
            schedule.step()
            left.append(float(error.detach()))
            step_done()
    student.eval()
    with torch.no_grad():
        for weight, old in zip(weights, before, strict=True):
            weight.copy_(torch.lerp(old, weight, options.moved))
    return float(np.mean(left[-max(1, options.steps // 10) :]))


def encoder_weights(model: AnimationModel) -> dict[str, Tensor]:
    """The weights of a model's audio encoder, by their names in its checkpoint."""
    name = next(name for name, module in model.named_modules() if module is model.speech_encoder)
    return {f"{name}.{key}": value.detach().cpu() for key, value in model.speech_encoder.state_dict().items()}


def _steps(samples: Tensor) -> Tensor:
    """Features that are compared of so many samples."""
    return (samples * STEP_RATE // SAMPLE_RATE).clamp_min(1)


def _features(student: AudioEncoder, heard: Heard) -> Tensor:
    """What the student makes of what it hears, at the level of all speech so far as in a stream."""
    steps = heard.end - heard.start
    if heard.mean is None or heard.deviation is None:
        made: Tensor = student(heard.changed, heard.lengths, steps)
        return made
    with student.at_level(heard.mean[:, None], heard.deviation[:, None]):
        made = student(heard.changed, steps * SAMPLE_RATE // STEP_RATE, steps)
    return made


def _compared(wanted: Tensor, heard: Heard, ahead: float | None) -> tuple[Tensor, Tensor]:
    """The teacher's features of what the student hears, and True on the steps that are compared."""
    count = heard.end - heard.start
    if ahead is None:
        return wanted, frame_mask(count, wanted.shape[1])[..., None]
    place = torch.arange(int(count.max()), device=wanted.device)[None]
    taken = (heard.start[:, None] + place).clamp_max(wanted.shape[1] - 1)
    # What lies ahead is heard, but no feature is wanted of it; those before the last half second are easy.
    last = (count - round(ahead * STEP_RATE))[:, None]
    mask = (place < last) & (place >= last - STEP_RATE // 2)
    return wanted.gather(1, taken[..., None].expand(-1, -1, wanted.shape[2])), mask[..., None]


def _difference(made: Tensor, wanted: Tensor, mask: Tensor) -> Tensor:
    """Squared difference of features (batch, steps, channels) as a share of their variance, over valid steps."""
    # Channels that hardly vary hold nothing worth hearing: their variance counts as a twentieth of the mean one.
    count = mask.sum()
    mean = (wanted * mask).sum((0, 1)) / count
    variance = ((wanted - mean).square() * mask).sum((0, 1)) / count
    least = (variance.mean() / 20).clamp_min(1e-12)
    return (((made - wanted).square() * mask).sum((0, 1)) / count / variance.clamp_min(least)).mean()


def _rate(step: int, steps: int) -> float:
    """The share of the learning rate at a step."""
    rise = max(1, steps // 20)
    return (step + 1) / rise if step < rise else 0.5 * (1 + math.cos(math.pi * (step - rise) / max(1, steps - rise)))


class _Pairs(Dataset[Heard]):
    """Batches of speech as it was recorded and as it was changed.

    A batch follows from its number and the seed, whatever process makes it.
    """

    def __init__(self, data: SpeechMotionDataModule, augmenter: Augmenter, options: HearingOptions) -> None:
        # Not the data module itself, which may hold what no other process can be given.
        self.corpus, self.clips, self.further = data.corpus, data.clips("train"), data.further_speech()
        self.augmenter, self.options = augmenter, options
        self._said: dict[int, npt.NDArray[np.float32]] = {}

    def __len__(self) -> int:
        """Number of batches."""
        return self.options.steps

    def __getitem__(self, index: int) -> Heard:
        """A batch by number."""
        if index >= len(self):
            raise IndexError(index)
        random = np.random.default_rng([self.options.seed, index])
        recorded, changed = [], []
        for _ in range(self.options.batch_size):
            speech = self._speech(random)
            recorded.append(speech)
            changed.append(self._changed(speech, random) if random.random() < self.options.share else speech)
        lengths = torch.tensor([len(speech) for speech in recorded])
        end = _steps(lengths)
        if self.options.ahead is None:
            return Heard(_padded(recorded), lengths, _padded(changed), torch.zeros_like(end), end)
        spans = [self._span(steps, random) for steps in end.tolist()]
        size = SAMPLE_RATE // STEP_RATE
        known = [each[: stop * size].astype(np.float64) for each, (_, stop) in zip(changed, spans, strict=True)]
        heard = [each[start * size : stop * size] for each, (start, stop) in zip(changed, spans, strict=True)]
        mean, deviation = (torch.tensor(each, dtype=torch.float32) for each in zip(*map(_level, known), strict=True))
        start, stop = torch.tensor(spans).unbind(1)
        return Heard(_padded(recorded), lengths, _padded(heard), start, stop, mean, deviation)

    def _span(self, steps: int, random: np.random.Generator) -> tuple[int, int]:
        """Where a window of low latency begins and ends in a clip, in steps."""
        least = min(steps, round((self.options.ahead or 0) * STEP_RATE) + 2)
        end = int(random.integers(least, steps + 1))
        shortest, longest = (round(seconds * STEP_RATE) for seconds in HEARD_AT_ONCE)
        return max(0, end - int(random.integers(shortest, longest + 1))), end

    def _speech(self, random: np.random.Generator) -> npt.NDArray[np.float32]:
        """A clip or a piece of further speech, or a random window of it."""
        most = max(1, round(WINDOW * self.corpus.frame_rate))
        if self.further is not None and self.options.further and random.random() < 0.5:
            number = int(random.integers(self.options.further))
            if number not in self._said:
                self._said[number] = self.further(number)
            said = self._said[number]
            start = int(random.integers(max(1, len(said) - round(WINDOW * SAMPLE_RATE) + 1)))
            return said[start : start + round(WINDOW * SAMPLE_RATE)]
        clip = self.clips[int(random.integers(len(self.clips)))]
        frames = self.corpus.frames(clip)
        start = int(random.integers(frames - most + 1)) if frames > most else 0
        return self.corpus.read_audio(clip, start, min(frames, start + most)).numpy()

    def _changed(self, speech: npt.NDArray[np.float32], random: np.random.Generator) -> npt.NDArray[np.float32]:
        """Speech of the same length in another voice, another room or with noise."""
        nothing = np.zeros((1, 1, 3), np.float32)
        example = Example(
            speech, nothing, len(nothing) * SAMPLE_RATE / max(1, len(speech)), nothing[0], nothing[0, :, 0]
        )
        return self.augmenter(example, int(random.integers(2**31))).speech


def _level(speech: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Mean and deviation as a stream takes them."""
    return float(speech.mean()), max(float(speech.std()), QUIETEST)


def _padded(speech: list[Any]) -> Tensor:
    return nn.utils.rnn.pad_sequence([torch.from_numpy(each) for each in speech], batch_first=True)
