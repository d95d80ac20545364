"""Tasks on a Dask cluster: the same results, errors and ends as on one machine."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.utils import cluster, jobs
from facediff.utils.batch import run_batch
from facediff.utils.jobs import PerWorker, SetupError, run_tasks
from facediff.utils.workers import WorkerDied
from tests.fakes.tasks import counting, deadly, failing_oddly, failing_setup, place, raising, square, write_slowly
from tests.fakes.waiting import wait_until

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("ignore")  # of Dask's own shutdown


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """A cluster on this machine: two workers, each with Dask's nanny."""
    options = {"threads_per_worker": 1, "dashboard_address": None, "protocol": "tcp://", "host": "127.0.0.1"}
    with distributed.LocalCluster(n_workers=2, **options) as cluster_here:
        yield cluster_here.scheduler_address


def test_tasks_run_in_the_clients_folder_on_one_thread_in_processes_of_the_workers(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FACEDIFF_TRIAL", "yes")
    results = dict(run_tasks(place, range(6), scheduler=scheduler, writes=Path("out")))
    assert sorted(results) == list(range(6))
    found = {result for result in results.values() if isinstance(result, tuple)}
    assert {result[1:] for result in found} == {(str(tmp_path), "1", "yes")}
    assert len({result[0] for result in found} - {os.getpid()}) == 2
    assert not list(tmp_path.rglob("*token*"))  # what workers had to see is gone


def test_the_environment_names_the_cluster_where_nothing_else_does(
    scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(jobs.ADDRESS, scheduler)
    (there,) = [result for _, result in run_tasks(place, [0], scheduler=None)]
    (here,) = [result for _, result in run_tasks(place, [0])]
    (threads,) = [result for _, result in run_tasks(place, [0], scheduler="threads")]
    assert isinstance(there, tuple)
    assert isinstance(here, tuple)
    assert isinstance(threads, tuple)
    assert there[0] != here[0] == threads[0] == os.getpid()


def test_set_up_happens_once_in_each_worker(scheduler: str) -> None:
    by_process: dict[int, list[int]] = {}
    for _, result in run_tasks(PerWorker(counting), range(8), scheduler=scheduler):
        assert isinstance(result, tuple)
        by_process.setdefault(result[0], []).append(result[1])
    assert len(by_process) == 2
    assert all(sorted(counts) == list(range(1, len(counts) + 1)) for counts in by_process.values())


def test_a_task_that_kills_its_process_loses_no_other(scheduler: str) -> None:
    results = dict(run_tasks(deadly, range(6), scheduler=scheduler))
    assert isinstance(results.pop(3), WorkerDied)
    assert results == {task: task * task for task in (0, 1, 2, 4, 5)}


def test_errors_are_those_of_one_machine(scheduler: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MissingExtraError, match="h5py"):
        list(run_tasks(raising, range(4), scheduler=scheduler))
    with pytest.raises(SetupError, match=r"C\.ckpt"):
        list(run_tasks(PerWorker(failing_setup), range(2), scheduler=scheduler))
    outcomes = dict(run_batch(failing_oddly, range(3), scheduler=scheduler, survive_bugs=True))
    assert [bool(outcomes[task].problem) for task in range(3)] == [False, True, False]
    assert "failing_oddly" in capsys.readouterr().err  # the traceback is the client's to print


def test_a_stop_ends_tasks_and_the_cluster_goes_on(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "GRACE", 0.1)
    work = partial(write_slowly, tmp_path)
    with distributed.Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(2)  # an earlier test has ended some; a worker that comes later is given its task later
    with closing(run_tasks(work, range(9), workers=2, scheduler=scheduler, writes=tmp_path)) as results:
        assert next(results) == (0, 0)
        wait_until(lambda: list(tmp_path.glob("begun*")))
    assert {path.name for path in tmp_path.glob("[!.]*.txt")} == {"0.txt"}  # nothing half written, and 8 was not begun
    assert not (tmp_path / "begun8").exists()
    assert dict(run_tasks(square, range(3), scheduler=scheduler)) == {0: 0, 1: 1, 2: 4}


def test_workers_that_see_other_files_are_refused(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tmp_path / "a.wav"
    recording.write_bytes(b"long speech")
    monkeypatch.setattr(cluster, "search_path", lambda: recording.write_bytes(b"short") and ())
    with pytest.raises(FaceDiffError, match=r"tcp://.*a\.wav"):
        list(run_tasks(place, [0], scheduler=scheduler, reads=[recording]))
    monkeypatch.setattr(cluster, "search_path", tuple)
    monkeypatch.setattr(cluster, "fingerprint", lambda path: -1 if path.endswith("token") else None)
    with pytest.raises(FaceDiffError, match=str(tmp_path / "out")):
        list(run_tasks(place, [0], scheduler=scheduler, writes=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("field", "value"), [("version", "0.0.1"), ("python", "2.7"), ("folder", "/not/there")])
def test_workers_of_another_version_or_without_the_folder_refuse(field: str, value: str) -> None:
    run = cluster.ClusterRun("name", os.getcwd(), (), {}, {}, b"")
    assert cluster.problem(run) == ""
    assert value in cluster.problem(replace(run, **{field: value}))


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "CONNECTING", 0.3)
    with pytest.raises(FaceDiffError, match="tcp://127.0.0.1:9"):
        list(run_tasks(place, [0], scheduler="tcp://127.0.0.1:9"))
    assert list(run_tasks(place, [], scheduler="tcp://127.0.0.1:9")) == []  # nothing to do


def test_a_cluster_without_workers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "PATIENCE", 0.2)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None) as empty,
        pytest.raises(FaceDiffError, match="worker"),
    ):
        list(run_tasks(place, [0], scheduler=empty.scheduler_address))
