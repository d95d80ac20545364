"""DeepSpeech 0.1.0 (Mozilla's form of Hannun et al., "Deep Speech", 2014), the audio encoder of VOCA.

From top to bottom: cepstra of speech, the acoustic network, the frozen graph that its weights come in, the encoder. The
cepstra follow the library python_speech_features with its defaults, from the formulas, in float64 as there.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor, nn

from facediff.errors import ArgumentError, damaged
from facediff.models.audio_encoders import Features, FrozenEncoder, Lengths, Waves, by_length, fingerprint, fourier
from facediff.models.layers import Width, all_states, exporting, frame_mask, longest, sliding
from facediff.registry import audio_encoder
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import mismatch
from facediff.utils.limits import quoted
from facediff.utils.torch_files import read_authors_checkpoint

FRAME, HOP, SPECTRUM = 400, 160, 512
"""Samples of a frame (25 ms) and from one to the next (10 ms); those that the Fourier transform takes."""

CEPSTRA = 26
"""Mel bands, and as many cepstra."""

RATE = 50
"""Steps a second: every second frame of 10 ms."""

LOUDEST = 20.0
"""Where the network's rectifiers are clipped."""

PROJECT = "mozilla/DeepSpeech"

RELEASE = f"github.com/{PROJECT}/releases/tag/v0.1.0, deepspeech-0.1.0-models.tar.gz"

SIZES = ("inputs", "first", "second", "third", "cell", "fifth", "logits")
"""The network's sizes: a step's cepstra with their context, the layers in their order, its outputs."""


# Cepstra.


@cache
def tables() -> tuple[Tensor, Tensor]:
    """The mel filters (26, 257), and the cosine transform with the lifter, (26, 26), float64."""

    def hertz(mel: np.ndarray) -> np.ndarray:
        return 700.0 * (10.0 ** (mel / 2595.0) - 1.0)

    mels = np.linspace(0.0, 2595.0 * np.log10(1.0 + SAMPLE_RATE / 2 / 700.0), CEPSTRA + 2)
    # The edges are whole bins, rounded down.
    edges = np.floor((SPECTRUM + 1) * hertz(mels) / SAMPLE_RATE)[:, None]
    bins = np.arange(SPECTRUM // 2 + 1)[None]
    low, middle, high = edges[:-2], edges[1:-1], edges[2:]
    rise, fall = (bins - low) / (middle - low), (high - bins) / (high - middle)
    filters = np.where((bins >= low) & (bins < middle), rise, 0.0) + np.where(
        (bins >= middle) & (bins < high), fall, 0.0
    )
    order = np.arange(CEPSTRA)
    cosine = np.cos(np.pi * order[:, None] * (2 * order[None] + 1) / (2 * CEPSTRA)) * math.sqrt(2 / CEPSTRA)
    cosine[0] /= math.sqrt(2)
    lifter = 1.0 + 11.0 * np.sin(np.pi * order / 22)
    return torch.from_numpy(filters), torch.from_numpy(cosine * lifter[:, None])


def cepstra(samples: Float64[Tensor, "batch samples"]) -> Float64[Tensor, "batch steps 26"]:
    """Mel-frequency cepstra, 100 a second; the first is the logarithm of the frame's energy."""
    # python_speech_features' arithmetic in float64 and in its order (pre-emphasis 0.97, 25 ms every 10 ms, 26 filters,
    # lifter 22), since the released DeepSpeech was trained on it and standardising enlarges differences.
    emphasised = torch.cat([samples[:, :1], samples[:, 1:] - 0.97 * samples[:, :-1]], 1)
    steps = 1 + max(0, (samples.shape[1] - FRAME + HOP - 1) // HOP)
    padded = nn.functional.pad(emphasised, (0, (steps - 1) * HOP + FRAME - samples.shape[1]))
    frames = sliding(padded[..., None], FRAME, HOP, steps)[:, :, 0]
    if exporting():  # browsers' runtimes have no complex numbers
        kernel = fourier(FRAME, SPECTRUM).to(frames)
        real, imaginary = (frames @ kernel).chunk(2, -1)
        power = (real.square() + imaginary.square()) / SPECTRUM
    else:
        power = torch.fft.rfft(frames, SPECTRUM).abs().square() / SPECTRUM
    filters, transform = tables()
    # As the library does: exact zeros only, as of digital silence; a floor added to everything would change quiet
    # speech.
    tiny = torch.finfo(torch.float64).eps

    def logarithm(x: Tensor) -> Tensor:
        return torch.where(x == 0, tiny, x).log()

    coefficients = logarithm(power @ filters.T) @ transform.T
    # The first coefficient is replaced by the log energy, the library's ``appendEnergy``.
    return torch.cat([logarithm(power.sum(-1, keepdim=True)), coefficients[..., 1:]], -1)


def network_input(audio: Waves, context: int) -> Float[Tensor, "batch steps inputs"]:
    """The network's input: 50 steps a second with the cepstra around each, standardised over the clip."""
    # The library takes whole numbers, cut off towards zero. Not every accelerator knows float64.
    samples = (audio.cpu().double() * 32768.0).trunc().clamp(-32768, 32767)
    padded = nn.functional.pad(cepstra(samples)[:, ::2], (0, 0, context, context))
    # (batch, steps, cepstra, steps around): a step's row holds one step after the other.
    rows = sliding(padded, 2 * context + 1, 1, padded.shape[1] - 2 * context).transpose(2, 3).flatten(2)
    mean = rows.mean((1, 2), keepdim=True)
    deviation = rows.std((1, 2), correction=0, keepdim=True)
    return ((rows - mean) / deviation).to(audio)


# The network.


class DeepSpeech(nn.Module):
    """Three dense layers, one recurrent layer in both directions, two dense layers."""

    def __init__(self, sizes: Mapping[str, int]) -> None:
        super().__init__()
        inputs, first, second, third, cell, fifth, logits = (sizes[name] for name in SIZES)
        self.first = nn.Linear(inputs, first)
        self.second = nn.Linear(first, second)
        self.third = nn.Linear(second, third)
        self.recurrent = nn.LSTM(third, cell, batch_first=True, bidirectional=True)
        self.fifth = nn.Linear(2 * cell, fifth)
        self.logits = nn.Linear(fifth, logits)

    def forward(self, x: Float[Tensor, "batch steps inputs"]) -> Float[Tensor, "batch steps logits"]:
        """Logits over letters, space, apostrophe and blank, of clips of one length."""
        for layer in (self.first, self.second, self.third):
            # ReLU cut at 20, DeepSpeech's own activation; no dropout, since the graph is frozen.
            x = layer(x).clamp(0.0, LOUDEST)
        x = self.fifth(all_states(self.recurrent, x)).clamp(0.0, LOUDEST)
        logits: Tensor = self.logits(x)
        return logits


# The frozen graph.

DENSE = {"1": "first", "2": "second", "3": "third", "5": "fifth", "6": "logits"}
"""The dense layers by the number in the graph's names: ``h1`` is a matrix, ``b1`` its bias."""

CELL = re.compile(r"(?:^|/)(fw|bw)/\w*lstm_cell/(kernel|weights|bias|biases)$")


def network_of(graph: Mapping[str, Tensor], source: str) -> tuple[dict[str, Tensor], dict[str, int], list[str]]:
    """The network's weights, its sizes, and the constants that it has no use for."""
    matched: dict[str, Tensor] = {}
    left = []
    with damaged(source, f"expected output_graph.pb of {RELEASE}", RuntimeError):
        for name, value in graph.items():
            part = name.rpartition("/")[2]
            if (cell := CELL.search(name)) is not None:
                part = f"{cell[1]}.{'b' if cell[2][0] == 'b' else 'k'}"  # bias, or kernel that also is called weights
            elif part[:1] not in ("h", "b") or part[1:] not in DENSE:
                left.append(name)
                continue
            if part in matched or not bool(value.isfinite().all()):
                raise ValueError(f"{name} is there twice, or holds NaN or infinity")
            matched[part] = value
        cells = matched["fw.k"].shape[1] // 4
        ends = [*matched["h1"].shape, matched["h2"].shape[1], matched["h3"].shape[1], cells, *matched["h6"].shape]
        sizes = checked_sizes(dict(zip(SIZES, ends, strict=True)))
        state = state_of(matched, sizes)
        with torch.device("meta"):
            DeepSpeech(sizes).load_state_dict(state, assign=True)
    return state, sizes, left


def state_of(matched: Mapping[str, Tensor], sizes: Mapping[str, int]) -> dict[str, Tensor]:
    """The graph's weights by the names of :class:`DeepSpeech`."""
    state: dict[str, Tensor] = {}
    cells = sizes["cell"]
    for number, layer in DENSE.items():
        state[f"{layer}.weight"] = matched[f"h{number}"].T
        state[f"{layer}.bias"] = matched[f"b{number}"]
    for direction, end in (("fw", ""), ("bw", "_reverse")):
        kernel = gates_as_torch(matched[f"{direction}.k"].T, cells)
        bias = gates_as_torch(matched[f"{direction}.b"], cells).clone()
        # TensorFlow's cell adds 1 to the forget gate when it runs.
        bias[cells : 2 * cells] += 1.0
        state[f"recurrent.weight_ih_l0{end}"] = kernel[:, : sizes["third"]]
        state[f"recurrent.weight_hh_l0{end}"] = kernel[:, sizes["third"] :]
        state[f"recurrent.bias_ih_l0{end}"] = bias
        state[f"recurrent.bias_hh_l0{end}"] = torch.zeros_like(bias)
    return {name: value.float().contiguous() for name, value in state.items()}


def gates_as_torch(rows: Tensor, cells: int) -> Tensor:
    """Rows of gates in PyTorch's order, where the new state's rows come third; TensorFlow has them second."""
    entry, new, forget, output = rows.reshape(4, cells, *rows.shape[1:])
    return torch.cat([entry, forget, new, output])


def checked_sizes(sizes: Mapping[str, Any]) -> dict[str, int]:
    """The network's sizes, checked."""
    stated = {name: size for name, size in sizes.items() if name != "_name_or_path"}
    if (
        stated.keys() != set(SIZES)
        or any(mismatch(Width, size) for size in stated.values())
        or (stated["inputs"] % CEPSTRA or stated["inputs"] // CEPSTRA % 2 == 0)
    ):
        raise ArgumentError(
            {"config": quoted(stated)},
            f"expected the sizes {', '.join(SIZES)}, of which inputs is an odd multiple of {CEPSTRA}",
        )
    return stated


# The encoder.


@audio_encoder.register("deepspeech")
class DeepSpeechEncoder(FrozenEncoder):
    """Logits of the frozen DeepSpeech 0.1.0, the speech features of VOCA.

    Its steps are 50 a second. Models that take frames get them interpolated to the motion's frames; VOCA itself takes
    them at the times of its own rate.

    Args:
        dim: channels of the result, by a linear map of the logits; the 29 logits as they are if None. Given by the
            model.
        source: the frozen graph ``output_graph.pb`` of the release 0.1.0, converted by ``tools/convert_tensorflow.py``.
        config: the network's sizes; if given, the weights are not read from ``source`` but left for a checkpoint to
            fill in. Checkpoints use it, so that they need no access to ``source``.
    """

    checkpoint_options = ("config",)  # without it, a file could have another one read

    def __init__(
        self, *, dim: Width | None, source: str = "deepspeech.npz", config: dict[str, Any] | None = None
    ) -> None:
        super().__init__()
        state: dict[str, Tensor] = {}
        if config is None:
            with damaged("audio_encoder.source", f"expected output_graph.pb of {RELEASE}, converted to .npz"):
                state, config, _ = network_of(read_authors_checkpoint(Path(source).expanduser())[0], source)
        self.sizes = checked_sizes(config)
        self.context = self.sizes["inputs"] // CEPSTRA // 2
        self.network = DeepSpeech(self.sizes)
        if state:
            self.network.load_state_dict(state)
        self.network.requires_grad_(False)
        self.out = None if dim is None else nn.Linear(self.sizes["logits"], dim)
        self.width: int = self.sizes["logits"] if dim is None else dim

    def checkpoint_init_args(self) -> dict[str, Any]:
        """The sizes and the network's author (for its licence), which a checkpoint stores in place of ``source``."""
        return {"config": {**self.sizes, "_name_or_path": PROJECT}}

    def frozen_key(self) -> str | None:
        """A hash of the network's weights."""
        return fingerprint(-1, dict(self.sizes), {"network": self.network})

    @torch.no_grad()
    def frozen_features(self, audio: Waves, audio_lengths: Lengths) -> tuple[Features, Lengths]:
        """The logits, at 50 steps a second."""
        return by_length(audio, audio_lengths, lambda wave: self.network(network_input(wave, self.context)))

    def at_rate(
        self, audio: Waves, audio_lengths: Lengths, steps: Lengths, rate: float, *cached: Tensor
    ) -> Float[Tensor, "batch most_steps width"]:
        """Encode at the times of another rate; the last logits are held. See :meth:`AudioEncoder.at_rate`."""
        features, lengths = cached or self.frozen_features(audio, audio_lengths)
        # From time 0 with the last logits held, as VOCA's code resamples, not spread over the clip: a step's time must
        # not depend on how long the clip is.
        times = torch.arange(longest(steps), dtype=torch.float64) * (RATE / rate)
        positions = torch.minimum(times[None], lengths.cpu().double()[:, None] - 1)
        low = positions.floor().long()
        high = torch.minimum(low + 1, lengths.cpu()[:, None] - 1).to(features.device)
        share = (positions - low)[..., None].to(features)
        rows = torch.arange(features.shape[0], device=features.device)[:, None]
        resampled = torch.lerp(features[rows, low.to(features.device)], features[rows, high], share)
        resampled = resampled if self.out is None else self.out(resampled)
        return resampled * frame_mask(steps, resampled.shape[1])[..., None]
