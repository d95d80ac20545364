"""Unpacking: from a packed corpus back to a corpus folder."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from facediff.data.corpus import read_templates
from facediff.data.manifest import read_manifest
from facediff.data.packed.layout import EXACT
from facediff.data.packed.reader import PackedCorpus
from facediff.speech.audio import write_wav
from facediff.utils.batch import do_all
from facediff.utils.checksums import describe_files
from facediff.utils.files import atomic_folder
from facediff.utils.jobs import PerWorker
from facediff.utils.plain_files import write_json
from facediff.utils.workers import processors


def unpack(
    source: str | Path,
    out: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = "",
    quiet: bool = True,
) -> int:
    """Write the corpus folder that was packed; returns the number of its clips.

    Motion differs from the original by no more than the tolerance, and not at all where it was packed without loss;
    speech has the same samples, every other file the same bytes. Checksums in ``manifest.json`` are updated.

    Args:
        source: folder or address of the packed corpus.
        out: the folder to make.
        workers: processes; as many as there are processors if None.
        scheduler: where tasks run; see :func:`~facediff.utils.jobs.run_tasks`.
        quiet: no progress bar.
    """
    packed = PackedCorpus(source)
    with atomic_folder(out) as folder:
        packed.write_files(folder)
        for name in ("vertices_npy", "wav"):
            (folder / name).mkdir(exist_ok=True)
        work = PerWorker(partial(_clip_writer, str(source), folder))
        options = {"workers": workers, "scheduler": scheduler, "writes": folder, "reads": packed.folders}
        do_all(work, packed.names(), **options, progress="" if quiet else "unpacking")
        _correct_manifest(folder, packed, workers)
    return len(packed.names())


def _clip_writer(source: str, folder: Path) -> Any:  # noqa: ANN401 - a partial
    packed = PackedCorpus(source)
    templates = {
        name: face.numpy() for name, face in read_templates(folder / "templates.pkl", packed.record.n_vertices).items()
    }
    return partial(_write_clip, packed, folder, templates)


def _write_clip(packed: PackedCorpus, folder: Path, templates: dict[str, Any], name: str) -> None:
    clip, motion = packed.record.clips[name], packed.open(name)
    if clip.coding in EXACT:
        vertices = motion.vertices()
    else:
        template = templates[clip.identity]
        # Added in double precision: the sum is rounded once, to the type that the folder had.
        vertices = (motion.offsets(range(clip.frames), template).astype(np.float64) + template).astype(clip.dtype)
    np.save(folder / "vertices_npy" / f"{name}.npy", vertices.reshape(len(vertices), -1), allow_pickle=False)
    sound, path = clip.sound, folder / "wav" / f"{name}.wav"
    if sound.form == "flac":
        samples = packed.samples(name, 0, sound.samples) << (32 - sound.bits)
        write_wav(path, samples, sound.rate, sound.bits)
    else:
        path.write_bytes(packed.recording(name))


def _correct_manifest(folder: Path, packed: PackedCorpus, workers: int | None) -> None:
    manifest = read_manifest(folder)
    files = manifest.get("files")
    if not isinstance(files, dict):
        return
    # An untrusted manifest may name files outside the folder: only files that were just written are described.
    clips = {file for clip in packed.names() for file in (f"vertices_npy/{clip}.npy", f"wav/{clip}.wav")}
    names = [name for name in files if name in packed.record.files or name in clips]
    written = describe_files(folder, names, workers=workers or processors(), progress="")
    if written != files:
        changed = {name: info for name, info in written.items() if info != files.get(name)}
        manifest["files"] = {**files, **written}
        manifest["packed"] = {"tolerance_mm": packed.record.tolerance, "changed": len(changed)}
        write_json(folder / "manifest.json", manifest)
