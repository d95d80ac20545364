"""Statistics of speakers: the mean face of each speaker, and the mean motion of each recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from facediff.data.batch import Assets
from facediff.data.corpus import Clip
from facediff.errors import FaceDiffError
from facediff.metrics import SpeakerGallery

if TYPE_CHECKING:
    from facediff.data.datamodule import SpeechMotionDataModule

MOST = 64
"""Most recordings of a speaker that are read, evenly spread over their names: more would take minutes and change the
mean little."""


class MeanFaces:
    """The mean face of each speaker: the mean offset from the template over all frames of their training clips.

    A speaker without training clips has the mean of all training speakers' mean faces.

    Args:
        data: the corpus.
    """

    def __init__(self, data: SpeechMotionDataModule) -> None:
        clips_of: dict[str, list[Clip]] = {}
        for clip in data.clips("train"):
            clips_of.setdefault(clip.identity, []).append(clip)
        self.faces: dict[str, Tensor] = {}
        for speaker, clips in clips_of.items():
            clips = spread(clips)
            frames = [data.corpus.frames(clip) for clip in clips]
            total = torch.zeros(data.n_vertices, data.space.dims, dtype=torch.float64)
            for clip, count in zip(clips, frames, strict=True):
                total += count * data.corpus.mean_motion(clip)
            self.faces[speaker] = (total / sum(frames)).float()
        self.of_all = torch.stack(list(self.faces.values())).mean(0)

    def of(self, speakers: Sequence[str]) -> Tensor:
        """Their mean faces, offsets (speakers, V, dims)."""
        return torch.stack([self.faces.get(speaker, self.of_all) for speaker in speakers])


def speaker_gallery(data: SpeechMotionDataModule, speakers: Sequence[str], assets: Assets) -> SpeakerGallery:
    """Recordings outside the evaluated splits of the speakers who have any, each with its speaker's number.

    Args:
        data: the corpus.
        speakers: their names, by number.
        assets: of the corpus; channels are decoded by its rig, where it has one.
    """
    candidates = data.reference_policy().candidates
    means, numbers = [], []
    for number, speaker in enumerate(speakers):
        usable = [clip for clip in candidates.get(speaker, []) if data.find_split(clip) in ("train", None)]
        for clip in spread(usable):
            mean = data.corpus.mean_motion(clip).float()
            means.append(assets.to_scored(mean, speaker))
            numbers.append(number)
    if len({*numbers}) < 2:
        raise FaceDiffError(
            f"{data.root}: has recordings outside the test splits of fewer than two speakers; expected two or more"
        )
    return SpeakerGallery(torch.stack(means), tuple(numbers))


def spread(clips: Sequence[Clip]) -> list[Clip]:
    """At most :data:`MOST` of the clips, evenly spread."""
    if len(clips) <= MOST:
        return list(clips)
    return [clips[int(index)] for index in torch.linspace(0, len(clips) - 1, MOST).round()]
