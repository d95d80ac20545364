"""Runs that log to Weights & Biases without a key or without a network: no question, no waiting, nothing lost."""

from __future__ import annotations

import io
import os
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import redirect_stderr
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from jsonargparse import Namespace

from facediff.cli.app import main
from facediff.cli.lightning_cli import answers, settle_wandb_mode
from tests.cli.conftest import SMALL
from tests.fakes.wandb_run import OfflineRun

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "monitoring.md"
CALLBACKS = """
trainer:
  callbacks+:
    - class_path: lightning.pytorch.callbacks.ThroughputMonitor
      init_args: {batch_size_fn: facediff.data.batch.clips_in}
      dict_kwargs: {window_size: 2}
    - class_path: facediff.callbacks.SamplingPreview
      init_args: {clips: 1, size: 64, seconds: 0.2, steps: 2}
"""


def documented(head: str) -> list[str]:
    """The names in the first column of a table of docs/monitoring.md, by the table's head."""
    lines = DOCS.read_text(encoding="utf-8").splitlines()
    start = lines.index(head) + 2
    end = next(place for place, line in enumerate(lines) if place >= start and not line.startswith("|"))
    return [name for line in lines[start:end] for name in line.split("|")[1].split("`")[1::2]]


LOGGED = documented("| name | meaning | logged |")
CONFIG = documented("| name | meaning |")


def clean(home: Path, **more: str) -> dict[str, str]:
    """An environment in which nobody has ever logged in."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("WANDB", "NETRC", "XDG"))}
    return {**kept, "HOME": str(home), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **more}


def run_in_terminal(words: list[str], folder: Path, environment: dict[str, str]) -> tuple[int, str]:
    """Run with a terminal that never answers; status and what was printed. A question would run into the limit."""
    import pty

    mine, theirs = pty.openpty()
    process = subprocess.Popen(words, cwd=folder, env=environment, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    printed = b""
    deadline = time.monotonic() + 150
    try:
        while time.monotonic() < deadline:
            try:
                piece = os.read(mine, 4096)
            except OSError:  # the other end is closed
                break
            printed += piece
        return process.wait(timeout=max(deadline - time.monotonic(), 1)), printed.decode()
    finally:
        process.kill()
        process.wait()
        os.close(mine)


@pytest.fixture(scope="module")
def runs(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[OfflineRun, OfflineRun, str, str]:
    """A training without a key in its own process, a test with a key but without a network, and what they printed."""
    wandb = pytest.importorskip("wandb")
    folder, home = tmp_path_factory.mktemp("run"), tmp_path_factory.mktemp("home")
    (folder / "more.yaml").write_text(CALLBACKS)
    facediff = [sys.executable, "-m", "facediff"]
    data = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}", "--data.batch_size=2"]
    # Where the loss has its term on the upper face.
    vertices = ["--model.motion_space=vertices", "--model.timestep_sampling=uniform"]
    small = [word for word in SMALL if "motion_space" not in word]
    configs = ["experiment/puppet.yaml", "logger/wandb.yaml", "callbacks/dashboard.yaml"]
    words = [f"--config=configs/{config}" for config in configs]
    status, printed = run_in_terminal(
        [*facediff, "fit", *words, "--config=more.yaml", *vertices, *data, *small], folder, clean(home)
    )
    assert status == 0, printed[-3000:]

    wandb.finish()  # another test's run in this process
    wandb.teardown()  # and what wandb knew of the environment
    with socket.socket() as taken, pytest.MonkeyPatch.context() as patch, redirect_stderr(io.StringIO()) as said:
        taken.bind(("127.0.0.1", 0))  # bound but not listening: nobody answers
        for name in [name for name in os.environ if name.startswith(("WANDB", "NETRC"))]:
            patch.delenv(name)
        for name, value in {"HOME": str(home), "WANDB_API_KEY": "k" * 40}.items():
            patch.setenv(name, value)
        patch.setenv("WANDB_BASE_URL", f"http://127.0.0.1:{taken.getsockname()[1]}")
        patch.chdir(folder)
        (checkpoint,) = folder.rglob("best.ckpt")
        words = ["test", f"--ckpt_path={checkpoint}", "--config=configs/logger/wandb.yaml", *data]
        assert main([*words, "--trainer.enable_progress_bar=false", "--trainer.logger.save_dir=tested"]) == 0
        wandb.finish()
        wandb.teardown()
    first, second = sorted(folder.glob("*/wandb/offline-run-*"))
    return OfflineRun(first), OfflineRun(second), printed, said.getvalue()


@pytest.mark.slow  # tests/cli/test_lightning.py trains with wandb offline in the quick suite
def test_a_line_says_why_and_how_to_upload(runs: tuple[OfflineRun, OfflineRun, str, str]) -> None:
    *_, no_key, no_network = runs
    for printed, reason in ((no_key, "no API key found"), (no_network, r"http://127\.0\.0\.1:\d+ does not answer")):
        lines = [line for line in printed.splitlines() if "wandb" in line.lower()]
        assert len(lines) == 1
        assert re.search(rf"^wandb: {reason}.*upload it later with `wandb sync \w+/wandb/offline-run-\*`", lines[0])


@pytest.mark.slow  # tests/cli/test_lightning.py trains with wandb offline in the quick suite
def test_every_documented_name_is_recorded(runs: tuple[OfflineRun, OfflineRun, str, str]) -> None:
    trained, tested, *_ = runs
    found = trained.names | tested.names
    assert len(LOGGED) > 25
    for name in LOGGED:
        pattern = re.sub("<[a-z]+>", "[A-Za-z0-9_]+", name)
        assert any(re.fullmatch(pattern, other) for other in found), name
    for run in (trained, tested):
        assert set(CONFIG) <= set(run.config)
        assert run.config["protocol"] == "paper"
    assert trained.config["config"]["trainer"]["max_epochs"] == 1


@pytest.mark.slow  # tests/cli/test_lightning.py trains with wandb offline in the quick suite
def test_every_metric_that_is_recorded_is_documented(runs: tuple[OfflineRun, OfflineRun, str, str]) -> None:
    trained, tested, *_ = runs
    words = {re.sub("<[a-z]+>", "[A-Za-z0-9_]+", name) for name in LOGGED}
    jitter = r"(frame_step|difference_ratio)_\w+"
    words |= {rf"test_[ab]/(still|mean_face|shuffled|usual_style)/(mve|lve|fdd|{jitter})", rf"test_[ab]/{jitter}"}
    words |= {"epoch", "trainer/global_step", "_.*"}
    words |= {r"(train|validate)/(batches|samples|time)", r"validate/device/.*"}  # Lightning's, of no use here
    strange = {name for name in trained.names | tested.names if not any(re.fullmatch(word, name) for word in words)}
    assert not strange


@pytest.mark.slow  # tests/cli/test_lightning.py trains with wandb offline in the quick suite
def test_numbers_and_norms_come_with_every_step(runs: tuple[OfflineRun, OfflineRun, str, str]) -> None:
    trained, *_ = runs
    steps = [row for row in trained.history if "train/loss" in row]
    assert len(steps) == 4  # eight clips, two a batch
    assert all(row["gradient/norm"] > 0 for row in steps)
    # The callback of the config stands in for the built-in one.
    assert trained.column("gradient/decoder")


def test_a_server_that_says_nothing_does_not_answer() -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        assert not answers(f"http://127.0.0.1:{silent.getsockname()[1]}", patience=0.3)
    assert not answers("http://host.invalid", patience=1.0)


@pytest.mark.parametrize(("status", "answer"), [(404, True), (503, False)])
def test_a_gateway_without_its_server_does_not_answer(status: int, answer: bool) -> None:
    class Gateway(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(status)

        def log_message(self, *words: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Gateway) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        assert answers(f"http://127.0.0.1:{server.server_port}") is answer


def trainer_with_wandb(**options: object) -> dict[str, object]:
    return {"logger": [Namespace(class_path="lightning.pytorch.loggers.WandbLogger", init_args=Namespace(**options))]}


@pytest.mark.parametrize(("mode", "options"), [("online", {}), ("disabled", {}), (None, {"offline": True})])
def test_a_chosen_mode_is_kept(
    mode: str | None,
    options: dict[str, object],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("wandb")
    monkeypatch.delenv("WANDB_MODE")
    if mode is not None:
        monkeypatch.setenv("WANDB_MODE", mode)
    settle_wandb_mode(trainer_with_wandb(**options))
    assert os.environ.get("WANDB_MODE") == mode
    assert not capsys.readouterr().err
