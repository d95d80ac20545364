"""Carrying out a plan: resumable after a kill at any moment, in parallel, with a manifest at the end."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.files import check_writable
from facediff.machine import processors
from facediff.prepare.job import Job, Plan, motion_file, speech_file
from facediff.prepare.manifest import (
    MANIFEST,
    STATE,
    describe_files,
    manifest,
    read_record,
    recipe,
    refuse_other_recipe,
    same_sizes,
    write_record,
)
from facediff.prepare.pool import run_jobs

LOCK = ".prepare.lock"
WAV_HEADER = 44


@dataclass(frozen=True)
class Report:
    """What preparing did.

    Attributes:
        out: the corpus folder.
        clips: frames of every clip that is there now.
        written: number of clips written by this run; the others were there.
        failed: what went wrong, by clip.
        missing: what the raw folder lacks, and what was expected where.
        notes: other remarks.
        totals: counts, as in the manifest.
    """

    out: Path
    clips: dict[str, int]
    written: int
    failed: dict[str, str] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    totals: dict[str, Any] = field(default_factory=dict)

    @property
    def sound(self) -> bool:
        """Whether every clip of the plan was written."""
        return not self.failed


def prepare(plan: Plan, out: Path, *, workers: int | None = None, quiet: bool = False) -> Report:
    """Write a corpus folder.

    A run that was killed is taken up where it was: clips whose two files are there are kept. A second run over a
    complete folder changes nothing. A clip that fails does not stop the others.

    Args:
        plan: what to write.
        out: the folder; new, empty, or begun by this function with the same options.
        workers: processes; as many as there are processors if None.
        quiet: no progress bars.

    Raises:
        FaceDiffError: if the folder cannot be written, holds something else or was begun with other options, if the
            disk is too small, or if another run is at work in it.
    """
    workers = processors() if workers is None else workers
    if workers < 1:
        raise FaceDiffError(f"--workers: is {workers}; expected 1 or more")
    if out.exists() and not out.is_dir():
        raise FaceDiffError(f"{out}: is a file; expected a folder to write the corpus to")
    check_writable(out / STATE)
    with _alone_in(out):
        before = read_record(out / MANIFEST)
        begun = read_record(out / STATE) or before
        if begun is None:
            _refuse_foreign(out)
        finished = {job.name: frames for job in plan.jobs if (frames := finished_frames(plan, job, out))}
        if (
            before is not None
            and not (out / STATE).exists()
            and _says(before, plan, finished)
            and same_sizes(out, before)
        ):
            return _report(plan, out, before, 0)
        if begun is not None:
            refuse_other_recipe(out, begun, plan)
        _refuse_strays(plan, out)
        pending = [job for job in plan.jobs if job.name not in finished]
        _check_space(plan, pending, out)
        write_record(out / STATE, recipe(plan))
        _sweep(out)
        return _carry_out(plan, pending, finished, out, workers, quiet)


def _carry_out(
    plan: Plan, pending: list[Job], finished: dict[str, int], out: Path, workers: int, quiet: bool
) -> Report:
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise MissingExtraError("tqdm", "prepare", "preparing a data set") from error

    shared = plan.shared(out)
    clips, failed = dict(finished), {}
    silent = True if quiet else None  # None: silent where the output is no terminal
    bar = tqdm(total=len(plan.jobs), initial=len(finished), desc=plan.corpus, unit="clip", disable=silent)
    with bar, closing(run_jobs(pending, out, workers)) as outcomes:
        for outcome in outcomes:
            if outcome.hopeless:
                raise FaceDiffError(outcome.problem)
            if outcome.frames is None:
                failed[outcome.name] = outcome.problem
                for file in _files(out, outcome.name):  # damaged ones of an earlier run
                    file.unlink(missing_ok=True)
            else:
                clips[outcome.name] = outcome.frames
            bar.update()
    files = [*shared, *(file.relative_to(out).as_posix() for name in clips for file in _files(out, name))]
    with tqdm(total=len(files), desc="checksums", unit="file", disable=silent) as bar:
        record = manifest(plan, clips, failed, describe_files(out, files, workers, bar.update))
    write_record(out / MANIFEST, record)
    (out / STATE).unlink()
    return _report(plan, out, record, len(clips) - len(finished))


def finished_frames(plan: Plan, job: Job, out: Path) -> int | None:
    """Frames of a clip whose motion and speech are both there and whole; None for any other."""
    motion, speech = _files(out, job.name)
    try:
        if speech.stat().st_size <= WAV_HEADER:
            return None
        array = np.load(motion, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    whole = array.ndim == 2 and array.shape[1] == 3 * plan.n_vertices and array.dtype == _dtype(plan)
    return len(array) if whole else None


def _files(out: Path, name: str) -> tuple[Path, Path]:
    return motion_file(out, name), speech_file(out, name)


def _dtype(plan: Plan) -> np.dtype[Any]:
    return np.dtype(plan.options.get("dtype", "float32"))


def _says(record: dict[str, Any], plan: Plan, finished: dict[str, int]) -> bool:
    """Whether a manifest records just this plan, carried out without a failure."""
    same = all(record.get(key) == value for key, value in recipe(plan).items() if key != "facediff")
    wanted = {"missing": plan.missing, "notes": plan.notes, "failed": {}, "clips": finished}
    return same and len(finished) == len(plan.jobs) and all(record.get(key) == value for key, value in wanted.items())


def _report(plan: Plan, out: Path, record: dict[str, Any], written: int) -> Report:
    return Report(out, record["clips"], written, record["failed"], plan.missing, plan.notes, record["totals"])


@contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    """Keep a second run out of the folder; a run that was killed keeps nobody out."""
    made = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    lock = out / LOCK
    with lock.open("w") as stream:
        try:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FaceDiffError(f"{out}: another `facediff data prepare` is at work here; wait for its end") from error
        except (ImportError, OSError):
            pass  # Windows, or a network disk without locks: two runs at once are the user's lookout
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
            if made:
                with suppress(OSError):  # not empty, as a rule
                    out.rmdir()


def _refuse_foreign(out: Path) -> None:
    found = [path.name for path in sorted(out.iterdir()) if not path.name.startswith(".")]
    if found:
        raise FaceDiffError(
            f"{out}: holds other files ({', '.join(found[:3])}{' …' if len(found) > 3 else ''}) and was not begun by "
            f"`facediff data prepare`; choose a new folder"
        )


def _refuse_strays(plan: Plan, out: Path) -> None:
    """A clip that the raw folder has no more would be read as a part of the corpus, unseen by the manifest."""
    names = {job.name for job in plan.jobs}
    for path in (*sorted(out.glob("vertices_npy/*.npy")), *sorted(out.glob("wav/*.wav"))):
        if not path.name.startswith(".") and path.stem not in names:
            raise FaceDiffError(
                f"{path}: is no clip of the raw folder (any more); remove the file, or choose another folder"
            )


def _sweep(out: Path) -> None:
    """Remove what killed runs left half-written."""
    for path in out.rglob(".*.partial-*"):
        path.unlink(missing_ok=True)


def _check_space(plan: Plan, pending: list[Job], out: Path) -> None:
    known = [job.frames for job in pending if job.frames is not None]
    if not known:
        return
    frames = sum(known) / len(known) * len(pending)
    need = frames * (3 * plan.n_vertices * _dtype(plan).itemsize + 2 * 16_000 / plan.frame_rate)
    free = shutil.disk_usage(out).free
    if need > free:
        raise FaceDiffError(
            f"{out}: about {need / 1e9:.1f} GB are needed and {free / 1e9:.1f} GB are free; make room, choose another "
            f"disk, or prepare fewer subjects"
        )
