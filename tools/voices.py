"""What a model does with voices, rooms and noise that it was not trained on, and in pauses, as tables.

The test sentences of the built-in corpus are changed by means that training does not use (facediff/data/augmentation.py
has those): pitch by a phase vocoder, formants by linear prediction, a room by mirrored sources,
noise and hum by filters in time. The truth stays what it was, so that scores can be taken.

- *closures*: of the p, b and m at which the truth's lips close, the share at which the model's lips close too. A mouth
  is closed up to the truth's smallest opening of the clip and a fifth of its range. *Chance* is the mean of the same
  share with the closures moved to every other time of the clip. *Within 1 mm* and *gap*: how far the lips' pairs are
  apart at their nearest in a closure, compared with the neutral face, in mm.
- *kept out*: the clips of test C, whose voices nobody is trained with, by voice.
- *people kept out*: articulation (facediff/data/articulation.py) in sentences of test and validation by voices of
  people that nobody is trained with, where installed; means over sentences, and half of the AUC's 95 % interval.
- *recordings*: the same of people's own, in a folder of `facediff data align` (``--recordings FOLDER``); means over
  speakers.
- *pauses*: two sentences with 1 s of silence before, between and after them. How far the lips are open in the pauses,
  from 0.3 s after speech to 0.2 s before it, how far a lip vertex moves from a frame to the next, and the lip vertex
  error of the first 0.2 s of speech, which a gate that opens late would raise.
- *LVE* as in `facediff test`, in mm².

    $ python tools/voices.py demo/puppet.ckpt
    $ python tools/voices.py demo/puppet.ckpt --options voice_gate=off --only pauses
    $ python tools/voices.py facediff/bundled/puppet --options voice_shift=-4 --only "kept out"
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, fields
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import soxr
from scipy.linalg import solve_toeplitz
from scipy.signal import butter, fftconvolve, lfilter, sosfilt

import facediff
from facediff.animation.options import GROUPS
from facediff.cli.parsing import parameters_of
from facediff.data import Puppet, Sample
from facediff.data.articulation import ArticulationScores, MouthMotion, articulation, mouth_motion
from facediff.data.track.face import pair_distances
from facediff.reporting.scores import ScoreMatrix
from facediff.reporting.statistics import Bootstrap
from facediff.speech.audio import fit_length
from facediff.speech.espeak import Utterance
from facediff.speech.phonemes import TimedPhoneme, closures, phonemes_file, read_phonemes
from facediff.speech.pitch import HOP, SIZE, signal, spectra
from facediff.synthetic.cast import KEPT_OUT_PEOPLE
from facediff.synthetic.recordings import recordings_of, speakers_of
from facediff.synthetic.sentences import TEST, VALIDATION
from facediff.synthetic.voices import installed_voices, open_voice
from facediff.utils import SAMPLE_RATE
from facediff.utils.files import atomic
from facediff.utils.text_tables import print_table

Array = npt.NDArray[np.floating]
Change = Callable[[Array], Array]

THRESHOLD = 0.2
"""Share of the truth's range of opening up to which a mouth is closed, as in `BilabialClosureRate`."""
PAUSE = 1.0
AFTER, BEFORE, ONSET = 0.3, 0.2, 0.2
"""Seconds after speech and before it that do not count as a pause, and those that count as an onset."""


# Other voices, by means that training does not use.


def vocoded(speech: Array, ratio: float) -> Array:
    """Speech that lasts ``ratio`` times as long at the same pitch, by a phase vocoder (Flanagan and Golden 1966)."""
    spectrum, length = spectra(speech), round(len(speech) * ratio)
    places = np.arange(int(np.ceil(length / HOP)) + 1) / ratio
    low = np.clip(np.floor(places).astype(int), 0, len(spectrum) - 2)
    share = np.clip(places - low, 0, 1)[:, None]
    sizes = (1 - share) * np.abs(spectrum)[low] + share * np.abs(spectrum)[low + 1]
    # Each bin's phase advances by its centre frequency and the deviation between neighbouring spectra, wrapped to
    # (-pi, pi].
    advance = 2 * np.pi * HOP / SIZE * np.arange(spectrum.shape[1])
    turn = np.diff(np.angle(spectrum), axis=0) - advance
    turn += advance - 2 * np.pi * np.round(turn / (2 * np.pi))
    phase = np.cumsum(np.concatenate([np.angle(spectrum[:1]), turn[low[:-1]]]), axis=0)
    return signal(sizes * np.exp(1j * phase), length)


def pitched(speech: Array, semitones: float) -> Array:
    """Every frequency higher by so many semitones, formants too, at the same speed."""
    ratio = 2 ** (semitones / 12)
    return fit_length(soxr.resample(vocoded(speech, ratio), ratio * 1000, 1000, quality="HQ"), len(speech))


def formants(speech: Array, ratio: float) -> Array:
    """Formants times ``ratio`` at the same pitch: the poles of linear prediction are turned."""
    order, size, hop = 18, 480, 240
    window = np.hanning(size + 1)[:-1]
    padded = np.pad(speech, (size, 2 * size))
    out = np.zeros(len(padded))
    for start in range(0, len(padded) - size, hop):
        frame = padded[start : start + size] * window
        power = np.correlate(frame, frame, "full")[size - 1 : size + order]
        if power[0] < 1e-8:
            continue
        power[0] *= 1.0001
        predictor = np.concatenate([[1.0], -solve_toeplitz(power[:-1], power[1:])])
        rest = lfilter(predictor, [1.0], frame)
        poles = np.roots(predictor)
        angles = np.angle(poles)
        kept = np.where(np.abs(angles) * ratio < 0.98 * np.pi, np.abs(angles) * ratio, 0.98 * np.pi)
        real = np.abs(poles.imag) < 1e-9
        turned = np.where(real, poles, np.minimum(np.abs(poles), 0.985) * np.exp(1j * np.sign(angles) * kept))
        made = lfilter([1.0], np.real(np.poly(turned)), rest)
        level = np.sqrt((frame**2).sum() / max((made**2).sum(), 1e-12))
        out[start : start + size] += made * level
    return np.asarray(out[size : size + len(speech)])


def voice(semitones: float, ratio: float) -> Change:
    """Another speaker: pitch by so many semitones, formants times ``ratio``."""
    return lambda speech: formants(pitched(speech, semitones), ratio / 2 ** (semitones / 12))


def room(seconds: float, size: tuple[float, float, float] = (4.2, 3.4, 2.6), apart: float = 1.2) -> Change:
    """A box-shaped room by mirrored sources (Allen and Berkley 1979), heard so many metres away, without delay."""
    volume, (x, y, z) = float(np.prod(size)), size
    surface = 2 * (x * y + y * z + x * z)
    kept = np.sqrt(max(0.0, 1 - 0.161 * volume / (surface * seconds)))
    source = np.array([0.31 * x, 0.42 * y, 0.58 * z])
    ear = source + apart * np.array([0.8, 0.55, 0.24])
    most = int(np.ceil(343 * seconds / min(size) / 2)) + 1
    response = np.zeros(round(seconds * SAMPLE_RATE) + SAMPLE_RATE // 10)
    order = np.arange(-most, most + 1)
    for flips in np.ndindex(2, 2, 2):
        places = [(1 - 2 * flip) * source[axis] + 2 * order * size[axis] - ear[axis] for axis, flip in enumerate(flips)]
        bounces = [np.abs(order - flip) + np.abs(order) for flip in flips]
        distance = np.sqrt(
            places[0][:, None, None] ** 2 + places[1][None, :, None] ** 2 + places[2][None, None, :] ** 2
        ).ravel()
        walls = (bounces[0][:, None, None] + bounces[1][None, :, None] + bounces[2][None, None, :]).ravel()
        arrival = np.round((distance - apart) / 343 * SAMPLE_RATE).astype(int)
        near = (arrival < len(response)) & (arrival >= 0)
        np.add.at(response, arrival[near], kept ** walls[near] * apart / distance[near])
    return lambda speech: fftconvolve(speech, response)[: len(speech)]


def telephone(speech: Array) -> Array:
    """300 to 3400 Hz."""
    return np.asarray(sosfilt(butter(4, (300, 3400), "bandpass", fs=SAMPLE_RATE, output="sos"), speech))


def tone(count: int, seed: int) -> Array:
    """Room tone of unit power: noise that falls by 6 dB an octave above 200 Hz, as of air conditioning."""
    made = lfilter([1.0], [1.0, -0.92], np.random.default_rng(seed).standard_normal(count + 1000))[1000:]
    return np.asarray(made / np.sqrt((made**2).mean()))


def hiss(count: int, seed: int) -> Array:
    """White noise of unit power."""
    return np.random.default_rng(seed).standard_normal(count)


def hum(count: int, seed: int) -> Array:
    """Mains hum of unit power: a clipped sine of 50 Hz."""
    made = np.clip(np.sin(2 * np.pi * 50 * np.arange(count) / SAMPLE_RATE + seed), -0.3, 0.6)
    made -= made.mean()
    return np.asarray(made / np.sqrt((made**2).mean()))


def level(speech: Array) -> float:
    """Root mean square of what is said: of the louder half of stretches of 20 ms."""
    parts = speech[: len(speech) // 320 * 320].reshape(-1, 320)
    power = np.sort((parts**2).mean(1))
    return float(np.sqrt(power[len(power) // 2 :].mean()))


def noisy(decibels: float, kind: Callable[[int, int], Array] = tone) -> Change:
    """Noise so many decibels below the speech."""
    return lambda speech: speech + kind(len(speech), 1) * level(speech) * 10 ** (-decibels / 20)


def both(first: Change, second: Change) -> Change:
    """One after the other."""
    return lambda speech: second(first(speech))


VOICES: dict[str, Change] = {
    "clean": lambda speech: speech,
    "pitch +4 semitones": voice(4, 1.0),
    "pitch -4 semitones": voice(-4, 1.0),
    "formants +15 %": voice(0, 1.15),
    "formants -13 %": voice(0, 0.87),
    "higher voice (+3, +12 %)": voice(3, 1.12),
    "lower voice (-3, -10 %)": voice(-3, 0.9),
    "room, 0.4 s": room(0.4),
    "room tone -20 dB": noisy(20),
    "telephone": telephone,
    "higher voice in a room": both(voice(3, 1.12), room(0.3)),
    "lower voice in a room": both(voice(-3, 0.9), room(0.3)),
    "lower voice, room, tone -25 dB": both(both(voice(-3, 0.9), room(0.3)), noisy(25)),
}
"""Changes of the test sentences, by name."""

TRAINED = 1
"""How many of them, from the first, are no strange voice."""

PAUSES: dict[str, Change] = {
    "digital silence": lambda speech: speech,
    "room tone -50 dB": noisy(50),
    "room tone -40 dB": noisy(40),
    "room tone -30 dB": noisy(30),
    "room tone -20 dB": noisy(20),
    "hiss -30 dB": noisy(30, hiss),
    "hum -30 dB": noisy(30, hum),
    "lower voice, room tone -30 dB": both(voice(-3, 0.9), noisy(30)),
}
"""Changes of sentences with pauses, by name."""

NOTHING: dict[str, Callable[[int], Array]] = {
    "digital silence": np.zeros,
    "room tone at -50 dB of full scale": lambda count: tone(count, 3) * 10**-2.5,
    "hiss at -20 dB of full scale": lambda count: hiss(count, 3) * 0.1,
    "hum at -20 dB of full scale": lambda count: hum(count, 3) * 0.1,
}
"""Recordings in which nobody speaks, by name."""


class Bench:
    """A model and the test clips.

    Args:
        checkpoint: the model.
        options: further keywords of `Animator.animate`.
        clips: most clips of a split.
        root: folder of the corpus; the user's cache folder if None.
    """

    def __init__(
        self, checkpoint: Path, options: dict[str, Any], clips: int | None = None, root: str | None = None
    ) -> None:
        self.model = facediff.load(checkpoint)
        self.options = options
        self.data = Puppet(root=root)
        self.data.prepare_data()
        assets = self.data.assets()
        assert assets.inner_lip_pairs is not None
        self.pairs = assets.inner_lip_pairs.numpy()
        self.lips = assets.regions["lips"].numpy()
        self.samples = {
            split: [self.data.dataset(split)[i] for i in range(len(self.data.clips(split)))][:clips]
            for split in ("test_a", "test_b")
        }

    def animate(self, speech: Array, sample: Sample) -> Array:
        """Vertices (T, V, 3) in mm."""
        options = {"seed": 0, **self.options}
        style = (sample.reference + sample.template).numpy()
        made = self.model.animate(
            speech.astype(np.float32), SAMPLE_RATE, identity=sample.identity_name, style=style, **options
        )
        return made.vertices.astype(np.float64) * 1000

    def truth(self, sample: Sample) -> Array:
        """Vertices (T, V, 3) in mm."""
        return (sample.motion + sample.template).double().numpy() * 1000

    def opening(self, vertices: Array) -> Array:
        """Opening of the mouth (T,)."""
        return pair_distances(vertices, self.pairs)

    def squared_error(self, made: Array, true: Array) -> Array:
        """Largest squared error of a lip vertex in each frame (T,)."""
        return np.asarray(((made - true)[:, self.lips] ** 2).sum(-1).max(1))

    def said(self, sample: Sample) -> tuple[list[tuple[int, int]], tuple[float, float]]:
        """A clip's closures in frames, and when its first phoneme starts and its last one ends."""
        file = phonemes_file(self.data.root, sample.name)
        assert file is not None
        phonemes = read_phonemes(file)
        spoken = [each for each in phonemes if each.ipa]
        return closures(phonemes, self.model.frame_rate), (spoken[0].start, spoken[-1].end)

    def voice(self, change: Change) -> dict[str, float]:
        """Closures, chance and LVE over test A and B, of speech that is changed."""
        found = {split: self.spoken(samples, change) for split, samples in self.samples.items()}
        closures, chances, gaps = (np.concatenate([each[i] for each in found.values()]) for i in range(3))
        errors = {f"LVE {split[-1].upper()}": float(each[3].mean()) for split, each in found.items()}
        return {**_closed(closures, chances, gaps), **errors}

    def kept_out(self, voice: str) -> dict[str, float]:
        """The same for the clips of test C that this voice speaks."""
        numbers = [i for i, clip in enumerate(self.data.clips("test_c")) if clip.attributes["voice"] == voice]
        samples = [self.data.dataset("test_c")[i] for i in numbers]
        closures, chances, gaps, errors = self.spoken(samples, lambda speech: speech)
        still = [self.squared_error(each.template.double().numpy()[None] * 1000, self.truth(each)) for each in samples]
        return {**_closed(closures, chances, gaps), "LVE / still": float(errors.mean() / np.concatenate(still).mean())}

    def person(self, voice: str) -> dict[str, float]:
        """Articulation of sentences in a voice without clips."""
        said = map(open_voice(voice).speak, (*TEST, *VALIDATION))
        return self.strangers((str(n), each) for n, each in enumerate(said))

    def recorded(self, folder: Path) -> dict[str, float]:
        """Articulation of people's recordings in a folder of `facediff data align`."""
        voices = ((Path(name).name, each.voice) for name in speakers_of(folder) for each in recordings_of(name, 9))
        return self.strangers((name, open_voice(voice).speak()) for name, voice in voices)

    def strangers(self, said: Iterable[tuple[str, Utterance]]) -> dict[str, float]:
        """Articulation of speakers, or sentences, without clips; faces and styles of test A take turns."""
        mouths: dict[str, list[MouthMotion]] = {}
        for (name, utterance), sample in zip(said, cycle(self.samples["test_a"][::3]), strict=False):
            speech = 0.6 * utterance.samples / np.abs(utterance.samples).max()
            phonemes = [TimedPhoneme(*astuple(phoneme)) for phoneme in utterance.phonemes]
            facts = {"millimetres": 1.0, "frame_rate": self.model.frame_rate, "phonemes": phonemes}
            made, template = self.animate(speech, sample), sample.template.double().numpy() * 1000
            mouths.setdefault(name, []).append(mouth_motion(made, template, self.pairs, **facts))
        values = np.array([astuple(articulation(each)) for each in mouths.values()])
        table = ScoreMatrix.of([*mouths], values, np.ones_like(values))
        names = [field.name for field in fields(ArticulationScores)]
        interval = table.intervals(Bootstrap())[names.index("closure_auc")]
        half = (interval.high - interval.low) / 2 if interval else float("nan")
        means = {name: mean for name, mean in zip(names, table.pool().tolist(), strict=True) if np.isfinite(mean)}
        return {**means, "AUC ±": half, "n": len(mouths)}

    def spoken(self, samples: Sequence[Sample], change: Change) -> tuple[Array, Array, Array, Array]:
        """Of each closure: whether the lips close, by chance, and the gap in mm; of each frame: the squared error."""
        hits, chances, gaps, errors = [], [], [], []
        for sample in samples:
            true = self.truth(sample)
            made = self.animate(change(sample.audio.double().numpy()), sample)[: len(true)]
            wide, rest = self.opening(true), self.opening(sample.template.double().numpy()[None] * 1000)
            limit = wide.min() + THRESHOLD * np.ptp(wide)
            opened = self.opening(made)
            shut, closed = opened <= limit, wide <= limit
            for start, end in self.said(sample)[0]:
                if not closed[start:end].any():
                    continue
                hits.append(float(shut[start:end].any()))
                gaps.append(float((opened[start:end] - rest).min()))
                chances.append(_chance(shut, end - start))
            errors.append(self.squared_error(made, true[: len(made)]))
        return np.array(hits), np.array(chances), np.array(gaps), np.concatenate(errors)

    def pause(self, change: Change) -> dict[str, float]:
        """Opening and tremble in pauses, and the error of onsets, of changed sentences with pauses."""
        rate, quiet = self.model.frame_rate, np.zeros(round(PAUSE * SAMPLE_RATE))
        opened, trembled, onsets, ends = [], [], [], []
        samples = self.samples["test_a"]
        for one, two in zip(samples[::5], samples[1::5], strict=False):
            speech = np.concatenate([quiet, one.audio.numpy(), quiet, two.audio.numpy(), quiet])
            made = self.animate(change(speech), one)
            starts = [PAUSE, 2 * PAUSE + len(one.audio) / SAMPLE_RATE]
            spoken = [
                tuple(start + time for time in self.said(sample)[1])
                for start, sample in zip(starts, (one, two), strict=True)
            ]
            pauses = [
                (0.0, spoken[0][0] - BEFORE),
                (spoken[0][1] + AFTER, spoken[1][0] - BEFORE),
                (spoken[1][1] + AFTER, len(speech) / SAMPLE_RATE),
            ]
            opening = self.opening(made)
            for start, end in pauses:
                first, last = round(start * rate), round(end * rate)
                opened.append(opening[first:last])
                steps = np.linalg.norm(np.diff(made[first:last][:, self.lips], axis=0), axis=-1)
                trembled.append(steps.mean(1))
            for start, sample, (begin, _) in zip(starts, (one, two), spoken, strict=True):
                true = self.truth(sample)
                first = round(begin * rate)
                count = round(ONSET * rate)
                own = first - round(start * rate)
                onsets.append(self.squared_error(made[first : first + count], true[own : own + count]))
                middle = made[round(start * rate) : round(start * rate) + len(true)]
                ends.append(self.squared_error(middle, true[: len(middle)]))
        return {
            **_of_silence(opened, trembled),
            "LVE onset": float(np.concatenate(onsets).mean()),
            "LVE speech": float(np.concatenate(ends).mean()),
        }

    def nothing(self, make: Callable[[int], Array]) -> dict[str, float]:
        """Opening and tremble of recordings in which nobody speaks."""
        opened, trembled = [], []
        for sample in self.samples["test_a"][::5]:
            made = self.animate(make(4 * SAMPLE_RATE), sample)
            opened.append(self.opening(made))
            trembled.append(np.linalg.norm(np.diff(made[:, self.lips], axis=0), axis=-1).mean(1))
        return _of_silence(opened, trembled)


def _of_silence(opened: Sequence[Array], trembled: Sequence[Array]) -> dict[str, float]:
    mouths, steps = np.concatenate(opened), np.concatenate(trembled)
    return {"opening": float(mouths.mean()), "widest": float(mouths.max()), "tremble": float(steps.mean())}


def _chance(shut: npt.NDArray[np.bool_], length: int) -> float:
    """How often a closure of so many frames finds the mouth shut, moved to every other time of the clip."""
    return float(np.mean([shut[start : start + length].any() for start in range(len(shut) - length)]))


def _closed(hits: Array, chances: Array, gaps: Array) -> dict[str, float]:
    return {
        "closures": float(hits.mean()),
        "chance": float(chances.mean()),
        "within 1 mm": float((gaps < 1).mean()),
        "gap": float(np.median(gaps)),
    }


def show(title: str, scores: dict[str, dict[str, float]]) -> None:
    """Print a table of scores by name."""
    columns = list(next(iter(scores.values())))
    print_table([title, *columns], [[name, *(f"{row[key]:.3f}" for key in columns)] for name, row in scores.items()])
    print()


def _installed(voice: str) -> bool:
    program, _, name = voice.partition(":")
    return name in installed_voices().get(program, [])


def measured(
    checkpoint: Path,
    options: dict[str, Any],
    clips: int | None = None,
    only: str = "",
    root: str | None = None,
    people: Sequence[str] = KEPT_OUT_PEOPLE,
    recordings: Sequence[Path] = (),
) -> dict[str, Any]:
    """All tables, which are printed as they are ready.

    Args:
        checkpoint: the model.
        options: further keywords of `Animator.animate`.
        clips: most clips of a split.
        only: measure tables and rows whose name contains this.
        root: folder of the corpus; the user's cache folder if None.
        people: voices of people that nobody is trained with.
        recordings: folders of `facediff data align`.
    """
    bench = Bench(checkpoint, options, clips, root)
    strangers = dict.fromkeys(clip.attributes["voice"] for clip in bench.data.clips("test_c"))
    found: dict[str, Any] = {}
    tables: tuple[tuple[str, dict[str, Any], Callable[[Any], dict[str, float]]], ...] = (
        ("voices", VOICES, bench.voice),
        ("kept out", {voice: voice for voice in strangers}, bench.kept_out),
        ("people kept out", {voice: voice for voice in people if _installed(voice)}, bench.person),
        ("recordings", {folder.name: folder for folder in recordings}, bench.recorded),
        ("pauses, mm", PAUSES, bench.pause),
        ("nobody speaks, mm", NOTHING, bench.nothing),
    )
    for title, rows, measure in tables:
        scores = {name: measure(change) for name, change in rows.items() if only in f"{title}: {name}"}
        if not scores:
            continue
        if title == "voices" and len(scores) == len(rows):
            strange = list(scores.values())[TRAINED:]
            scores["mean of strange voices"] = {
                key: float(np.mean([row[key] for row in strange])) for key in strange[0]
            }
        found[title] = scores
        show(title, scores)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--options", nargs="*", default=[], metavar="NAME=VALUE", help="keywords of Animator.animate")
    parser.add_argument("--clips", type=int, help="most clips of a split")
    parser.add_argument("--only", default="", metavar="WORDS", help="tables and rows whose name contains this")
    parser.add_argument("--people", nargs="*", default=KEPT_OUT_PEOPLE, metavar="VOICE", help="such as flite:slt")
    parser.add_argument(
        "--recordings", nargs="*", default=[], type=Path, metavar="FOLDER", help="of `facediff data align`"
    )
    parser.add_argument("--data-root", help="folder of the corpus (default: the user's cache folder)")
    parser.add_argument("--json", type=Path, help="write the scores here too")
    given = parser.parse_args(arguments)
    parameters = {name: option for group in GROUPS for name, option in parameters_of(group).items()}
    options = {name: parameters[name].read(text) for name, _, text in (word.partition("=") for word in given.options)}
    scores = measured(
        given.checkpoint, options, given.clips, given.only, given.data_root, given.people, given.recordings
    )
    if given.json:
        with atomic(given.json) as temporary:
            temporary.write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
