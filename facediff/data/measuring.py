"""Statistics of the training motion that are computed before training: its scale and its principal components.

Both read a few frames of every training clip. On network storage, where opening a file takes milliseconds, that could
delay the start of training by minutes. So each clip is opened once, the results are cached on disk until the corpus
changes, and of several training processes only the first measures and broadcasts its result.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from lightning.pytorch import Trainer
from torch import Tensor

from facediff.data.corpus import Clip, Corpus
from facediff.errors import FaceDiffError
from facediff.utils.arrays import ArrayStore
from facediff.utils.files import cache_dir

FRAMES = 16
"""Frames of each training clip, evenly spread, from which size and principal components of motion are measured."""

WINDOWS = 4
"""Windows, end to end, that are read of each training clip for its covariance over time."""

PRINCIPAL_NUMBERS = 30_000_000
"""Coordinates from which principal components are computed, about; bounds the memory (8 bytes each, twice)."""

GOLDEN = (5**0.5 - 1) / 2
"""Multiples of it, without their whole parts, fill the numbers from 0 to 1 evenly."""

METHOD = 3
"""Goes up when the same corpus is measured in another way, so that results cached by an older version are not used."""


def measure_scale(corpus: Corpus, clips: Sequence[Clip], trainer: Trainer | None) -> float:
    """One over the root mean square of the motion's coordinates.

    Args:
        corpus: the corpus.
        clips: its training clips.
        trainer: its processes share the result; None outside training.
    """

    def measure() -> npt.NDArray[np.float64]:
        total, count = 0.0, 0
        for clip in clips:
            for frame in corpus.read_spread(clip, FRAMES):
                total += float(frame.double().square().sum())
                count += frame.numel()
        return np.array([(count / total) ** 0.5])

    return float(_measured(corpus, clips, trainer, ("scale", FRAMES), measure)[0])


def measure_components(
    corpus: Corpus, clips: Sequence[Clip], trainer: Trainer | None, count: int, weights: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Mean (n,) and principal components (at most ``count``, n) of the motion's n coordinates; arguments as above.

    ``weights`` are factors on the coordinates (n,), or a matrix (n, n) that is applied to them.
    """
    weighted = "" if weights is None else hashlib.sha256(weights.detach().cpu().numpy().tobytes()).hexdigest()

    def measure() -> npt.NDArray[np.float32]:
        coordinates = corpus.dims * corpus.n_vertices * max(1, len(clips))
        frames_per_clip = min(FRAMES, max(2, PRINCIPAL_NUMBERS // coordinates))
        # Clips begin and end in silence. Of a large mesh only two frames of each are read: in every clip at another
        # place, so that together they lie everywhere.
        spread = [
            corpus.read_spread(clip, frames_per_clip, phase=GOLDEN * number % 1).flatten(1)
            for number, clip in enumerate(clips, start=1)
        ]
        frames = torch.cat(spread).double()
        mean = frames.mean(0)
        frames -= mean
        if weights is not None and weights.dim() == 2:
            frames = frames @ weights.T.cpu().double()
        elif weights is not None:
            frames *= weights.cpu()
        # The eigenvectors of the frames' products with one another give the same components as the eigenvectors of the
        # covariance, which for a large mesh would not fit into memory. The smaller of the two is decomposed.
        few = len(frames) <= frames.shape[1]
        values, vectors = torch.linalg.eigh(frames @ frames.T if few else frames.T @ frames)
        largest = [i for i in reversed(range(len(values))) if values[i] > 1e-10 * values[-1]][:count]
        if few:
            shapes = vectors[:, largest].T @ frames / len(frames) ** 0.5
        else:
            shapes = vectors[:, largest].T * (values[largest, None] / len(frames)).sqrt()
        return torch.cat([mean[None], shapes]).float().numpy()

    what = ("components", FRAMES, PRINCIPAL_NUMBERS, count, weighted)
    components = torch.from_numpy(np.array(_measured(corpus, clips, trainer, what, measure)))
    return components[0], components[1:]


def measure_windows(
    corpus: Corpus,
    clips: Sequence[Clip],
    trainer: Trainer | None,
    project: Callable[[Tensor], Tensor],
    width: int,
) -> Tensor:
    """Covariance (K, width, width) of K projections of the motion over the frames of a window, about zero.

    Over windows and not from autocovariances, which in clips of a few seconds leak a hundredth of the power of the slow
    movement into the highest frequencies, more than there is.
    """
    probe = torch.randn(1, 2, corpus.n_vertices, corpus.dims, generator=torch.Generator().manual_seed(0))
    projected = hashlib.sha256(project(probe).detach().cpu().numpy().tobytes()).hexdigest()

    def measure() -> npt.NDArray[np.float64]:
        total, count = torch.zeros((), dtype=torch.float64), 0
        shapes: dict[str, Tensor] = {}
        for clip in clips:
            motion = corpus.read_projected(clip, lambda offsets: project(offsets[None])[0], shapes).double()
            # From the middle of long clips: a part of each tells as much as all of it.
            first = max(0, (len(motion) - WINDOWS * width) // 2)
            if len(motion) >= width:
                windows = motion[first : first + WINDOWS * width].unfold(0, width, 1).permute(1, 2, 0).contiguous()
                total = total + windows @ windows.mT
                count += windows.shape[2]
        if not count:
            raise FaceDiffError(
                f"{corpus.root}: no training clip lasts {width} frames; choose a smaller motion_space.prior_frames"
            )
        return (total / count).numpy()

    what = ("windows", WINDOWS, width, projected)
    return torch.from_numpy(np.array(_measured(corpus, clips, trainer, what, measure)))


def _measured(
    corpus: Corpus,
    clips: Sequence[Clip],
    trainer: Trainer | None,
    what: tuple[object, ...],
    measure: Callable[[], npt.NDArray[Any]],
) -> npt.NDArray[Any]:
    """An array that depends on the training motion only: received from the first process, cached, or measured."""

    def read_or_measure() -> npt.NDArray[Any]:
        store = ArrayStore(cache_dir() / "measured")
        key = store.key(METHOD, *what, corpus.n_vertices, corpus.fingerprint(clips))
        cached = store.get(key)
        return store.put(key, measure()) if cached is None else np.array(cached)

    if trainer is None or trainer.world_size == 1:
        return read_or_measure()
    # If the first process failed alone, the others would wait for ever, so its error is broadcast as well.
    measured: npt.NDArray[Any] | str = ""
    failure: Exception | None = None
    if trainer.global_rank == 0:
        try:
            measured = read_or_measure()
        except Exception as error:
            measured, failure = f"the first process failed: {error!r}", error
    measured = trainer.strategy.broadcast(measured, src=0)
    if isinstance(measured, str):
        raise failure or FaceDiffError(measured)
    return measured
