"""What is measured on the training motion before training starts: its scale and its principal components.

Both look at a few frames of every training clip. Each clip's file is opened once for them, the results are kept on disk
until the corpus changes, and of several training processes one measures and the others receive what it found: on
network storage, where opening a file takes milliseconds, starting would take minutes otherwise.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff.errors import FaceDiffError
from facediff.utils.arrays import ArrayStore
from facediff.utils.files import cache_dir

if TYPE_CHECKING:
    from facediff.data.datamodule import SpeechMotionDataModule

FRAMES = 16
"""Frames of each training clip, evenly spread, from which size and principal components of motion are measured."""

PRINCIPAL_NUMBERS = 30_000_000
"""Coordinates from which principal components are computed, about; bounds the memory (8 bytes each, twice)."""

METHOD = 1
"""Goes up when the same corpus is measured in another way, so that what was kept before is not used."""


def measure_scale(data: SpeechMotionDataModule) -> float:
    """One over the root mean square of the training motion's coordinates.

    Raises:
        FaceDiffError: if the training clips hold no motion at all.
    """

    def measure() -> npt.NDArray[np.float64]:
        total, count = 0.0, 0
        for motion in _spread_frames(data, FRAMES):
            for frame in motion:
                total += float(frame.double().square().sum())
                count += frame.numel()
        if not total:
            raise FaceDiffError(f"{data.root}: the training split holds no motion at all; check vertices_npy/")
        return np.array([(count / total) ** 0.5])

    return float(_measured(data, ("scale", FRAMES), measure)[0])


def measure_components(data: SpeechMotionDataModule, count: int, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """Mean (3V,) and principal components (at most ``count``, 3V) of the training motion."""
    weighted = "" if weights is None else hashlib.sha256(weights.detach().cpu().numpy().tobytes()).hexdigest()

    def measure() -> npt.NDArray[np.float32]:
        each = max(2, PRINCIPAL_NUMBERS // (3 * data.n_vertices * max(1, len(data.clips("train")))))
        frames = torch.cat([motion.flatten(1) for motion in _spread_frames(data, min(each, FRAMES))]).double()
        mean = frames.mean(0)
        frames -= mean
        if weights is not None:
            frames *= weights.cpu()
        # The eigenvectors of the frames' products with one another give the same components as those of the
        # covariance, which for a large mesh would not fit into memory. The smaller of the two is decomposed.
        few = len(frames) <= frames.shape[1]
        values, vectors = torch.linalg.eigh(frames @ frames.T if few else frames.T @ frames)
        kept = [i for i in reversed(range(len(values))) if values[i] > 1e-10 * values[-1]][:count]
        if few:
            shapes = vectors[:, kept].T @ frames / len(frames) ** 0.5
        else:
            shapes = vectors[:, kept].T * (values[kept, None] / len(frames)).sqrt()
        return torch.cat([mean[None], shapes]).float().numpy()

    found = torch.from_numpy(
        np.array(_measured(data, ("components", FRAMES, PRINCIPAL_NUMBERS, count, weighted), measure))
    )
    return found[0], found[1:]


def _spread_frames(data: SpeechMotionDataModule, count: int) -> Iterator[Tensor]:
    """At most ``count`` evenly spread frames (n, V, 3) of every training clip."""
    for clip in data.clips("train"):
        yield data.corpus.read_spread(clip, count)


def _measured(
    data: SpeechMotionDataModule, what: tuple[object, ...], measure: Callable[[], npt.NDArray[Any]]
) -> npt.NDArray[Any]:
    """An array that the training motion decides: received from the first process, read from disk, or measured."""

    def find() -> npt.NDArray[Any]:
        store = ArrayStore(cache_dir() / "measured")
        key = store.key(METHOD, *what, data.n_vertices, data.corpus.fingerprint(data.clips("train")))
        kept = store.get(key)
        return store.put(key, measure()) if kept is None else np.array(kept)

    trainer = data.trainer
    if trainer is None or trainer.world_size == 1:
        return find()
    # A process that failed alone would leave the others waiting, so what went wrong is shared as well.
    found: npt.NDArray[Any] | str = ""
    if trainer.global_rank == 0:
        try:
            found = find()
        except FaceDiffError as error:
            found = str(error)
    found = trainer.strategy.broadcast(found, src=0)
    if isinstance(found, str):
        raise FaceDiffError(found)
    return found
