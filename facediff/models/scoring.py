"""A corpus as metrics read it, for validation, test and generation metrics: regions, further files, decoded motion."""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor

from facediff.data import Assets, Batch, SpeechMotionDataModule
from facediff.data.batch import pad
from facediff.data.conversations import CONVERSATION, channel_regions, conversation_file
from facediff.data.corpus import EYELID_PAIRS
from facediff.data.speakers import MeanFaces, speaker_gallery
from facediff.errors import FaceDiffError
from facediff.metrics import Context, EyelidPairs, LipPairs, Region, device_name
from facediff.speech.audio import SAMPLE_RATE
from facediff.speech.phonemes import closures, phonemes_file, read_phonemes


def regions_of(assets: Assets) -> dict[str, Region]:
    """A corpus's regions by name, for metrics."""
    return {
        name: Region.from_indices(
            f"{assets.corpus}/{name if len(indices) < assets.n_vertices else 'all vertices'}",
            indices,
            n_vertices=assets.n_vertices,
        )
        for name, indices in assets.regions.items()
    }


class ScoredCorpus:
    """What scoring needs of a corpus in addition to its clips.

    Vertices are scored, also for channels, which their rig decodes; without a rig, channels are.
    """

    def __init__(
        self, data: SpeechMotionDataModule | None, assets: Assets, speakers: Sequence[str] | None = None
    ) -> None:
        self.data: Any = data
        self.assets = assets
        self.regions = regions_of(assets.scored)
        self.speakers = sorted(assets.templates) if speakers is None else list(speakers)

    @functools.cached_property
    def mean_faces(self) -> MeanFaces:
        """The mean face of each speaker's training clips."""
        return MeanFaces(self.data)

    def context(self, needs: Collection[str], device: torch.device) -> Context:
        """Inputs of metrics that the corpus has, and reasons why it lacks the rest.

        Args:
            needs: the metrics' inputs; the dear ones are made only where they are among them.
            device: where motion is generated.
        """
        data, assets = self.data, self.assets
        rate = {"frames_per_second": assets.frame_rate}
        has: dict[str, dict[str, Any]] = {
            "lips": {"lips": self.regions["lips"]},
            "upper_face": {"upper": self.regions["upper_face"]},
            "template": {},
            "speech": {"sample_rate": SAMPLE_RATE, **rate},
            "identities": {"n_identities": len(self.speakers)},
            "time": {"hardware": device_name(device)},
        }
        reasons = {
            "lip_pairs": "the corpus has no regions/inner_lip_pairs.txt",
            "lid_pairs": f"the corpus has no {EYELID_PAIRS}; list pairs of an upper and a lower eyelid vertex there, "
            "or in the file that data.eyelid_pairs names",
            "closures": f"{data.root / 'phonemes'}: no such folder",
            "channels": f"{assets.corpus} has vertices",
            "partner": f"no partner: {data.root / 'partner'} with <clip>.npy, (frames, channels), is not there",
            "speaking": f"{data.root / 'speaking'} with <clip>.npy, a boolean for each frame, is not there",
        }
        if (pairs := assets.scored.inner_lip_pairs) is not None:
            has["lip_pairs"] = {"pairs": LipPairs.from_pairs(f"{assets.corpus}/inner lips", pairs)}
        if "lid_pairs" in needs and (lids := data.eyelid_pairs()) is not None:
            has["lid_pairs"] = {"pairs": EyelidPairs.from_pairs(f"{data.corpus_name}/eyelids", lids), **rate}
        if "gallery" in needs:
            try:
                if not assets.scored.space.is_vertices:
                    raise FaceDiffError("no rig decodes the channels, and speakers are told apart by their faces")
                has["gallery"] = {"gallery": speaker_gallery(data, self.speakers, assets)}
            except FaceDiffError as error:
                reasons["gallery"] = str(error)
        if (data.root / "phonemes").is_dir():
            has["closures"] = {}
        if not assets.space.is_vertices:
            has["channels"] = {}
        has |= {need: {} for need in CONVERSATION if (data.root / need).is_dir()}
        return Context(has, reasons, channel_regions(assets.space))

    def decoded(self, motion: Tensor, names: Sequence[str]) -> Tensor:
        """Offsets of clips, (batch, …, points, dims), as in the scored motion."""
        if self.assets.rig is None:
            return motion
        return torch.stack([self.assets.to_scored(one, name) for one, name in zip(motion, names, strict=True)])

    def inputs(self, motion: Tensor, truth: Tensor, batch: Batch, needs: Collection[str]) -> dict[str, Any]:
        """Inputs of metrics from a batch, by the names of their arguments; see :data:`facediff.metrics.NEEDS`."""
        templates = batch.template
        if self.assets.rig is not None:
            templates = torch.stack([self.assets.scored.template(name) for name in batch.identity_names])
        inputs: dict[str, Any] = {
            "prediction": motion,
            "truth": truth,
            "lengths": batch.frame_lengths,
            "clip_names": batch.names,
            "offsets_from": templates.to(truth),
            "waveform": batch.audio,
        }
        if "identities" in needs:
            inputs["identities"] = self.numbers(batch)
        if "closures" in needs:
            files = [phonemes_file(self.data.root, clip) for clip in batch.names]
            rate = self.data.frame_rate
            inputs["closures"] = [[] if file is None else closures(read_phonemes(file), rate) for file in files]
        if "partner" in needs:
            inputs["partner"] = pad(self._conversation("partner", batch))[..., None].to(motion.device)
        if "speaking" in needs:
            inputs["speaking"] = self._conversation("speaking", batch)
        return inputs

    def numbers(self, batch: Batch) -> list[int]:
        """The number of each clip's speaker."""
        return [self.speakers.index(name) for name in batch.identity_names]

    def _conversation(self, folder: str, batch: Batch) -> list[Tensor]:
        """A conversation folder's recordings of each clip, for the frames that are read of the motion."""
        root, stride = self.data.root, self.data.corpus.stride
        return [torch.from_numpy(conversation_file(root, folder, clip, stride)) for clip in batch.names]
