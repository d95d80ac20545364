"""What an import did, for people and for the manifest."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Report:
    """What an import did. Lengths are in the unit of the corpus unless said otherwise.

    Attributes:
        name: the person.
        frames: frames that were read.
        seconds: how long they last.
        frame_rate: their frames a second.
        corpus_frame_rate: frames a second that were written.
        has_head_motion: whether there was head motion to remove; parameters without global pose have none.
        rotation_max: largest angle of the head from its mean pose, in degrees.
        rotation_rms: root mean square of these angles, in degrees.
        translation_max: largest distance of the head from its mean place.
        translation_rms: root mean square of these distances.
        stable_vertices: how many vertices told the head's motion.
        stable_source: where they are from.
        jitter: root-mean-square distance of the stable vertices from their median, head motion removed.
        scale: corpus units to a unit of the motion, as used.
        measured_scale: the same, as measured between the person's neutral face and the corpus's mean face.
        topology_residual: what is left between these two, as a share of the face's size.
        faces_compared: whether the triangles were compared as well.
        template_source: where the neutral face is from.
        template_frames: the frames it is the median of; empty if it was given.
        mismatch: seconds by which sound outlasts motion (negative: motion outlasts sound).
        clips: clips that were written.
        splits: how many of them in each split.
        frames_written: frames that were written.
        warnings: what the user should look at.
        notes: other remarks.
    """

    name: str
    frames: int
    seconds: float
    frame_rate: float
    corpus_frame_rate: float
    has_head_motion: bool
    rotation_max: float
    rotation_rms: float
    translation_max: float
    translation_rms: float
    stable_vertices: int
    stable_source: str
    jitter: float
    scale: float
    measured_scale: float
    topology_residual: float
    faces_compared: bool
    template_source: str
    template_frames: list[int]
    mismatch: float
    clips: int
    splits: dict[str, int]
    frames_written: int
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def state(self) -> dict[str, Any]:
        """Plain data, for the manifest."""
        return asdict(self)

    def lines(self, unit: str | None) -> list[str]:
        """The report in words.

        Args:
            unit: the corpus's unit of length; "corpus units" if None.
        """
        of = unit or "corpus units"
        splits = ", ".join(f"{count} {split}" for split, count in self.splits.items())
        compared = "triangles equal" if self.faces_compared else "triangles not compared"
        told = f"told by {self.stable_vertices} vertices {self.stable_source}"
        head = [
            ("rotation removed", f"at most {self.rotation_max:.3f}°, RMS {self.rotation_rms:.3f}°"),
            ("translation removed", f"at most {self.translation_max:.4g} {of}, RMS {self.translation_rms:.4g} {of}"),
        ]
        none = [("head motion", "none in it: the parameters' global pose is left out")]
        rows = [
            ("read", f"{self.frames} frames at {self.frame_rate:g} frames/s, {self.seconds:.2f} s"),
            *(head if self.has_head_motion else none),
            ("stable vertices", f"{told}; they still jitter by {self.jitter:.3g} {of} RMS"),
            ("scale", f"{self.scale:.6g} (measured {self.measured_scale:.6g})"),
            ("topology", f"residual {self.topology_residual:.3f} of the face's size, {compared}"),
            ("template", self.template_source),
            (
                "sound and motion",
                f"sound is {abs(self.mismatch):.2f} s {'longer' if self.mismatch >= 0 else 'shorter'}",
            ),
            ("written", f"{self.clips} clips ({splits}), {self.frames_written} frames at {self.corpus_frame_rate:g}/s"),
        ]
        return [
            *(f"{title:<21}{text}" for title, text in rows),
            *(f"note: {note}" for note in self.notes),
            *(f"warning: {warning}" for warning in self.warnings),
        ]
