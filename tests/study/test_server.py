"""The server takes what the page sends, once, and nothing else; Ctrl-C ends it."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from facediff.study.definition import DATABASE, Study
from facediff.study.server import MOST_BYTES, make_app
from facediff.study.store import AnswerStore
from facediff.utils.server import LOOPBACK
from tests.fakes import serving
from tests.fakes.serving import servers
from tests.fakes.study import SCORES, simulate, small_study, write_study
from tests.study.conftest import Serve

TOKEN = "00112233445566778899aabbccddeeff"  # noqa: S105 - of a rater
JSON = "application/json"


@pytest.fixture
def study() -> Study:
    return small_study(clips=3)


@pytest.fixture
def address(study: Study, tmp_path: Path, serve: Serve) -> str:
    return serve(write_study(tmp_path / "study", study))


def ask(url: str, content: object = None, **options: Any) -> tuple[int, Any]:  # noqa: ANN401 - passed on
    """Status and answer; of JSON, its content."""
    status, headers, answer = serving.ask(url, content, **options)
    return status, json.loads(answer) if headers.get("content-type") == JSON else answer


def given(asked: Study, number: int, place: int = 0, **changed: object) -> dict[str, object]:
    """What the page sends of a trial."""
    trial = asked.trials_of(number)[place]
    content = {"study": asked.id, "rater": TOKEN, "trial": trial.id, "answers": {"realism": "left", "style": "right"}}
    return {**content, "seconds": 2.5, "plays": 1, "at": "2026-01-01T00:00:00.000Z", **changed}


def begin(address: str, study: Study, headers: dict[str, str] | None = None, **changed: object) -> tuple[int, Any]:
    content = {"study": study.id, "rater": TOKEN, "language": "en", "code": "", "agreed": True, **changed}
    return ask(f"{address}/api/raters", content, **(headers or {}))


def test_a_rater_answers_and_finishes_and_repeats_change_nothing(address: str, study: Study, tmp_path: Path) -> None:
    assert begin(address, study) == begin(address, study) == (200, {"number": 0})
    assert begin(address, study, rater="f" * 32) == (200, {"number": 1})
    assert ask(f"{address}/api/answers", given(study, 0)) == (200, {"new": True})
    assert ask(f"{address}/api/answers", given(study, 0, seconds=9)) == (200, {"new": False})
    end = {"study": study.id, "rater": TOKEN, "comments": {"comments": "'; DROP TABLE raters; --"}}
    assert ask(f"{address}/api/finish", end)[0] == 409
    for place in range(len(study.trials_of(0))):
        assert ask(f"{address}/api/answers", given(study, 0, place))[0] == 200
    assert ask(f"{address}/api/finish", end) == ask(f"{address}/api/finish", end) == (200, {"finished": True})
    first, second = AnswerStore(tmp_path / "study" / DATABASE, study).raters()
    assert first.comments == {"comments": "'; DROP TABLE raters; --"}
    assert [len(first.answers), len(second.answers)] == [len(study.trials_of(0)), 0]
    assert first.answers[study.trials_of(0)[0].id].seconds == 2.5
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", first.finished or "")


WRONG: dict[str, dict[str, object]] = {
    "another study": {"study": "0" * 16},
    "a token that is none": {"rater": "x' OR 1=1 --"},
    "an unknown trial": {"trial": "0" * 16},
    "an answer that is none": {"answers": {"realism": "both", "style": "left"}},
    "a question too many": {"answers": {"realism": "left", "style": "left", "more": "left"}},
    "no number of seconds": {"seconds": "2"},
    "half a play": {"plays": 0.5},
    "a time of many letters": {"at": "2" * 5000},
}


@pytest.mark.parametrize("name", WRONG)
def test_what_the_page_does_not_send_is_refused_and_not_stored(
    name: str, address: str, study: Study, tmp_path: Path
) -> None:
    begin(address, study)
    status, _ = ask(f"{address}/api/answers", given(study, 0, **WRONG[name]))
    assert status == (404 if "rater" in WRONG[name] else 400)
    assert not AnswerStore(tmp_path / "study" / DATABASE, study).raters()[0].answers


def test_bodies_of_other_kinds_and_sizes_are_refused(address: str, study: Study) -> None:
    assert begin(address, study, agreed=False)[0] == 400
    assert begin(address, study, code="x" * 41)[0] == 400
    assert begin(address, study, language="<script>")[0] == 400
    url = f"{address}/api/answers"
    assert ask(url, given(study, 0))[0] == 404  # nobody has begun
    assert ask(url, raw=b"{" * 20_000)[0] == 400
    assert ask(url, raw=b"[" + b"0," * MOST_BYTES + b"0]")[0] == 413
    assert ask(url, raw=b"\xff\xfe{")[0] == 400
    assert ask(url, raw=b"[1, 2]")[0] == 400
    assert ask(url, raw=b'{"study": NaN}')[0] == 400
    assert ask(url, raw=json.dumps(given(study, 0)).encode(), **{"Content-Type": "text/plain"})[0] == 415
    assert ask(url)[0] == 405
    trial_of_another = next(
        trial.id for trial in study.trials if trial.id not in {each.id for each in study.trials_of(0)}
    )
    begin(address, study)
    assert ask(url, given(study, 0, trial=trial_of_another))[0] == 400


def test_pages_from_elsewhere_can_neither_read_nor_answer(address: str, study: Study, tmp_path: Path) -> None:
    for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
        assert begin(address, study, headers)[0] == 403
        assert ask(f"{address}/", **headers)[0] == 403
    assert not AnswerStore(tmp_path / "study" / DATABASE, study).raters()
    assert begin(address, study, {"Origin": address})[0] == 200


@pytest.mark.parametrize("hosts", [LOOPBACK, None])
def test_a_web_server_in_front_is_let_in_by_its_name(
    hosts: tuple[str, ...] | None, study: Study, tmp_path: Path
) -> None:
    folder = write_study(tmp_path / "study", study)
    name, public = "study.lab.example", "https://study.lab.example"
    with servers() as running:
        store = AnswerStore(folder / DATABASE, study)
        address = running.start(make_app(folder, study, store, hosts=hosts, public_name=name))[0]
        for headers in ({"Host": name, "Origin": public}, {"Host": f"{name}:443"}, {"Origin": f"{public}:8443"}):
            assert begin(address, study, headers)[0] == 200
        for headers in ({"Host": "evil.example"}, {"Host": name, "Origin": "https://evil.example"}):
            assert begin(address, study, headers)[0] == 403


def test_the_page_and_its_videos_are_served_in_parts_and_nothing_else(address: str, study: Study) -> None:
    status, page = ask(f"{address}/")
    assert status == 200
    assert study.id.encode() in page
    assert ask(f"{address}/api/study") == (200, {"id": study.id})
    video = f"{address}/videos/{study.videos()[0]}"
    request = urllib.request.Request(video, headers={"Range": "bytes=6-11"})  # noqa: S310 - our own server
    with urllib.request.urlopen(request, timeout=20) as response:  # noqa: S310 - our own server
        assert (response.status, response.read()) == (206, b"video ")
        assert response.headers["X-Content-Type-Options"] == "nosniff"
        assert response.headers["Server"] is None
    for path in (
        "study.json",
        "videos/../study.json",
        "videos/..%2f..%2fstudy.json",
        "answers.sqlite",
        "videos/",
        "docs",
    ):
        assert ask(f"{address}/{path}")[0] == 404


def test_the_command_serves_until_ctrl_c_and_continues(tmp_path: Path) -> None:
    study = small_study(clips=2)
    write_study(tmp_path / "study", study)
    words = [sys.executable, "-m", "facediff", "study", "serve", "study", "--port", "0"]
    for number, rater in enumerate(simulate(study, SCORES, 2)):
        with subprocess.Popen(
            words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
        ) as process:
            assert process.stdout is not None
            found = re.match(r"(http://127\.0\.0\.1:\d+)/ serves study", process.stdout.readline())
            assert found is not None
            assert begin(found[1], study, rater=rater.token) == (200, {"number": number})
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (0, "")
        assert f"study: {('1 rater', '2 raters')[number]}, " in out


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
