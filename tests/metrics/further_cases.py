"""Every metric with every option: how to make it, what to feed it, and its formula in float64 NumPy.

The formulas are written from the definitions, one sequence at a time, without looking at the package. A
formula gives (value, weight) of a sequence, or None where the sequence has no value.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import combinations, product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import linalg
from torch import Tensor

import facediff.metrics as fm

Array = NDArray[Any]
Corpus = Any  # the class of that name in conftest.py
Formula = Callable[[Corpus, int], tuple[float, float] | None]

LIPS = (3, 4, 9, 31)
UPPER = (0, 1, 20, 25, 39)
PAIRS = ((3, 9), (31, 4), (12, 13))
SAMPLES = 4
RATE, FPS = 410, 25  # 16.4 samples a frame: frames of 16 and of 17
CLOSURES: list[list[tuple[int, int]]] = [[(0, 2), (3, 7)], [(0, 1)], [(4, 5), (5, 9), (20, 27)], [], [(1, 2)]]
IDENTITIES = [1, 0, 1, 0, 0]


@dataclass(frozen=True)
class Case:
    """One setting of one metric."""

    name: str
    make: Callable[[], Any]
    twin: Callable[..., Tensor]
    arguments: Callable[[Corpus, Sequence[int], int], dict[str, Any]]
    expected: Callable[[Corpus], float]

    def __str__(self) -> str:
        return self.name


# --- what to feed -----------------------------------------------------------------------------------------


def pair_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    """Absolute vertices of both sides."""
    batch: dict[str, Any] = corpus.batch(places, extra)
    batch.pop("template")
    return batch


def template_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    batch: dict[str, Any] = corpus.batch(places, extra)
    return batch


def offsets_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    """The same as offsets from the templates, in float64 so that nothing is rounded."""
    batch: dict[str, Any] = corpus.batch(places, extra)
    template = batch.pop("template").double()
    for side in ("prediction", "truth"):
        batch[side] = batch[side].double() - template[:, None]
    return batch | {"offsets_from": template}


def late_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    """Predictions two frames late, so that there is something to warp."""
    batch = pair_batch(corpus, places, extra)
    for row, frames in zip(batch["prediction"], batch["lengths"].tolist(), strict=True):
        row[:frames] = row[:frames].roll(2, 0)
    return batch


def closure_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    return pair_batch(corpus, places, extra) | {"closures": [CLOSURES[place] for place in places]}


def loudness(corpus: Corpus, place: int) -> Array:
    rng = np.random.default_rng(100 + place)
    return rng.uniform(0.1, 1, len(corpus.truths[place]))


def sound(corpus: Corpus, place: int) -> Array:
    frames = len(corpus.truths[place])
    envelope = np.repeat(loudness(corpus, place), 17)[: -(-frames * RATE // FPS)]
    return envelope * np.random.default_rng(200 + place).standard_normal(len(envelope))


def padded(rows: list[Array], width: int) -> Tensor:
    out = torch.full((len(rows), width), float("nan"), dtype=torch.float64)
    for row, values in zip(out, rows, strict=True):
        row[: len(values)] = torch.from_numpy(values)
    return out


def intensity_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    batch = pair_batch(corpus, places, extra)
    rows = [loudness(corpus, place) for place in places]
    return batch | {"intensity": padded(rows, batch["truth"].shape[1])}


def sound_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    rows = [sound(corpus, place) for place in places]
    return pair_batch(corpus, places, extra) | {"waveform": padded(rows, max(map(len, rows)) + extra)}


def identity_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    numbers = [IDENTITIES[place] for place in places]
    return intensity_batch(corpus, places, extra) | {"identities": torch.tensor(numbers)}


def several(corpus: Corpus, place: int) -> Array:
    """Predictions of one sequence, (samples, frames, vertices, 3)."""
    rng = np.random.default_rng(300 + place)
    noise = 0.003 * rng.standard_normal((SAMPLES, *corpus.truths[place].shape))
    return (corpus.predictions[place] + noise).astype(np.float32)


def samples_batch(corpus: Corpus, places: Sequence[int], extra: int, name: str = "samples") -> dict[str, Any]:
    batch = pair_batch(corpus, places, extra)
    frames, vertices = batch["truth"].shape[1:3]
    out = torch.full((len(places), SAMPLES, frames, vertices, 3), float("nan"))
    for row, place in enumerate(places):
        out[row, :, : len(corpus.truths[place])] = torch.from_numpy(several(corpus, place))
    batch.pop("prediction")
    return {name: out} | batch


def lone_samples_batch(corpus: Corpus, places: Sequence[int], extra: int, name: str = "samples") -> dict[str, Any]:
    batch = samples_batch(corpus, places, extra, name)
    batch.pop("truth")
    return batch


def partner_of(corpus: Corpus, place: int) -> Array:
    """Motion of whom each person talks with."""
    return np.random.default_rng(400 + place).standard_normal(corpus.truths[place].shape).astype(np.float32)


def partner_batch(corpus: Corpus, places: Sequence[int], extra: int) -> dict[str, Any]:
    batch = pair_batch(corpus, places, extra)
    partner = torch.full_like(batch["truth"], float("nan"))
    for row, place in zip(partner, places, strict=True):
        row[: len(corpus.truths[place])] = torch.from_numpy(partner_of(corpus, place))
    return batch | {"partner": partner}


# --- formulas ---------------------------------------------------------------------------------------------


def pooled(formula: Formula, pooling: str) -> Callable[[Corpus], float]:
    """Mean over what is weighed, or over sequences, of what a formula gives for each sequence."""

    def over(corpus: Corpus) -> float:
        found = [formula(corpus, place) for place in range(len(corpus.truths))]
        values = np.array([pair[0] for pair in found if pair is not None])
        weights = np.array([pair[1] for pair in found if pair is not None])
        return float(np.average(values, weights=weights if pooling == "frames" else None))

    return over


def sides(corpus: Corpus, place: int) -> tuple[Array, Array]:
    return corpus.predictions[place].astype(np.float64), corpus.truths[place].astype(np.float64)


def late_sides(corpus: Corpus, place: int) -> tuple[Array, Array]:
    p, g = sides(corpus, place)
    return np.roll(p, 2, axis=0), g


def vertex_error(
    corpus: Corpus, place: int, *, region: Sequence[int], reduction: str, squared: bool
) -> tuple[float, float]:
    p, g = sides(corpus, place)
    error = np.linalg.norm(g - p, axis=-1)[:, list(region)] ** (2 if squared else 1)
    frames = error.mean(1) if reduction == "mean" else error.max(1)
    return frames.mean(), len(g)


def dynamics_off(corpus: Corpus, place: int, *, sign: str) -> tuple[float, float]:
    p, g = (np.sum((x - corpus.templates[place]) ** 2, axis=-1)[:, UPPER] for x in sides(corpus, place))
    gap = np.std(g, axis=0).mean() - np.std(p, axis=0).mean()
    return float(gap if sign == "signed" else abs(gap)), 1


def opening(x: Array) -> Array:
    return np.mean([np.linalg.norm(x[:, a] - x[:, b], axis=-1) for a, b in PAIRS], axis=0)


def opening_difference(corpus: Corpus, place: int) -> tuple[float, float]:
    p, g = sides(corpus, place)
    return np.abs(opening(g) - opening(p)).mean(), len(g)


def closure_rate(corpus: Corpus, place: int, *, threshold: float, count: str, of: str) -> tuple[float, float] | None:
    p, g = map(opening, sides(corpus, place))
    limit = g.min() + threshold * (g.max() - g.min())
    if not CLOSURES[place]:
        return None

    def rate(o: Array) -> tuple[float, float]:
        hits = [[o[t] <= limit for t in range(start, end)] for start, end in CLOSURES[place]]
        counted = sum(hits, []) if count == "frames" else [any(closure) for closure in hits]
        return float(np.mean(counted)), len(counted)

    (of_p, weight), (of_g, _) = rate(p), rate(g)
    return {"prediction": of_p, "truth": of_g, "gap": of_p - of_g}[of], weight


def cheapest_path(distance: Array) -> list[tuple[int, int]]:
    """Dynamic time warping as the recursion reads."""

    @cache
    def cost(i: int, j: int) -> float:
        if i < 0 or j < 0:
            return 0.0 if i == j == -1 else float("inf")
        return float(distance[i, j]) + min(cost(i - 1, j - 1), cost(i - 1, j), cost(i, j - 1))

    for i in range(distance.shape[0]):  # so that the recursion stays shallow
        for j in range(distance.shape[1]):
            cost(i, j)
    i, j = distance.shape[0] - 1, distance.shape[1] - 1
    path = [(i, j)]
    while (i, j) != (0, 0):
        i, j = min([(i - 1, j - 1), (i - 1, j), (i, j - 1)], key=lambda cell: cost(*cell))
        path.append((i, j))
    return path[::-1]


def warped_distance(corpus: Corpus, place: int) -> tuple[float, float]:
    p, g = (x[:, LIPS] for x in late_sides(corpus, place))
    distance = np.sqrt(np.mean(np.sum((g[:, None] - p[None]) ** 2, axis=-1), axis=-1))
    path = cheapest_path(distance)
    return sum(distance[cell] for cell in path) / len(path), 1


def gaussian(x: Array, deviation: float) -> Array:
    radius = int(4 * deviation + 0.5)
    if not radius:
        return x
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / deviation) ** 2)
    return np.convolve(np.pad(x, radius, mode="symmetric"), weights / weights.sum(), mode="valid")


def turning_points(x: Array) -> dict[int, str]:
    """Inner frames above, or below, both neighbours; the corpus has no plateaus."""
    found = {}
    for t in range(1, len(x) - 1):
        if x[t - 1] < x[t] > x[t + 1]:
            found[t] = "max"
        if x[t - 1] > x[t] < x[t + 1]:
            found[t] = "min"
    return found


def misalignment(
    corpus: Corpus, place: int, *, at: str, smoothing: float, milliseconds: float
) -> tuple[float, float] | None:
    p, g = (gaussian(opening(x), smoothing) for x in late_sides(corpus, place))
    change_p, change_g = (np.diff(x, prepend=x[0]) for x in (p, g))
    path = cheapest_path(np.abs(change_g[:, None] - change_p[None]))
    turns_p, turns_g = turning_points(p), turning_points(g)
    lags = []
    for i, j in path:
        if at == "path":
            lags.append(abs(i - j))
        elif i in turns_g and turns_p.get(j) == turns_g[i]:
            before = max([t for t in turns_g if t < i], default=0)
            after = min([t for t in turns_g if t > i], default=len(g) - 1)
            if before <= j <= after:
                lags.append(abs(i - j))
    return (float(np.mean(lags)) * milliseconds, 1) if lags else None


def speed(x: Array) -> Array:
    return np.linalg.norm(np.diff(x[:, LIPS], axis=0), axis=-1).mean(axis=1)


def follows(reference: Array, other: Array) -> float | None:
    """Pearson's r; the corpus has no still face, so only short clips have none."""
    return float(np.corrcoef(reference, other)[0, 1]) if len(reference) > 1 else None


def opening_correlation(corpus: Corpus, place: int) -> tuple[float, float] | None:
    p, g = map(opening, sides(corpus, place))
    r = follows(g, p)
    return None if r is None else (r, 1)


def speed_correlation(corpus: Corpus, place: int) -> tuple[float, float] | None:
    p, g = map(speed, sides(corpus, place))
    r = follows(g, p)
    return None if r is None else (r, 1)


def frame_loudness(corpus: Corpus, place: int, *, given: str) -> Array:
    if given == "intensity":
        return loudness(corpus, place)
    samples, frames = sound(corpus, place), len(corpus.truths[place])
    edges = [int(np.floor(t * RATE / FPS + 0.5)) for t in range(frames + 1)]
    return np.array([np.sqrt(np.mean(samples[a:b] ** 2)) for a, b in zip(edges[:-1], edges[1:], strict=True)])


def clip_slcc(corpus: Corpus, *, of: str, n_identities: int) -> float:
    """As the released scripts go about it: standardise within each identity, then correlate what there is."""
    places = [place for place in range(len(corpus.truths)) if len(corpus.truths[place]) > 1]
    whose = np.array([IDENTITIES[place] if n_identities > 1 else 0 for place in places])

    def standard(x: list[float]) -> Array:
        values = np.array(x)
        for k in set(whose):
            values[whose == k] = (values[whose == k] - values[whose == k].mean()) / values[whose == k].std(ddof=1)
        return values

    given = "waveform" if n_identities == 1 else "intensity"
    s = standard([np.sqrt(np.mean(frame_loudness(corpus, place, given=given) ** 2)) for place in places])
    r = {}
    for side, name in enumerate(("prediction", "truth")):
        lips = standard([np.sqrt(np.mean(speed(sides(corpus, place)[side]) ** 2)) for place in places])
        r[name] = float(np.corrcoef(s, lips)[0, 1])
    return (r | {"gap": r["prediction"] - r["truth"]})[of]


def sample_lip_errors(corpus: Corpus, place: int, predictions: Array, squared: bool) -> Array:
    gap = corpus.truths[place].astype(np.float64) - predictions
    return (np.linalg.norm(gap[:, :, LIPS], axis=-1) ** (2 if squared else 1)).max(-1)


def mean_estimate(corpus: Corpus, place: int, *, squared: bool) -> tuple[float, float]:
    mean = several(corpus, place).astype(np.float64).mean(0, keepdims=True)
    return sample_lip_errors(corpus, place, mean, squared).mean(), len(corpus.truths[place])


def coverage(corpus: Corpus, place: int, *, squared: bool) -> tuple[float, float]:
    errors = sample_lip_errors(corpus, place, several(corpus, place).astype(np.float64), squared)
    return errors[errors.sum(1).argmin()].mean(), errors.shape[1]


def diversity(
    corpus: Corpus, place: int, *, pairs: list[tuple[int, int]], region: Sequence[int]
) -> tuple[float, float]:
    x = several(corpus, place).astype(np.float64)[:, :, list(region)]
    return float(np.mean([np.linalg.norm(x[a] - x[b], axis=-1).mean() for a, b in pairs])), x.shape[1]


def liveliness(corpus: Corpus, *, region: Sequence[int]) -> float:
    def moved(x: Array) -> float:
        x = x[:, list(region)]
        return float(((x - x.mean(0)) ** 2).sum())

    both = [sides(corpus, place) for place in range(len(corpus.truths))]
    return float(np.sqrt(sum(moved(p) for p, _ in both) / sum(moved(g) for _, g in both)))


def smoothness(corpus: Corpus, *, region: Sequence[int], of: str) -> float:
    """Frame step or difference ratio, by NumPy's differences."""

    def size(side: int, order: int) -> float:
        motions = [
            sides(corpus, place)[side][:, list(region)].astype(np.float64) for place in range(len(corpus.truths))
        ]
        return float(np.sqrt(sum((np.diff(x, order, axis=0) ** 2).sum() for x in motions)))

    step, ratio = size(0, 1) / size(1, 1), [size(side, 2) / size(side, 1) for side in (0, 1)]
    return {"step": step, "share": ratio[0] / ratio[1], "prediction": ratio[0], "truth": ratio[1]}[of]


def decibels_off(corpus: Corpus, *, octaves: int, region: Sequence[int]) -> float:
    """By the formula, with a sum over frames for every frequency."""
    powers = np.zeros((2, octaves))
    for place in range(len(corpus.truths)):
        for row, x in enumerate(sides(corpus, place)):
            x = x[:, list(region)].astype(np.float64).reshape(len(x), -1)
            t = np.arange(len(x))
            window = np.sin(np.pi * (t + 0.5) / len(x))
            windowed = (x - x.mean(0)) * window[:, None]
            for k in range(1, len(x)):
                share = min(k, len(x) - k) / (len(x) / 2)
                wave = np.exp(-2j * np.pi * k * t / len(x))
                octave = next((o for o in range(octaves - 1) if share > 2.0 ** -(o + 1)), octaves - 1)
                powers[row, octave] += (np.abs(wave @ windowed) ** 2).sum() / (window**2).sum()
    prediction, truth = np.maximum(powers, 1e-6 * powers[1].sum())
    return float(np.abs(10 * np.log10(prediction / truth)).mean())


def spread_over_error(corpus: Corpus, *, region: Sequence[int]) -> float:
    spread = error = 0.0
    for place in range(len(corpus.truths)):
        x = several(corpus, place).astype(np.float64)[:, :, list(region)]
        g = corpus.truths[place].astype(np.float64)[:, list(region)]
        pairs = list(combinations(range(SAMPLES), 2))
        spread += np.mean([np.linalg.norm(x[a] - x[b], axis=-1).mean(1).sum() for a, b in pairs])
        error += np.mean([np.linalg.norm(one - g, axis=-1).mean(1).sum() for one in x])
    return spread / error


def variance_over_error(corpus: Corpus, *, region: Sequence[int]) -> float:
    variance = error = 0.0
    for place in range(len(corpus.truths)):
        x = several(corpus, place).astype(np.float64)[:, :, list(region)]
        g = corpus.truths[place].astype(np.float64)[:, list(region)]
        variance += x.var(0, ddof=1).sum(-1).mean(1).sum()
        error += ((x.mean(0) - g) ** 2).sum(-1).mean(1).sum()
    return (1 + 1 / SAMPLES) * variance / error


def energy(corpus: Corpus, place: int, *, region: Sequence[int]) -> tuple[float, float]:
    x = several(corpus, place).astype(np.float64)[:, :, list(region)]
    g = corpus.truths[place].astype(np.float64)[:, list(region)]

    def distance(a: Array, b: Array) -> float:
        return float(np.sqrt(((a - b) ** 2).sum((1, 2)) / len(region)).mean())

    off = np.mean([distance(one, g) for one in x])
    return float(off - 0.5 * np.mean([distance(x[a], x[b]) for a, b in combinations(range(SAMPLES), 2)])), len(g)


def flat(x: Array, region: Sequence[int] = LIPS) -> Array:
    return x[:, list(region)].astype(np.float64).reshape(len(x), -1)


def one_side(corpus: Corpus, place: int, *, of: str, score: Callable[[Array], float]) -> tuple[float, float]:
    p, g = (score(flat(x)) for x in sides(corpus, place))
    return {"prediction": p, "truth": g, "gap": p - g}[of], 1


def variance(x: Array) -> float:
    return float(((x - x.mean(0)) ** 2).mean())


def pair_distance(x: Array) -> float:
    a, b = torch.randint(len(x), (2, 100), generator=torch.Generator().manual_seed(0)).numpy()
    return float(np.mean([np.linalg.norm(x[i] - x[j]) for i, j in zip(a, b, strict=True)]))


def spread_off(corpus: Corpus, place: int) -> tuple[float, float]:
    p, g = map(flat, sides(corpus, place))
    return float(100 * np.abs(np.std(p, axis=0) - np.std(g, axis=0)).mean()), 1


def steps_off(corpus: Corpus, place: int) -> tuple[float, float]:
    p, g = map(flat, sides(corpus, place))
    return float(np.sqrt(np.sum((np.diff(p, axis=0) - np.diff(g, axis=0)) ** 2 / 0.1))), 1


def residual_correlation(corpus: Corpus, place: int) -> tuple[float, float]:
    p, g = (flat(x).ravel() for x in sides(corpus, place))
    q = flat(partner_of(corpus, place)).ravel()
    return abs(np.corrcoef(g, q)[0, 1] - np.corrcoef(p, q)[0, 1]), 1


def frechet(corpus: Corpus, *, partner: bool, region: Sequence[int]) -> float:
    """By NumPy's covariance and SciPy's matrix root."""
    frames = []
    for side in (0, 1):
        motions = [flat(sides(corpus, place)[side], region) for place in range(len(corpus.truths))]
        if partner:
            others = [flat(partner_of(corpus, place), region) for place in range(len(corpus.truths))]
            motions = [np.concatenate(both, axis=1) for both in zip(others, motions, strict=True)]
        frames.append(np.concatenate(motions))
    a, b = (np.cov(x, rowvar=False) for x in frames)
    gap = frames[0].mean(0) - frames[1].mean(0)
    return float(gap @ gap + np.trace(a + b - 2 * np.real(linalg.sqrtm(a @ b))))


# --- the table --------------------------------------------------------------------------------------------


def _cases() -> list[Case]:
    cases: list[Case] = []
    subjects, poolings = ("prediction", "truth", "gap"), ("frames", "sequences")
    lips, upper, pairs, everything = {"lips": LIPS}, {"upper": UPPER}, {"pairs": PAIRS}, range(40)

    def add(
        cls: type,
        given: dict[str, Any],
        options: dict[str, Any],
        arguments: Callable[[Corpus, Sequence[int], int], dict[str, Any]],
        expected: Callable[[Corpus], float],
        extra: str = "",
        only_class: dict[str, Any] | None = None,
    ) -> None:
        """A class and the function of its name, for what is given with some options."""
        words = [cls.__name__, *(str(value) for value in options.values()), extra]
        twin = partial(getattr(fm, re.sub("(?<!^)([A-Z])", r"_\1", cls.__name__).lower()), **given, **options)
        make = partial(cls, **given, **options, **(only_class or {}))
        cases.append(Case("-".join(filter(None, words)), make, twin, arguments, expected))

    for reduction, squared, pooling in product(("mean", "max"), (True, False), poolings):
        shape: dict[str, Any] = {"reduction": reduction, "squared": squared}
        options = shape | {"pooling": pooling}
        expected = pooled(partial(vertex_error, region=UPPER, **shape), pooling)
        add(fm.MeanVertexError, {"region": UPPER}, options, pair_batch, expected, "region")
        expected = pooled(partial(vertex_error, region=everything, **shape), pooling)
        add(fm.MeanVertexError, {}, options, pair_batch, expected)
    for squared, pooling in product((True, False), poolings):
        options = {"squared": squared, "pooling": pooling}
        expected = pooled(partial(vertex_error, region=LIPS, reduction="max", squared=squared), pooling)
        add(fm.LipVertexError, lips, options, pair_batch, expected)
    for sign in ("signed", "absolute"):
        expected = pooled(partial(dynamics_off, sign=sign), "sequences")
        add(fm.FaceDynamicsDeviation, upper, {"sign": sign}, template_batch, expected)
    for pooling, (word, batch) in product(poolings, (("absolute", pair_batch), ("offsets", offsets_batch))):
        expected = pooled(opening_difference, pooling)
        add(fm.MouthOpeningDifference, pairs, {"pooling": pooling}, batch, expected, word)
    for count, of, pooling in product(("frames", "closures"), subjects, poolings):
        shape = {"threshold": 0.3, "count": count, "of": of}
        expected = pooled(partial(closure_rate, **shape), pooling)
        add(fm.BilabialClosureRate, pairs, shape | {"pooling": pooling}, closure_batch, expected)
    add(fm.LipWarpingDistance, lips, {}, late_batch, pooled(warped_distance, "sequences"))
    for at, smoothing, fps in (("extrema", 2.0, None), ("extrema", 0.0, 25), ("path", 0.0, None), ("path", 1.5, 30.0)):
        options = {"at": at, "smoothing": smoothing, "frames_per_second": fps}
        formula: Any = partial(misalignment, at=at, smoothing=smoothing, milliseconds=1000 / fps if fps else 1)
        add(fm.TemporalMisalignment, pairs, options, late_batch, pooled(formula, "sequences"))
    for word, batch in (("absolute", pair_batch), ("offsets", offsets_batch)):
        add(fm.LipOpeningCorrelation, pairs, {}, batch, pooled(opening_correlation, "sequences"), word)
    add(fm.LipSpeedCorrelation, lips, {}, pair_batch, pooled(speed_correlation, "sequences"))
    for of, n_identities in product(subjects, (1, 2)):
        expected = partial(clip_slcc, of=of, n_identities=n_identities)
        batch, only = identity_batch if n_identities > 1 else sound_batch, {"n_identities": n_identities}
        options = {"of": of} | ({"sample_rate": RATE, "frames_per_second": FPS} if n_identities == 1 else {})
        add(fm.ClipSpeechLipCorrelation, lips, options, batch, expected, str(n_identities), only)
    several_samples = {"n_samples": SAMPLES}
    for cls, make in ((fm.MeanEstimateError, mean_estimate), (fm.CoverageError, coverage)):
        for squared, pooling in product((True, False), poolings):
            expected = pooled(partial(make, squared=squared), pooling)
            options = {"squared": squared, "pooling": pooling}
            add(cls, lips, options, samples_batch, expected, only_class=several_samples)
    for pairing, pooling, region in product(("shuffled", "all"), poolings, (None, LIPS)):
        # Which halves are compared is tested on its own.
        compared = fm.SampleDiversity(pairing=pairing, n_samples=SAMPLES).pairs(SAMPLES)
        expected = pooled(partial(diversity, pairs=compared, region=region or everything), pooling)
        options, word = {"pairing": pairing, "pooling": pooling}, "region" if region else ""
        add(fm.SampleDiversity, {"region": region}, options, lone_samples_batch, expected, word, several_samples)
    for pooling in poolings:
        formula = partial(diversity, pairs=list(combinations(range(SAMPLES), 2)), region=everything)
        batch = partial(lone_samples_batch, name="predictions")
        add(fm.IdentityDiversity, {}, {"pooling": pooling}, batch, pooled(formula, pooling))
    for region in (None, LIPS):
        over, word = region or everything, "region" if region else ""
        of_region: dict[str, Any] = {"region": region}
        add(fm.MotionLiveliness, of_region, {}, pair_batch, partial(liveliness, region=over), word)
        add(fm.FrameStep, of_region, {}, pair_batch, partial(smoothness, region=over, of="step"), word)
        for side in ("share", "prediction", "truth"):
            expected = partial(smoothness, region=over, of=side)
            add(fm.DifferenceRatio, of_region, {"of": side}, pair_batch, expected, word)
        add(fm.SpectrumDistance, of_region, {}, pair_batch, partial(decibels_off, octaves=5, region=over), word)
        for options, ratio in (({}, spread_over_error), ({"squared": True}, variance_over_error)):
            expected = partial(ratio, region=over)
            add(fm.SpreadErrorRatio, of_region, options, samples_batch, expected, word, several_samples)
        for pooling in poolings:
            expected = pooled(partial(energy, region=over), pooling)
            add(fm.EnergyScore, of_region, {"pooling": pooling}, samples_batch, expected, word, several_samples)
    of_lips = {"region": LIPS}
    for of in subjects:
        for cls, score in ((fm.ChannelVariance, variance), (fm.FramePairDistance, pair_distance)):
            expected = pooled(partial(one_side, of=of, score=score), "sequences")
            add(cls, of_lips, {"of": of}, pair_batch, expected)
    for cls, formula in ((fm.ChannelDynamicsDeviation, spread_off), (fm.StepDistance, steps_off)):
        add(cls, of_lips, {}, pair_batch, pooled(formula, "sequences"))
    add(fm.ResidualPartnerCorrelation, of_lips, {}, partner_batch, pooled(residual_correlation, "sequences"))
    for partner, region in ((False, LIPS[:1]), (True, LIPS[:2])):
        batch, expected = partner_batch if partner else pair_batch, partial(frechet, partner=partner, region=region)
        add(fm.FrechetDistance, {"region": region}, {"with_partner": partner, "dims": 3}, batch, expected)
    return cases


CASES = _cases()
