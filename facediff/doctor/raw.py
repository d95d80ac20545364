"""Recognising what is not a corpus yet: data sets as they are distributed."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

LOOKED_FOR = {
    "biwi": ("faces/*/*/frame_*.vl",),
    "vocaset": ("data_verts.npy", "subj_seq_to_idx.pkl"),
    "mead3d": (
        "*/front/*/*/*/shape_pose_cam.hdf5",
        "*/*/front/*/*/*/shape_pose_cam.hdf5",
        "param/*.npy",
        "mead/param/*.npy",
        "datasets/mead/param/*.npy",
    ),
}
"""Files that a raw distribution has, by the name under which ``facediff data prepare`` knows it."""

BASES = 100
"""Folders in the raw folder that are looked into: one of them may be what an archive unpacked to."""


def raw_distribution(root: Path) -> tuple[str, str] | None:
    """The data set whose raw distribution a folder holds, and the file that tells it; None if it holds none."""
    for base in _bases(root):
        for corpus, patterns in LOOKED_FOR.items():
            for pattern in patterns:
                found = _first(base, pattern)
                if found is not None:
                    return corpus, found.relative_to(root).as_posix()
    return None


def prepare_command(corpus: str, root: Path) -> str:
    """What to run to make a corpus folder of a raw distribution."""
    return f"facediff data prepare {corpus} {root} OUT" + (" --flame MODEL" if corpus == "mead3d" else "")


def _bases(root: Path) -> Iterator[Path]:
    yield root
    try:
        yield from islice((path for path in sorted(root.iterdir()) if path.is_dir()), BASES)
    except OSError:
        return


def _first(base: Path, pattern: str) -> Path | None:
    try:
        return next(base.glob(pattern), None)
    except OSError:
        return None
