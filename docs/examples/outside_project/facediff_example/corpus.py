"""A corpus in the field's usual folder layout."""

from __future__ import annotations

from typing import ClassVar

from facediff.data import Clip, SpeechMotionDataModule


class ThreeSpeakers(SpeechMotionDataModule):
    """Seven sentences of three speakers with small faces: 1 to 4 train, 5 validates, 6 and 7 test; C is unseen."""

    corpus_name: ClassVar[str] = "three_speakers"
    unit = "m"
    frame_rate: ClassVar[float] = 25.0
    n_vertices = 24
    identities = ["A", "B"]  # noqa: RUF012 - the base class types it as an instance's
    mesh_files: ClassVar[tuple[str, ...]] = ("tiny.ply",)

    def split_of(self, clip: Clip) -> str | None:
        """By speaker and sentence number."""
        seen = clip.identity in ("A", "B")
        if clip.number >= 6:
            return "test_a" if seen else "test_b"
        if not seen:
            return None
        return "val" if clip.number == 5 else "train"
