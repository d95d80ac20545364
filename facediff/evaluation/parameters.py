"""Files of motion in parameters that are scored: read in one order of channels, and decoded to vertices by a rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from facediff.data.conversations import channel_regions
from facediff.data.corpus import MOTION_FOLDERS
from facediff.errors import FaceDiffError
from facediff.evaluation.scoring import Motion
from facediff.mesh.flame import Flame
from facediff.metrics import PROTOCOLS, Protocol, Region
from facediff.spaces import Space
from facediff.spaces.files import ParameterClip, even, read_parameters
from facediff.spaces.files.reading import ARRAYS, SUFFIXES
from facediff.spaces.operations import at_rest, permuted, with_rotations
from facediff.spaces.rigs import LinearRig, decode_flame

AnyRig = LinearRig | Flame


def holds_parameters(folder: Path) -> bool:
    """Whether a folder's files name their channels or arrays, so that they can only be parameters."""
    if any((folder / name).is_dir() for name in MOTION_FOLDERS):
        return False
    suffixes = {path.suffix.lower() for path in folder.iterdir()} if folder.is_dir() else set()
    return ".npy" not in suffixes and bool(suffixes & {*SUFFIXES})


@dataclass(frozen=True)
class ParameterFiles:
    """How files of one evaluation are read."""

    space: Space  # the truth's, with the order of channels in all scores
    frame_rate: float  # of the truth as it is scored
    # Of the predictions' and of the truth's arrays; None for files that name their channels
    layouts: tuple[str | None, str | None]
    truth: Path  # folder of the truth
    rig: AnyRig | None = None  # decodes channels to vertices; None where only channels are scored
    predictions: tuple[Path, ...] = ()  # folders of the predictions, which may lie in the truth's

    @classmethod
    def begin(
        cls, truth: Path, layouts: tuple[str | None, str | None], rig: Path | None, stride: int
    ) -> ParameterFiles:
        """Space and frame rate from the first file of a folder of truths; every ``stride``-th frame is scored."""
        files = sorted(
            path for path in truth.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
        )
        if not files:
            raise FaceDiffError(f"{truth}: holds no {' or '.join(SUFFIXES)} file; expected motion in parameters")
        first = _read(files[0], layouts[1])
        opened: AnyRig | None = None
        if rig is not None:
            opened = Flame.read(rig) if first.space.kind == "flame" else LinearRig.read(rig)
        if isinstance(opened, LinearRig):
            shared = [name for name in opened.names if name in first.space.channels]
            if not shared:
                raise FaceDiffError(
                    f"{rig}: has none of the channels of {files[0]}; give a rig with shapes of these names"
                )
            opened = opened.only(shared)
        return cls(first.space, first.frame_rate / stride, layouts, truth, opened)

    @property
    def unit(self) -> str:
        """The rig's unit of length; empty if it is not known."""
        return "m" if isinstance(self.rig, Flame) else self.rig.unit if self.rig is not None else ""

    @property
    def n_points(self) -> int:
        """Vertices of the rig, or channels without one."""
        return len(self.space.channels) if self.rig is None else len(self._neutral(self.rig))

    def _neutral(self, rig: AnyRig, person: npt.NDArray[np.floating] | None = None) -> npt.NDArray[np.float64]:
        """The face at rest (V, 3), of the person in FLAME's files where they name one."""
        if isinstance(rig, LinearRig):
            return rig.neutral
        return rig.template if person is None else rig.shaped(person)

    def read(self, path: Path, stride: int) -> Motion:
        """Channels of a file in the order of the space, and the vertices of a face that does not turn its head."""
        inside = [folder for folder in self.predictions if folder != self.truth and folder.is_relative_to(self.truth)]
        is_truth = path.is_relative_to(self.truth) and not any(map(path.is_relative_to, inside))
        clip = even(_read(path, self.layouts[1 if is_truth else 0]))
        if abs(clip.frame_rate / stride - self.frame_rate) > 0.01 * self.frame_rate:
            raise FaceDiffError(
                f"{path}: has {clip.frame_rate:g} frames a second, the truth {self.frame_rate:g}; resample it, or give "
                f"--truth-stride"
            )
        values: npt.NDArray[np.floating] = clip.values
        space = clip.space
        for turn in self.space.rotations:
            stored = next((rotation for rotation in space.rotations if rotation.joint == turn.joint), turn)
            if stored.form != turn.form:
                values, space = with_rotations(values, space, turn.form, (turn.joint,))
        values, space = permuted(values, space, self.space)
        lacking = sorted(set(space.absent) - set(self.space.absent))
        if lacking:
            raise FaceDiffError(f"{path}: lacks the channels {', '.join(lacking[:4])} of the truth; absent is not zero")
        values = values[::stride]
        channels = torch.from_numpy(np.ascontiguousarray(values, np.float32))[..., None]
        if self.rig is None:
            return Motion(None, channels)
        still = np.array(values, np.float64)
        still[:, list(self.space.head)] = at_rest(self.space)[list(self.space.head)]
        if isinstance(self.rig, Flame):
            vertices = decode_flame(self.rig, still, self.space, clip.identity)
        else:
            columns = [self.space.index(name) for name in self.rig.names]
            vertices = self.rig.decode(still[:, columns])
        template = torch.from_numpy(np.asarray(self._neutral(self.rig, clip.identity), np.float32))
        return Motion(torch.from_numpy(vertices.astype(np.float32)), channels, template)

    def regions(self, **stated: object) -> dict[str, Region]:
        """Lips and upper face: vertices of a linear rig that their channels move at least half as far as any.

        Without a rig, channels; FLAME's must be stated.

        Args:
            stated: regions that a file states, by name, which are left out.
        """
        if self.rig is None:
            return channel_regions(self.space)
        if isinstance(self.rig, Flame):
            return {}
        regions = {}
        for name in ("lips", "upper_face"):
            if stated.get(name):
                continue
            channels = {self.space.channels[channel] for channel in self.space.groups[name]}
            rows = [row for row, channel in enumerate(self.rig.names) if channel in channels]
            if not rows:
                continue
            sizes = np.linalg.norm(self.rig.deltas[rows], axis=-1).max(0)
            count = len(sizes)
            regions[name] = Region.from_indices(
                f"{self.rig.title}/{name}", np.flatnonzero(sizes >= sizes.max() / 2).tolist(), n_vertices=count
            )
        return regions


def _read(path: Path, layout: str | None) -> ParameterClip:
    return read_parameters(path, layout=layout if path.suffix.lower() in ARRAYS else None)


def refuse_vertex_protocols(protocols: Sequence[Protocol]) -> None:
    """Refuse protocols of vertices where there is no rig."""
    for protocol in protocols:
        if protocol.needs_vertices:
            of_channels = ", ".join(name for name, one in PROTOCOLS.items() if not one.needs_vertices)
            raise FaceDiffError(
                f"protocol {protocol.name} scores vertices, and no rig decodes these files; give --rig FILE, or a "
                f"--protocol of channels: {of_channels}"
            )
