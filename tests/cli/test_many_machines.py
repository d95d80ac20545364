"""Training on several machines: nodes of torchrun, tasks of SLURM, and what one machine can not do."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
import yaml

from facediff.cli.app import main
from tests.cli.conftest import SMALL
from tests.fakes.waiting import free_port

ROOT = Path(__file__).parents[2]
SWEEP = ROOT / "configs" / "sweep" / "puppet.yaml"


def sweep_words(**chosen: object) -> list[str]:
    """The command that an agent of Weights & Biases starts for chosen values, by its own functions."""
    utils = pytest.importorskip("wandb.sdk.launch.sweeps.utils")
    command = list(yaml.safe_load(SWEEP.read_text())["command"])
    found = utils.create_sweep_command_args({"args": {name: {"value": value} for name, value in chosen.items()}})
    words: list[str] = []
    for word in utils.create_sweep_command(command):
        words += found["args"] if word == "${args}" else [word]
    return words


@pytest.mark.slow
def test_the_sweep_names_options_that_exist_and_a_score_that_is_logged(capsys: pytest.CaptureFixture[str]) -> None:
    sweep = yaml.safe_load(SWEEP.read_text())
    ends = []
    for last in (False, True):
        chosen = {}
        for name, values in sweep["parameters"].items():
            limits = values.get("values") or [values["min"], values["max"]]
            chosen[name] = limits[-1 if last else 0]
        ends.append(chosen)
    for chosen in ends:
        words = sweep_words(**chosen)
        assert words[:2] == ["facediff", "fit"]
        with pytest.raises(SystemExit):
            main([*words[1:], "--print_config"])
        shown = yaml.safe_load(re.sub(r"^.*?(?=^seed_everything)", "", capsys.readouterr().out, flags=re.DOTALL | re.M))
        for name, value in chosen.items():
            found = shown
            for part in name.split("."):
                found = found.get(part, found.get("init_args", {}).get(part))
            assert found == pytest.approx(value)
    monitored = yaml.safe_load((ROOT / "configs/trainer/cpu.yaml").read_text())["callbacks"]
    assert sweep["metric"]["name"] in [found.get("init_args", {}).get("monitor") for found in monitored]


# Several processes on this machine, which take one another for machines.


def words_of(tiny_root: Path, runs: Path, *more: str) -> list[str]:
    data = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}", "--data.batch_size=2"]
    runner = ["--trainer.accelerator=cpu", "--trainer.strategy=ddp", "--trainer.callbacks=[]"]
    config = ["--config", "configs/experiment/puppet.yaml"]
    return ["-m", "facediff", "fit", *config, *data, *SMALL, *runner, f"--trainer.logger.save_dir={runs}", *more]


def started(command: list[str], **variables: object) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    environment |= {name: str(value) for name, value in variables.items()}
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=pipe, stderr=subprocess.STDOUT, text=True)


def finished(running: Sequence[subprocess.Popen[str]], *statuses: int) -> str:
    """What processes have printed that end with these statuses; none is left running."""
    try:
        printed = "".join(process.communicate(timeout=400)[0] for process in running)
    finally:
        for process in running:
            process.kill()
            process.communicate()
    assert [process.returncode for process in running] == list(statuses), printed[-4000:]
    return printed


def weights(runs: Path) -> dict[str, torch.Tensor]:
    found = torch.load(runs / "puppet/version_0/checkpoints/last.ckpt", weights_only=True)
    assert found["global_step"] > 0
    return dict(found["state_dict"])


def assert_equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        torch.testing.assert_close(value, second[name], rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_job_of_slurm_is_requeued_before_its_time_ends_and_continues(tiny_root: Path, tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    asked = tmp_path / "asked"
    scontrol = tmp_path / "bin" / "scontrol"
    scontrol.write_text(f'#!/bin/sh\necho "$@" >> {asked}\n')
    scontrol.chmod(0o755)
    longer = [
        "--trainer.devices=1",
        "--trainer.num_nodes=2",
        "--trainer.max_epochs=20",
        "--trainer.limit_val_batches=0",
    ]
    keep = ["--trainer.callbacks+=facediff.callbacks.LastCheckpoint", "--trainer.callbacks.every_n_steps=1"]

    def tasks(runs: Path, restarts: int) -> list[subprocess.Popen[str]]:
        """What srun starts: a task on each of two nodes."""
        port = free_port()
        words = words_of(tiny_root, runs, *longer, *keep)
        words = [word for word in words if word != "--trainer.max_epochs=1"]
        common = {"SLURM_JOB_ID": 77, "SLURM_JOB_NAME": "facediff", "SLURM_NTASKS": 2, "SLURM_NTASKS_PER_NODE": 1}
        common |= {"SLURM_NODELIST": "127.0.0.1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "SLURM_LOCALID": 0}
        common |= {"SLURM_RESTART_COUNT": restarts, "PATH": f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"}
        return [started([sys.executable, *words], **common, SLURM_PROCID=rank, SLURM_NODEID=rank) for rank in range(2)]

    mine = tmp_path / "mine"
    running = tasks(mine, 0)
    state, limit = mine / "puppet/version_0/checkpoints/last.ckpt", time.monotonic() + 300
    seen: set[int] = set()
    while len(seen) < 2 and time.monotonic() < limit and running[0].poll() is None:
        if state.exists():
            seen.add(state.stat().st_mtime_ns)
        time.sleep(0.01)
    for process in running:
        process.send_signal(signal.SIGUSR1)  # as `#SBATCH --signal=SIGUSR1@120` does
    finished(running, 128 + signal.SIGUSR1, 0)
    assert asked.read_text() == "requeue 77\n"
    stopped = torch.load(state, weights_only=True)["global_step"]
    assert 0 < stopped < 40

    running = tasks(mine, 1)  # the same command, without --ckpt_path
    finished(running, 0, 0)
    assert torch.load(state, weights_only=True)["global_step"] == 40
    assert not (mine / "puppet/version_1").exists()
    whole = tasks(tmp_path / "whole", 0)
    finished(whole, 0, 0)
    assert_equal(weights(mine), weights(tmp_path / "whole"))
