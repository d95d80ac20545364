"""Writing a corpus folder: the plan, its execution and resumption, and the writers of the files."""

from __future__ import annotations

import json
import pickle  # noqa: S403 - writes a pickle, opens none
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib import metadata
from operator import methodcaller
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.manifest import FORMAT, load_manifest
from facediff.errors import FaceDiffError, check_known, damaged, needs_extra
from facediff.utils.arrays import open_array
from facediff.utils.batch import begin_folder, run_batch
from facediff.utils.checksums import describe_files, same_sizes
from facediff.utils.files import atomic, check_writable, locked, remove_partial
from facediff.utils.plain_files import parse_json, write_json
from facediff.utils.records import read_record
from facediff.utils.workers import processors

STATE = "prepare.json"
"""In the output folder while preparation is running or was interrupted."""
MANIFEST = "manifest.json"
"""In the output folder when preparation has ended: the files, and the clips that are missing or failed."""
LOCK = ".prepare.lock"
CLIP_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,199}")
WAV_HEADER = 44  # bytes


@dataclass(frozen=True)
class Job:
    """One clip to write."""

    name: str  # of the clip, e.g. F2_e01
    # gets the output folder, writes the clip with write_clip and returns its number of frames; it must be picklable
    work: Callable[[Path], int]

    def __post_init__(self) -> None:
        if not CLIP_NAME.fullmatch(self.name):
            raise FaceDiffError(
                f'clip name "{self.name}": expected letters, digits, "_" and "-" only; rename it in the raw data'
            )

    def __str__(self) -> str:
        return f"clip {self.name}"


@dataclass(frozen=True)
class PreparationPlan:
    """The clips and files to write, from a quick scan of the raw folder."""

    corpus: str  # biwi, vocaset or mead3d
    frame_rate: float  # motion frames a second, as written
    unit: str  # unit of the written vertices
    n_vertices: int  # vertices of every frame
    # plain values that determine the output; a resumed run must have the same
    options: dict[str, Any]
    jobs: list[Job]  # one for each clip
    # writes what clips share (templates.pkl, mesh, regions/, clips.csv) and returns the paths of those files, relative
    # to the output folder. Runs in the calling process; may run again
    shared: Callable[[Path], list[str]]
    # clips and files that the raw folder lacks, each with the expected place
    missing: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  # other remarks for the user, one sentence each

    @property
    def recipe(self) -> dict[str, Any]:
        """All that determines the bytes of the output; a run may be resumed only with the same."""
        return settings({"facediff": version(), "corpus": self.corpus, "options": self.options})


@dataclass(frozen=True)
class PreparationReport:
    """The outcome of a preparation."""

    out: Path
    clips: dict[str, int]  # frames of every clip that is there now
    written: int  # number of clips written by this run; the others were there
    failed: dict[str, str]  # reasons by clip
    missing: dict[str, str]  # clips and files that the raw folder lacks, each with the expected place
    notes: list[str]
    totals: dict[str, Any]  # counts, as in the manifest

    @property
    def sound(self) -> bool:
        """Whether every clip of the plan was written."""
        return not self.failed


def prepare(
    plan: PreparationPlan,
    out: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = "",
    reads: Sequence[Path] = (),
    quiet: bool = False,
) -> PreparationReport:
    """Write a corpus folder.

    A run that was killed is resumed: clips with both files are kept. A second run over a complete folder
    changes nothing. A clip that fails does not stop the others.

    Args:
        plan: what to write.
        out: the folder; new, empty, or begun by this function with the same options.
        workers: clips at a time; as many as there are processors, or workers of a cluster, if None.
        scheduler: where clips are written; see :func:`facediff.utils.jobs.run_tasks`.
        reads: the raw files, which workers of a cluster must see.
        quiet: no progress bars.
    """
    check_writable(out / STATE)
    with locked(out / LOCK, "facediff data prepare"):
        manifest = _read_manifest(out / MANIFEST)
        recorded = {} if manifest is None else manifest.get("files", {})
        complete = {job.name: frames for job in plan.jobs if (frames := finished_frames(plan, job, out, recorded))}
        notes = plan.notes if manifest is None else manifest.get("notes", plan.notes)
        repaired = {note.partition(":")[0] for note in {*notes} ^ {*plan.notes}}  # clips of other raw files than before
        complete = {name: frames for name, frames in complete.items() if name not in repaired}
        if manifest is not None and not (out / STATE).exists() and _is_complete(plan, complete, out, manifest):
            return _report(plan, out, manifest, 0)
        _refuse_strays(plan, out)
        pending = [job for job in plan.jobs if job.name not in complete]
        # A run may be killed at any time, so the state marks the folder as unfinished before the first clip appears,
        # and is removed only once the manifest is written: readers refuse a folder with a state and without a manifest.
        begin_folder(out, STATE, plan.recipe, "facediff data prepare", None if manifest is None else settings(manifest))
        options = {"workers": workers, "scheduler": scheduler, "writes": out, "reads": reads}
        return _write_all(plan, pending, complete, out, options, quiet)


def _write_all(
    plan: PreparationPlan,
    pending: list[Job],
    complete: dict[str, int],
    out: Path,
    options: Mapping[str, Any],
    quiet: bool,
) -> PreparationReport:
    shared = plan.shared(out)
    clips, failed = dict(complete), {}
    outcomes = run_batch(methodcaller("work", out), pending, **options, progress="" if quiet else plan.corpus)
    with closing(outcomes):
        for job, outcome in outcomes:
            if outcome.result is None:
                failed[job.name] = outcome.problem
                for file in clip_files(out, job.name):  # damaged ones of an earlier run
                    file.unlink(missing_ok=True)
            else:
                clips[job.name] = outcome.result
    remove_partial(out, recursive=True)  # of a worker of a cluster that was lost
    names = [*shared, *(file.relative_to(out).as_posix() for name in clips for file in clip_files(out, name))]
    files = describe_files(
        out, names, workers=options["workers"] or processors(), progress="" if quiet else "checksums"
    )
    manifest = _manifest(plan, clips, failed, files)
    write_json(out / MANIFEST, manifest)
    (out / STATE).unlink()
    return _report(plan, out, manifest, len(clips) - len(complete))


def _manifest(
    plan: PreparationPlan, clips: dict[str, int], failed: dict[str, str], files: dict[str, dict[str, int | str]]
) -> dict[str, Any]:
    """The final record. Nothing in it depends on the time or the order in which the files were made."""
    frames = sum(clips.values())
    return {
        "facediff": version(),
        "format": FORMAT,
        "corpus": plan.corpus,
        "options": plan.options,
        "frame_rate": plan.frame_rate,
        "unit": plan.unit,
        "n_vertices": plan.n_vertices,
        "totals": {
            "clips": len(clips),
            "frames": frames,
            "seconds": round(frames / plan.frame_rate, 3),
            "bytes": sum(int(file["bytes"]) for file in files.values()),
        },
        "clips": dict(sorted(clips.items())),
        "missing": plan.missing,
        "failed": dict(sorted(failed.items())),
        "notes": plan.notes,
        "files": files,
    }


def _report(plan: PreparationPlan, out: Path, manifest: dict[str, Any], written: int) -> PreparationReport:
    return PreparationReport(
        out, manifest["clips"], written, manifest["failed"], plan.missing, plan.notes, manifest["totals"]
    )


def version() -> str:
    """Version of the installed facediff."""
    try:
        return metadata.version("facediff")
    except metadata.PackageNotFoundError:  # run from a source tree on the path
        return "unknown"


# The folder as an earlier run has left it.


def finished_frames(plan: PreparationPlan, job: Job, out: Path, recorded: Mapping[str, Any]) -> int | None:
    """Frames of a clip with complete files of motion and speech; None for any other.

    Files that an earlier manifest records have the sizes that it records.
    """
    motion, speech = clip_files(out, job.name)
    names = [path.relative_to(out).as_posix() for path in (motion, speech)]
    if not same_sizes(out, {name: recorded[name] for name in names if name in recorded}):
        return None
    try:
        if speech.stat().st_size <= WAV_HEADER:
            return None
        array = open_array(motion)
    except (OSError, FaceDiffError):
        return None
    complete = array.ndim == 2 and array.shape[1] == 3 * plan.n_vertices and array.dtype == np.float32
    return len(array) if complete else None


def _is_complete(plan: PreparationPlan, complete: dict[str, int], out: Path, manifest: dict[str, Any]) -> bool:
    """Whether the manifest records just this plan, carried out without a failure, and all its files are there."""
    # A newer version of facediff accepts a complete folder of an older one; it only refuses to continue it.
    expected = {**plan.recipe, "facediff": manifest.get("facediff")}
    parts = {"missing": plan.missing, "notes": plan.notes, "failed": {}, "clips": complete}
    return (
        settings(manifest) == parse_json(json.dumps(expected), MANIFEST)
        and len(complete) == len(plan.jobs)
        and all(manifest.get(name) == value for name, value in parts.items())
        and same_sizes(out, manifest.get("files", {}))
        and _same_shared(plan, manifest.get("files", {}))
    )


def _same_shared(plan: PreparationPlan, files: Mapping[str, Any]) -> bool:
    """Whether the plan would write the files of all clips as a manifest records them: regions may be other ones now."""
    with TemporaryDirectory() as folder:
        shared = describe_files(Path(folder), plan.shared(Path(folder)))
    return all(files.get(name) == facts for name, facts in shared.items())


def settings(record: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of the run that wrote a folder, from its manifest; options as the user gives them."""
    options = {f"--{name.replace('_', '-')}": value for name, value in record["options"].items()}
    return {"facediff": record.get("facediff"), "corpus": record["corpus"], **options}


@dataclass(frozen=True)
class PreparedFolder:
    """The fields by which a manifest tells that ``facediff data prepare`` wrote its folder."""

    corpus: str
    options: Mapping[str, Any]
    files: Mapping[str, Any] = field(default_factory=dict)


def _read_manifest(path: Path) -> dict[str, Any] | None:
    """The manifest of an earlier run; None if there is none."""
    if not path.is_file():
        return None
    record = load_manifest(path, remedy=f"remove {path.parent}, or choose another folder")
    read_record(PreparedFolder, record, path, remedy="choose another folder to write to", strict=False)
    return record


def _refuse_strays(plan: PreparationPlan, out: Path) -> None:
    """Refuse clips that the raw folder no longer has: training would read them, but no manifest lists them."""
    names = {job.name for job in plan.jobs}
    paths = (*sorted(out.glob("vertices_npy/[!.]*.npy")), *sorted(out.glob("wav/[!.]*.wav")))
    if stray := next((path for path in paths if path.stem not in names), None):
        raise FaceDiffError(f"{stray}: is no clip of the raw folder (any more); remove it, or choose another folder")


# The files of a corpus folder.


def clip_files(out: Path, clip: str) -> tuple[Path, Path]:
    """Where a clip's vertices and its speech lie."""
    return out / "vertices_npy" / f"{clip}.npy", out / "wav" / f"{clip}.wav"


def write_clip(
    out: Path,
    clip: str,
    vertices: npt.NDArray[np.floating],
    speech: npt.NDArray[np.floating],
) -> int:
    """Write vertices (T, V, 3) and speech (S,) of a clip, and return the number of frames."""
    motion_file, speech_file = clip_files(out, clip)
    write_motion(motion_file, vertices)
    write_speech(speech_file, speech)
    return len(vertices)


def write_motion(path: Path, vertices: npt.NDArray[np.floating]) -> None:
    """Write absolute vertices (T, V, 3) as a (T, 3V) array of float32, atomically."""
    rows = np.ascontiguousarray(vertices.reshape(len(vertices), vertices[0].size if len(vertices) else 0), np.float32)
    finite = np.isfinite(rows).all(axis=1)
    if not len(rows) or not finite.all():
        fault = f"frame {int(np.argmin(finite))} (counted from 0) holds NaN or infinity" if len(rows) else "no frame"
        raise FaceDiffError(f"{path.stem}: {fault}; get the clip again or leave it out")
    with atomic(path) as temporary:
        np.save(temporary, rows, allow_pickle=False)


def write_speech(path: Path, speech: npt.NDArray[np.floating]) -> None:
    """Write speech (S,) in -1 … 1 as 16 kHz mono 16-bit wav, atomically; values beyond the range are clipped.

    Reading it back gives ``round(32768 x) / 32768``: 16-bit speech at 16 kHz goes through unchanged.
    """
    from facediff.speech.audio import SAMPLE_RATE, write_wav

    samples = np.clip(np.rint(np.asarray(speech, np.float64) * 32768), -32768, 32767).astype(np.int16)
    with atomic(path) as temporary:
        write_wav(temporary, samples, SAMPLE_RATE)


def write_templates(path: Path, templates: Mapping[str, npt.NDArray[np.floating]]) -> None:
    """Write neutral faces (V, 3) by subject as the pickle of NumPy arrays that the field's loaders open.

    Equal faces give equal bytes: each array gets NumPy's own instance of its type, because a pickle also records which
    arrays share a type's instance, and that depends on where they came from.
    """
    plain: dict[str, npt.NDArray[np.floating]] = {}
    for name, vertices in templates.items():
        plain[str(name)] = np.empty(vertices.shape, np.dtype(vertices.dtype.str))
        plain[str(name)][...] = vertices
    with atomic(path) as temporary:
        temporary.write_bytes(pickle.dumps(plain, protocol=4))


def write_mesh(path: Path, vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> None:
    """Write vertices (V, 3) and triangles (F, 3) as binary PLY, atomically."""
    with needs_extra("trimesh", "prepare", "writing a mesh"):
        import trimesh
    with atomic(path) as temporary:
        temporary.write_bytes(trimesh.Trimesh(vertices, faces, process=False).export(file_type="ply"))


def copy_files(sources: Sequence[Path], out: Path, folder: str = "") -> list[str]:
    """Copy files into the output folder (or a folder in it) under their own names; returns their relative paths."""
    written = []
    for source in sources:
        target = out / folder / source.name
        with atomic(target) as temporary:
            shutil.copyfile(source, temporary)
        written.append(target.relative_to(out).as_posix())
    return written


# Scanning a raw folder, which holds the data set itself or the folder that an archive unpacked to.


def bases(raw: Path) -> list[Path]:
    """The raw folder and the folders in it, sorted and without hidden ones: where a data set may begin."""
    return [raw, *folders_in(raw)]


def folders_in(folder: Path) -> list[Path]:
    """Folders in a folder, sorted, without hidden ones."""
    with damaged(folder, "expected the folder of a data set, unpacked", OSError):
        return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def find_file(raw: Path, name: str) -> Path | None:
    """A file with this name or relative path in the raw folder or one folder deeper; None if there is none."""
    return next((path for base in bases(raw) if (path := base / name).is_file()), None)


def find_regions(raw: Path, regions: Path | None) -> list[Path]:
    """The lists of vertices in the folder given, else in ``regions/`` of the raw folder if there is one."""
    folder = regions or next((path for base in bases(raw) if (path := base / "regions").is_dir()), None)
    files = [] if folder is None else sorted(path for path in folder.glob("*.txt") if path.is_file())
    if regions is not None and not files:
        raise FaceDiffError(f"{regions}: expected a folder with lists of vertices, e.g. lve.txt and fdd.txt")
    return files


def choose_subjects(subjects: Sequence[str] | None, available: Sequence[str], holder: str) -> list[str]:
    """The subjects that ``--subjects`` names, in the order in which they are known; all if None."""
    check_known("--subjects", f"subject of {holder}", subjects or (), available)
    return [subject for subject in available if subjects is None or subject in subjects]


def refuse_empty(raw: Path, corpus: str, jobs: Sequence[Job], gaps: Mapping[str, str]) -> None:
    """Refuse a raw folder without a complete clip."""
    if not jobs:
        reasons = "; ".join(f"{name}: {text}" for name, text in list(gaps.items())[:3])
        raise FaceDiffError(f"{raw}: no clip of {corpus} can be prepared ({reasons or 'there is none'})")
