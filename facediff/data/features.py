"""Features of an audio encoder's frozen part, kept on disk, one array a clip."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from facediff.data.corpus import Clip, Corpus
from facediff.data.store import ArrayStore


class FeatureSlot:
    """Where cached features are looked for when a sample is read; may be filled after the loaders were made."""

    def __init__(self) -> None:
        self.reader: Callable[[Clip], Tensor | None] | None = None

    def __call__(self, clip: Clip) -> Tensor | None:
        """The features of a clip, if there are any."""
        return None if self.reader is None else self.reader(clip)


class CachedFeatures:
    """Reads the features of clips whose speech has been encoded before.

    Args:
        store: where they lie.
        encoder_key: what decides the features beside the speech: weights, layer, precision.
    """

    def __init__(self, store: ArrayStore, encoder_key: str) -> None:
        self.store = store
        self.encoder_key = encoder_key
        self._keys: dict[str, str] = {}

    def add(self, corpus: Corpus, clip: Clip) -> Tensor | None:
        """Take a clip up; its whole speech (samples,) if that has yet to be encoded, None if its features are there."""
        audio = corpus.read_audio(clip, 0, corpus.frames(clip))
        key = self.store.key(self.encoder_key, hashlib.sha256(audio.numpy().tobytes()).hexdigest())
        self._keys[clip.name] = key
        return audio if self.store.get(key) is None else None

    def put(self, clip: Clip, features: Tensor) -> None:
        """Keep the features (steps, channels) of a clip that was taken up."""
        self.store.put(self._keys[clip.name], features.detach().float().cpu().numpy())

    def __call__(self, clip: Clip) -> Tensor | None:
        """The features (steps, channels) of a clip's whole speech; None for a clip that was not taken up."""
        key = self._keys.get(clip.name)
        stored = None if key is None else self.store.get(key)
        return None if stored is None else torch.from_numpy(np.array(stored, np.float32))
