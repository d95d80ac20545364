"""Tiny checkpoints of VOCA and DeepSpeech as they are converted, and what the published code makes of speech.

The reference is NumPy in float64 from the formulas; it shares no code with facediff.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

VERTICES, LOGITS, COUNT = 12, 29, 3
IDENTITIES = ["A", "B", "C"]
CONVOLUTIONS = ((LOGITS + COUNT, 6), (6, 6), (6, 8), (8, 8))
Arrays = dict[str, np.ndarray]


class Drawn:
    """Random arrays in float32."""

    def __init__(self, seed: int) -> None:
        self.generator = np.random.default_rng(seed)

    def __call__(self, *shape: int, spread: float | None = None, shift: float = 0.0) -> np.ndarray:
        spread = 1 / math.sqrt(math.prod(shape[:-1]) or 1) if spread is None else spread
        return (shift + spread * self.generator.standard_normal(shape)).astype(np.float32)


def voca_state(seed: int = 0) -> Arrays:
    """VOCA's variables, with what the optimiser keeps."""
    draw, scope = Drawn(seed), "VOCA/SpeechEncoder"
    made = {
        f"{scope}/batch_norm/gamma": draw(1, spread=0.1, shift=0.4),
        f"{scope}/batch_norm/beta": draw(1, spread=0.1),
        f"{scope}/batch_norm/moving_mean": draw(1, spread=0.1),
        f"{scope}/batch_norm/moving_variance": np.full(1, 0.7, np.float32),
    }
    for i, (into, out) in enumerate(CONVOLUTIONS, 1):
        made |= {f"{scope}/conv{i}/weights": draw(3, 1, into, out), f"{scope}/conv{i}/biases": draw(out, shift=0.4)}
    made |= {f"{scope}/fc1/weights": draw(8 + COUNT, 10, spread=0.6), f"{scope}/fc1/biases": draw(10, spread=0.1)}
    made |= {f"{scope}/fc2/weights": draw(10, 5), f"{scope}/fc2/biases": draw(5, spread=0.1)}
    shapes = "VOCA/ExpressionLayer/expression_offset"
    made |= {f"{shapes}/weights": draw(5, 3 * VERTICES), f"{shapes}/biases": draw(3 * VERTICES, spread=0.1)}
    made[f"{scope}/conv1/weights"][:, :, :LOGITS] *= 3  # so that speech matters
    slots = {f"{name}/{slot}": np.zeros_like(value) for name, value in made.items() for slot in ("Adam", "Adam_1")}
    slots |= {"beta1_power": np.array(0.9, np.float32), "beta2_power": np.array(0.99, np.float32)}
    return made | slots | {"global_step": np.array(52280, np.int64)}


def deepspeech_state(seed: int = 1, units: int = 12, cells: int = 6) -> Arrays:
    """DeepSpeech's weights by the names of its frozen graph."""
    draw = Drawn(seed)
    sizes = {
        "1": (494, units),
        "2": (units, units),
        "3": (units, 2 * units),
        "5": (2 * cells, units),
        "6": (units, LOGITS),
    }
    made: Arrays = {}
    for place, (into, out) in sizes.items():
        # Some units reach the clip of the rectifiers at 20.
        made[f"h{place}"] = draw(into, out, spread=8 / math.sqrt(into) if place in "12" else None)
        made[f"b{place}"] = draw(out, spread=0.1)
    made["h6"] *= 3
    for way in ("fw", "bw"):
        cell = f"bidirectional_rnn/{way}/basic_lstm_cell"
        made[f"{cell}/kernel"] = draw(2 * units + cells, 4 * cells, spread=0.05)
        made[f"{cell}/bias"] = draw(4 * cells, spread=0.1)
    return made


def write_arrays(path: Path, arrays: Arrays) -> Path:
    """Arrays as tools/convert_tensorflow.py writes them."""
    with path.open("wb") as stream:
        np.savez(stream, **arrays)
    return path


def write_voca(folder: Path, seed: int = 0) -> list[Path]:
    """The checkpoint and DeepSpeech's graph, converted."""
    return [
        write_arrays(folder / "voca.npz", voca_state(seed)),
        write_arrays(folder / "deepspeech.npz", deepspeech_state()),
    ]


# Cepstra, as python_speech_features computes them by default.


def cepstra(samples: np.ndarray) -> np.ndarray:
    """(steps, 26) of whole numbers at 16 kHz."""
    signal = np.append(samples[0], samples[1:] - 0.97 * samples[:-1])
    steps = 1 if len(signal) <= 400 else 1 + math.ceil((len(signal) - 400) / 160)
    signal = np.append(signal, np.zeros((steps - 1) * 160 + 400 - len(signal)))
    edges = [700 * (10 ** (mel / 2595) - 1) for mel in np.linspace(0, 2595 * np.log10(1 + 8000 / 700), 28)]
    bins = [math.floor(513 * edge / 16000) for edge in edges]
    rows = []
    for step in range(steps):
        spectrum = np.abs(np.fft.rfft(signal[160 * step : 160 * step + 400], 512)) ** 2 / 512
        bands = []
        for low, middle, high in zip(bins, bins[1:], bins[2:], strict=False):
            energy = sum(spectrum[k] * (k - low) / (middle - low) for k in range(low, middle))
            energy += sum(spectrum[k] * (high - k) / (high - middle) for k in range(middle, high))
            bands.append(math.log(energy or np.finfo(float).eps))
        row = []
        for order in range(26):
            value = sum(band * math.cos(math.pi * order * (2 * j + 1) / 52) for j, band in enumerate(bands))
            value *= math.sqrt((1 if order == 0 else 2) / 26)
            row.append(value * (1 + 11 * math.sin(math.pi * order / 22)))
        row[0] = math.log(spectrum.sum() or np.finfo(float).eps)
        rows.append(row)
    return np.array(rows)


def logits(speech: np.ndarray, s: Arrays) -> np.ndarray:
    """DeepSpeech's logits (steps, 29) at 50 a second, of speech of full scale 1."""
    found = cepstra(np.trunc(speech.astype(np.float64) * 32768))[::2]
    around = np.concatenate([np.zeros((9, 26)), found, np.zeros((9, 26))])
    x = np.stack([around[i : i + 19].reshape(-1) for i in range(len(found))])
    x = (x - x.mean()) / x.std()
    for place in "123":
        x = np.clip(x @ s[f"h{place}"] + s[f"b{place}"], 0, 20)

    def recurrent(x: np.ndarray, way: str) -> np.ndarray:
        kernel, bias = (s[f"bidirectional_rnn/{way}/basic_lstm_cell/{part}"] for part in ("kernel", "bias"))
        out = np.zeros(kernel.shape[1] // 4)
        state, made = out, []
        for row in x:
            entry, new, forget, output = np.split(np.append(row, out) @ kernel + bias, 4)
            state = state / (1 + np.exp(-(forget + 1))) + np.tanh(new) / (1 + np.exp(-entry))
            out = np.tanh(state) / (1 + np.exp(-output))
            made.append(out)
        return np.array(made)

    x = np.concatenate([recurrent(x, "fw"), recurrent(x[::-1], "bw")[::-1]], 1)
    x = np.clip(x @ s["h5"] + s["b5"], 0, 20)
    return np.asarray(x @ s["h6"] + s["b6"])


def windows(speech: np.ndarray, s: Arrays) -> np.ndarray:
    """(frames, 16, 29) at 60 frames a second."""
    features = logits(speech, s)
    frames = round(len(speech) / 16000 * 60)
    at, own = np.arange(frames) / 60, np.arange(len(features)) / 50
    rows = np.stack([np.interp(at, own, channel) for channel in features.T], 1)
    rows = np.concatenate([np.zeros((8, LOGITS)), rows, np.zeros((8, LOGITS))])
    return np.stack([rows[j : j + 16] for j in range(frames)])


def offsets(window: np.ndarray, identity: int, s: Arrays) -> np.ndarray:
    """Offsets (3V,) of one window (16, 29)."""
    scope, one_hot = "VOCA/SpeechEncoder", np.eye(COUNT)[identity]
    norm = {part: s[f"{scope}/batch_norm/{part}"][0] for part in ("gamma", "beta", "moving_mean", "moving_variance")}
    x = (window - norm["moving_mean"]) / math.sqrt(norm["moving_variance"] + 1e-5) * norm["gamma"] + norm["beta"]
    x = np.concatenate([x, np.tile(one_hot, (len(x), 1))], 1)
    for i in range(1, 5):
        kernel, bias = s[f"{scope}/conv{i}/weights"][:, 0], s[f"{scope}/conv{i}/biases"]
        padded = np.concatenate([x, np.zeros((1, x.shape[1]))])
        x = np.stack([sum(padded[2 * p + t] @ kernel[t] for t in range(3)) + bias for p in range(len(x) // 2)])
        x = np.maximum(x, 0)
    x = np.tanh(np.append(x.reshape(-1), one_hot) @ s[f"{scope}/fc1/weights"] + s[f"{scope}/fc1/biases"])
    x = x @ s[f"{scope}/fc2/weights"] + s[f"{scope}/fc2/biases"]
    shapes = "VOCA/ExpressionLayer/expression_offset"
    return np.asarray(x @ s[f"{shapes}/weights"] + s[f"{shapes}/biases"])


def voca_reference(speech: np.ndarray, identity: int, template: np.ndarray, seed: int = 0) -> np.ndarray:
    """Absolute vertices (frames, 3V) at 60 frames a second."""
    state = voca_state(seed)
    heard = windows(speech, deepspeech_state())
    return np.stack([offsets(window, identity, state) for window in heard]) + template.reshape(-1)
