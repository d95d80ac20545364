"""Models of every kind on one face: their motion for the same speech, and its cost.

A candidate is anything that :func:`facediff.load` opens, or a folder of motion that a model made elsewhere. Vertices of
the built-in topology and weights of ARKit's shapes are put on the face as they are; other meshes, FLAME's among them,
are carried over by a correspondence.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.editing.correspondence import Correspondence, correspond
from facediff.editing.landmarks import Landmarks
from facediff.editing.retargeting import by_shape_or_names, transfer, transfer_checked
from facediff.errors import FaceDiffError
from facediff.mesh import Mesh
from facediff.mesh.flame import Flame
from facediff.spaces import Space
from facediff.spaces.arkit import ARKIT
from facediff.spaces.files import even, read_parameters
from facediff.spaces.operations import at_rest, with_apples_mouth
from facediff.spaces.rigs import decode_flame
from facediff.spaces.rotations import convert
from facediff.synthetic.known_faces import is_built_in
from facediff.synthetic.spoken_set import SPEAKER, OpenFace, SpokenClip, SpokenMotion, open_face
from facediff.utils import SAMPLE_RATE, ranges

if TYPE_CHECKING:
    from facediff.animation.options import RecordingKeywords

Array = npt.NDArray[np.float64]

MOTION_SUFFIXES = (".csv", ".json", ".npz", ".npy")


@dataclass(frozen=True)
class Candidate:
    """A model, or motion from elsewhere.

    Attributes:
        name: that tables show.
        model: checkpoint, model folder, exported folder or folder of Audio2Face-3D; None for a folder of motion.
        motion: folder of files that are called as the clips are; None for a model.
        layout: of parameters in these files that do not say it; see :func:`facediff.spaces.layouts.layout`.
        frame_rate: frames a second of these files, where they do not say it.
    """

    name: str
    model: str | None = None
    motion: Path | None = None
    layout: str | None = None
    frame_rate: ranges.FrameRate | None = None


@dataclass(frozen=True, eq=False)
class CandidateMotion:
    """A candidate's motion for all clips."""

    candidate: Candidate
    clips: Mapping[str, SpokenMotion]
    frame_rate: float
    jaw: int | None  # the channel that opens it, of motion that is channels
    way: str  # in which it was put on the open face, or the reason why it was not
    licence: str
    commercial_use: str
    seconds: float | None = None  # of the processor for a second of speech, loading left out
    memory: float | None = None  # bytes that the process had at most


@dataclass
class Placement:
    """Puts animations of one candidate on the open face."""

    face: OpenFace
    flame: Flame | None = None
    way: str = ""
    jaw: int | None = None
    _correspondence: Correspondence | None = field(default=None, repr=False)

    def values(self, values: npt.NDArray[np.floating], space: Space) -> SpokenMotion:
        """Motion of channels (T, C)."""
        turn = next((turn for turn in space.rotations if turn.joint == "head"), None)
        head = None if turn is None else convert(values[:, list(turn.channels)], turn.form, "axis_angle")
        if space.kind == "arkit":
            self.way = "ARKit's shapes of the open face"
            return SpokenMotion(self._decoded(values, space), head)
        if space.kind == "flame" and self.flame is not None:
            still = values.copy()
            still[:, list(space.head)] = at_rest(space)[list(space.head)]
            vertices = decode_flame(self.flame, still, space).astype(np.float32)
            rest = np.asarray(self.flame.template, np.float32)
            animation = Animation("FLAME", vertices, rest, 25.0, faces=np.asarray(self.flame.faces, np.int32))
            self.way = "FLAME's vertices, carried over"
            return SpokenMotion(self._carried(animation), head)
        jaw = next((turn for turn in space.rotations if turn.joint == "jaw"), None)
        if jaw is None:
            raise FaceDiffError(
                f"its motion is {len(space.channels)} channels of {space.kind} that no face is known for"
            )
        self.jaw = space.face.index(jaw.start)
        reason = "no FLAME model was given (--flame)" if space.kind == "flame" else "nothing says what they move"
        self.way = f"channels alone, since {reason}: the mouth's opening is the jaw's turn, and lips are not seen"
        return SpokenMotion(values[:, list(space.face), None].astype(np.float64), head)

    def animation(self, animation: Animation) -> SpokenMotion:
        """Motion of an animation."""
        head = None if animation.head is None else animation.head[:, :3]
        kind = animation.space.kind
        as_channels = kind == "arkit" or (kind == "flame" and (self.flame is not None or animation.faces is None))
        if animation.values is not None and as_channels:
            clip = self.values(animation.values, animation.space)
            return clip if head is None else replace(clip, head=head)
        still = animation.still()
        if still.faces is None and self.flame is not None and len(still.template) == self.flame.n_vertices:
            still = replace(still, faces=np.asarray(self.flame.faces, np.int32))
        if still.faces is None and not is_built_in(len(still.template)):
            raise FaceDiffError("its vertices come without triangles, so that they cannot be put on another face")
        if is_built_in(len(still.template), still.faces):
            self.way = "the same topology"
            metres, points = metres_per_unit(still.unit), self.face.points
            moved = np.asarray(still.vertices[:, points], np.float64) - still.template[points]
            return SpokenMotion(self.face.rest + moved * metres, head)
        try:
            carried = self._carried(still)
        except FaceDiffError:
            if kind != "flame" or animation.values is None:
                raise
            # A mesh that is no face, as in a checkpoint without FLAME's: its channels are still something.
            return self.values(animation.values, animation.space)
        self.way = f"{len(still.template)} vertices, carried over"
        return SpokenMotion(carried, head)

    def _decoded(self, values: npt.NDArray[np.floating], space: Space) -> Array:
        """Weights of ARKit's shapes on the face; those that a space lacks are 0."""
        column = {name.casefold(): index for index, name in enumerate(space.channels)}
        weights = np.zeros((len(values), len(ARKIT)))
        for channel, name in enumerate(ARKIT):
            if name.casefold() in column:
                weights[:, channel] = values[:, column[name.casefold()]]
        rig = self.face.rig.only(ARKIT)
        return self.face.rest + np.tensordot(weights, rig.deltas[:, self.face.points], 1)

    def _carried(self, animation: Animation) -> Array:
        rig = self.face.rig
        faces = np.asarray(rig.faces, np.int64)
        target = Mesh(np.asarray(rig.neutral, np.float32), faces.astype(np.int32))

        def attempt(landmarks: Landmarks | None) -> tuple[Animation, Correspondence]:
            fitted = correspond(animation.template, animation.triangles, target.vertices, faces, landmarks=landmarks)
            carried, correspondence, report = transfer_checked(animation, fitted, target)
            if not report.good:
                raise FaceDiffError(f"its face could not be carried to the open one: {report.faults[0]}")
            return carried, correspondence

        if self._correspondence is None:
            carried, self._correspondence = by_shape_or_names(attempt, animation.template, target.vertices)
        else:
            carried = transfer(animation, self._correspondence, target)
        return np.asarray(carried.vertices[:, self.face.points], np.float64)


def perform(candidate: Candidate, clips: Sequence[SpokenClip], flame: Path | None) -> CandidateMotion | str:
    """A candidate's motion for the clips, or the reason why there is none.

    Meant for a process of its own, so that its memory is the candidate's.
    """
    try:
        placement = Placement(open_face(), None if flame is None else Flame.read(flame))
        return _read(candidate, clips, placement) if candidate.model is None else _animate(candidate, clips, placement)
    except FaceDiffError as error:
        return error.on_command_line


def _animate(candidate: Candidate, clips: Sequence[SpokenClip], placement: Placement) -> CandidateMotion:
    from facediff.pipelines.animator import load

    animator = load(candidate.model, device="cpu")
    faces = [*animator.identities, *animator.other_identities]
    options: RecordingKeywords = {"identity": SPEAKER} if SPEAKER in faces else {}
    motions: dict[str, SpokenMotion] = {}
    # The first call loads libraries, so it is not counted.
    animator.animate(clips[0].samples, SAMPLE_RATE, name="first", **options)
    processor_seconds = 0.0
    for clip in clips:
        started = time.process_time()
        animation = animator.animate(clip.samples, SAMPLE_RATE, name=clip.name, **options)
        processor_seconds += time.process_time() - started
        motions[clip.name] = placement.animation(animation)
    metadata = animation.metadata
    return CandidateMotion(
        candidate,
        motions,
        animation.frame_rate,
        placement.jaw,
        placement.way,
        metadata.get("licence", "unknown"),
        metadata.get("commercial_use", "unknown"),
        processor_seconds / sum(clip.seconds for clip in clips),
        peak_memory(),
    )


def _read(candidate: Candidate, clips: Sequence[SpokenClip], placement: Placement) -> CandidateMotion:
    from facediff.pipelines.motion import read

    folder = candidate.motion or Path()
    motions: dict[str, SpokenMotion] = {}
    frame_rate = None
    for clip in clips:
        files = [folder / f"{clip.name}{suffix}" for suffix in MOTION_SUFFIXES]
        file = next((file for file in files if file.is_file()), None)
        if file is None:
            raise FaceDiffError(
                f"{files[0].with_suffix('')}: no such motion; expected one of {', '.join(MOTION_SUFFIXES)}"
            )
        if candidate.layout is None and file.suffix in (".npz", ".npy"):
            animation = read(file, frame_rate=candidate.frame_rate)
            motions[clip.name], rate = placement.animation(animation), animation.frame_rate
        else:
            layout = candidate.layout if file.suffix in (".npz", ".npy") else None
            recorded = even(read_parameters(file, layout=layout, frame_rate=candidate.frame_rate))
            if layout == "audio2face":  # tables are read so already
                recorded = replace(recorded, values=with_apples_mouth(recorded.values, recorded.space.channels))
            motions[clip.name], rate = placement.values(recorded.values, recorded.space), recorded.frame_rate
        if frame_rate is not None and abs(rate - frame_rate) > 1e-6 * rate:
            raise FaceDiffError(
                f"{file}: has {rate:g} frames a second and the files before it {frame_rate:g}; use one rate"
            )
        frame_rate = rate
    return CandidateMotion(
        candidate,
        motions,
        frame_rate or 25.0,
        placement.jaw,
        placement.way,
        "unknown",
        "unknown",
    )


def peak_memory() -> float | None:
    """The most bytes that this process had in memory."""
    if sys.platform == "win32":
        return None
    import resource  # which Windows does not have

    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)
