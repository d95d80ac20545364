"""JSON lines: their schema, files that appear whole, and readers that are slow."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.errors import counted
from facediff.spaces.arkit import ARKIT
from tests.fakes.waiting import PATIENCE, wait_until
from tests.live.conftest import FRAME_RATE, VERTICES, Opened, frame, weights_of


def wait_for(receiver: object, words: str) -> None:
    wait_until(lambda: words in receiver.status())  # type: ignore[attr-defined]


def test_a_file_has_the_performance_its_frames_and_the_end(opened: Opened, tmp_path: Path) -> None:
    path = tmp_path / "a b.jsonl"
    receiver = opened(f"jsonl:{path}")
    for index in (0, 1, 4):
        receiver.send(frame(index, dropped=index // 2))
        wait_for(receiver, counted(1 + min(index, 2), "frame"))
    assert not path.exists()
    receiver.close()
    head, *frames, end = [json.loads(text) for text in path.read_text().splitlines()]
    assert (head["type"], head["format"], head["subject"]) == ("performance", "facediff live 1", "Ann")
    assert (head["frame_rate"], head["shapes"], head["unit"]) == (FRAME_RATE, list(ARKIT), "m")
    assert [(each["index"], each["dropped"]) for each in frames] == [(0, 0), (1, 0), (4, 2)]
    assert frames[2]["time"] == pytest.approx(4 / FRAME_RATE, abs=1e-6)
    assert 0.1 <= frames[2]["lag"] < PATIENCE
    np.testing.assert_allclose([frames[2]["weights"][name] for name in ARKIT], weights_of(4), atol=1e-6)
    assert all(weight == round(weight, 6) for each in frames for weight in each["weights"].values())
    assert end == {"type": "end", "frames": 3, "dropped": 2}


def test_vertices_are_offsets_from_the_neutral_face(opened: Opened, tmp_path: Path) -> None:
    receiver = opened(f"jsonl:{tmp_path / 'a.jsonl'}?vertices=true&weights=false")
    assert not receiver.needs_weights
    receiver.send(frame(2))
    receiver.close()
    head, only, _ = [json.loads(text) for text in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert np.shape(head["neutral"]) == (VERTICES, 3)
    assert np.shape(head["faces"])[1] == 3
    assert "weights" not in only
    np.testing.assert_allclose(only["vertices"], frame(2).vertices, atol=1e-6)


def test_a_frame_that_is_not_finite_is_left_out(opened: Opened, tmp_path: Path) -> None:
    receiver = opened(f"jsonl:{tmp_path / 'a.jsonl'}")
    receiver.send(replace(frame(0), weights=np.full(len(ARKIT), np.nan, np.float32)))
    receiver.send(frame(1))
    receiver.close()
    _, only, end = [json.loads(text) for text in (tmp_path / "a.jsonl").read_text().splitlines()]
    assert only["index"] == 1
    assert end == {"type": "end", "frames": 1, "dropped": 1}


PROGRAM = """
import sys
from tests.live.conftest import *
made = Performance(30.0, np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32), shapes=ARKIT)
receiver = open_receiver("jsonl:-")
receiver.open(made)
for index in range(int(sys.argv[1])):
    receiver.send(frame(index))
    sys.stdin.readline()
print(receiver.status(), file=sys.stderr)
receiver.close()
"""


def run(frames: int, stdin: int, stdout: int) -> subprocess.Popen[bytes]:
    """A program that sends so many frames, a further one whenever a line comes or standard input is at its end."""
    words = [sys.executable, "-c", PROGRAM, str(frames)]
    return subprocess.Popen(words, stdin=stdin, stdout=stdout, stderr=subprocess.PIPE)


def test_lines_on_standard_output_are_read_as_they_come() -> None:
    with run(20, subprocess.PIPE, subprocess.PIPE) as program:
        assert program.stdin is not None
        assert program.stdout is not None
        lines = [program.stdout.readline()]
        for _ in range(20):
            lines.append(program.stdout.readline())
            program.stdin.write(b"\n")
            program.stdin.flush()
        out, error = program.communicate(timeout=PATIENCE)
    found = [json.loads(text) for text in [*lines, *out.splitlines()]]
    assert [each["type"] for each in found] == ["performance", *["frame"] * 20, "end"]
    assert (program.returncode, b"20 frames" in error) == (0, True)


def test_a_pipe_whose_reader_stops_or_leaves_does_not_stop_the_program() -> None:
    reading, writing = os.pipe()
    with run(200, subprocess.DEVNULL, writing) as program:
        os.close(writing)
        os.read(reading, 100)
        # Two hundred frames are more than a pipe holds; nobody reads them.
        assert program.stderr is not None
        assert b"dropped" in program.stderr.readline()
        os.close(reading)
        rest = program.stderr.read()
        assert program.wait(PATIENCE) == 0
    assert b"Traceback" not in rest
