"""The page in a real browser, from the first click to stored answers: from a folder and from a server."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from facediff.study import read_study
from facediff.study.analysis import analyse_folder
from facediff.study.answers import check_rater
from facediff.study.definition import DATABASE, PAGE_FOLDER
from facediff.study.store import AnswerStore
from tests.fakes.chromium import Chromium, Page
from tests.study.conftest import Serve

HOSTILE = "'); DROP TABLE answers; -- </script><script>window.hacked = 1</script> =cmd() ü😀"


@pytest.fixture
def made(small: Path, tmp_path: Path) -> Path:
    """A study of the test's own."""
    return Path(shutil.copytree(small, tmp_path / "study"))


def opened(browser: Chromium, url: str, **window: Any) -> Page:  # noqa: ANN401 - passed on
    page = browser.open(url, **window)
    page.wait_for("window.facediffStudy")
    page.evaluate("localStorage.clear()")  # pages of all folders share one storage
    reload(page)
    return page


def reload(page: Page) -> None:
    """Load the page again and wait until it takes clicks; by the mark, the page that is left does not count."""
    page.evaluate("window.beforeReload = true, location.reload(), null")
    page.wait_for("!window.beforeReload && window.facediffStudy")


def begin(page: Page) -> None:
    page.evaluate("document.getElementById('agree').click()")
    page.evaluate("document.getElementById('start').click()")
    page.wait_for("facediffStudy.current")


def answer(page: Page, *, key: str = "ArrowLeft", clicks: int = 1) -> None:
    """Watch the video that is on, answer both questions by keys, and go on."""
    count = page.evaluate("facediffStudy.state.trials.length")
    assert page.evaluate("document.getElementById('next').disabled")
    page.evaluate("document.activeElement.blur()")
    page.press(" ")
    page.wait_for("facediffStudy.current.seen")
    page.evaluate("document.activeElement.blur()")
    page.press(key)
    page.press(key)
    page.evaluate(f"for (let i = 0; i < {clicks}; i += 1) document.getElementById('next').click()")
    page.wait_for(f"facediffStudy.state.trials.length === {count + 1}")


def finish(page: Page, text: str = "") -> None:
    page.wait_for("!document.getElementById('last').hidden")
    area = "document.querySelector('textarea')"
    page.evaluate(f"{area}.value = {json.dumps(text)}, {area}.dispatchEvent(new Event('input'))")
    page.evaluate("document.getElementById('finish').click()")
    page.wait_for("!document.getElementById('thanks').hidden")


def stays_clean(page: Page) -> None:
    assert page.problems == []
    assert page.evaluate("facediffStudy.problems") == []
    assert page.evaluate("window.hacked") is None


def test_served_from_the_first_click_to_the_report(made: Path, serve: Serve, browser: Chromium) -> None:
    address, study = serve(made), read_study(made)
    page = opened(browser, f"{address}/", width=1100, height=800)
    assert page.evaluate("facediffStudy.hasServer")
    assert page.evaluate("document.getElementById('title').textContent") == "<b>Faces</b> & more"
    assert page.evaluate("document.getElementById('start').disabled")
    begin(page)
    answer(page, clicks=3)  # a double click submits once
    answer(page, key="ArrowRight")
    reload(page)
    page.wait_for("facediffStudy.state.trials.length === 2")
    page.evaluate("document.getElementById('start').click()")
    page.wait_for("facediffStudy.current")
    assert page.evaluate("document.getElementById('count').textContent") == "Video 3 of 3"
    answer(page)
    finish(page, HOSTILE)
    page.wait_for("facediffStudy.state.closed")
    stays_clean(page)
    assert {url.split("/")[2] for url in page.requests if url.startswith("http")} == {address.split("/")[2]}
    (rater,) = AnswerStore(made / DATABASE, study).raters()
    assert [trial.id for trial in study.trials_of(0)] == list(rater.answers)
    given = [answer.answers for answer in rater.answers.values()]
    assert given == [{"realism": side, "lips": side} for side in ("left", "right", "left")]
    assert rater.comments == {"comments": HOSTILE}
    assert rater.finished is not None
    assert all(answer.plays == 1 and 0.3 < answer.seconds < 60 for answer in rater.answers.values())
    assert page.evaluate("document.getElementById('completion').textContent") == rater.token[:8].upper()
    page.close()
    report = analyse_folder(made)
    assert len(report.raters) == 1


@pytest.mark.slow
def test_from_a_folder_without_a_network_in_a_narrow_window(made: Path, browser: Chromium) -> None:
    study = read_study(made)
    url = (made / PAGE_FOLDER / "index.html").as_uri()
    page = opened(browser, f"{url}?rater=3", width=390, height=844, dark=True)
    assert not page.evaluate("facediffStudy.hasServer")
    select = "document.getElementById('language')"
    page.evaluate(f"{select}.value = 'de', {select}.onchange()")
    assert page.evaluate("document.getElementById('start').textContent") == "Beginnen"
    begin(page)
    assert page.evaluate("document.documentElement.lang") == "de"
    for key in ("ArrowLeft", "ArrowRight", "ArrowLeft"):
        answer(page, key=key)
    page.evaluate(
        "(window.blobs = [], window.natural = URL.createObjectURL.bind(URL), "
        "URL.createObjectURL = (blob) => (blobs.push(blob), natural(blob)), null)"
    )
    page.wait_for("!document.getElementById('last').hidden")
    page.evaluate(f"{select}.value = 'en', {select}.onchange()")
    assert page.evaluate("document.getElementById('fields').textContent").endswith("(optional)")
    finish(page, HOSTILE)
    page.evaluate(f"{select}.value = 'de', {select}.onchange()")
    assert page.evaluate("document.getElementById('thanks-more').textContent").startswith("Bitte laden")
    assert page.evaluate("document.getElementById('download').href").startswith("blob:")
    content = json.loads(page.evaluate("blobs.at(-1).text()"))
    rater = check_rater(content, study, "download")
    assert (rater.number, rater.language, rater.comments) == (3, "de", {"comments": HOSTILE})
    assert [trial.id for trial in study.trials_of(3)] == list(rater.answers)
    assert {url.split(":")[0] for url in page.requests} <= {"file", "blob", "data"}
    stays_clean(page)
    page.close()


def test_what_is_refused_for_good_is_not_tried_for_ever(made: Path, serve: Serve, browser: Chromium) -> None:
    page = opened(browser, f"{serve(made)}/")
    answering = (
        "((status) => { window.asked = 0; window.natural ??= window.fetch;"
        " window.fetch = status === null ? window.natural :"
        " () => (window.asked += 1, Promise.resolve(new Response('', {status}))); return null; })"
    )
    said = "document.getElementById('status').textContent"
    page.evaluate(f"{answering}(403)")  # the study has all the raters that it takes
    page.evaluate("document.getElementById('agree').click(), document.getElementById('start').click()")
    page.wait_for(f"{said}.startsWith('This was refused')")
    page.wait_for("!document.getElementById('start').disabled")
    # What may pass is tried again without a click.
    page.evaluate(f"{answering}(503)")
    page.evaluate("document.getElementById('start').click()")
    page.wait_for(f"{said}.startsWith('Not sent yet; trying again')")
    page.evaluate(f"{answering}(null)")
    page.wait_for("facediffStudy.current")
    assert page.evaluate("document.getElementById('status').hidden")
    # A server that does not know the rater is asked once; what was answered is handed over.
    page.evaluate(f"{answering}(404)")
    answer(page)
    page.evaluate("new Promise((done) => setTimeout(done, 3500))")
    assert page.evaluate("asked") == 1
    assert page.evaluate("document.getElementById('status').hidden")
    answer(page)
    answer(page)
    finish(page)
    assert page.evaluate("document.getElementById('thanks-more').textContent").startswith("Please download")
    assert not page.evaluate("document.getElementById('download').hidden")
    assert page.evaluate("[facediffStudy.state.trials.length, facediffStudy.state.sent, asked]") == [3, 0, 1]
    stays_clean(page)
    page.close()


@pytest.mark.slow
def test_answers_wait_while_the_server_is_away(made: Path, serve: Serve, browser: Chromium) -> None:
    page = opened(browser, f"{serve(made)}/")
    begin(page)
    page.evaluate("window.natural = window.fetch, window.fetch = () => Promise.reject(new Error('away'))")
    answer(page)
    page.wait_for("!document.getElementById('status').hidden")
    assert page.evaluate("facediffStudy.state.sent") == 0
    page.wait_for("document.getElementById('video').readyState > 1")  # the next one is no reason to say no more
    assert page.evaluate("!document.getElementById('status').hidden")
    page.evaluate("document.getElementById('video').dispatchEvent(new Event('error'))")
    page.evaluate("window.fetch = window.natural")
    page.wait_for("facediffStudy.state.sent === 1")
    page.wait_for("document.getElementById('status').textContent.startsWith('This video cannot be played')")
    page.evaluate("document.getElementById('video').dispatchEvent(new Event('loadeddata'))")
    page.wait_for("document.getElementById('status').hidden")
    # What is refused for good keeps nothing back, and stays in the browser.
    refusing = "window.fetch = () => (window.fetch = window.natural, Promise.resolve(new Response('', {status: 400})))"
    page.evaluate(f"{refusing}, null")
    answer(page)
    answer(page)
    page.wait_for("facediffStudy.state.sent === 3")
    stays_clean(page)
    finish(page)
    page.wait_for("document.getElementById('thanks-more').textContent.startsWith('Please download')")
    assert not page.evaluate("document.getElementById('download').hidden || facediffStudy.state.closed")
    (rater,) = AnswerStore(made / DATABASE, read_study(made)).raters()
    assert len(rater.answers) == 2
    assert page.evaluate("facediffStudy.problems") == []
    page.close()


CONTRAST = """(() => {
  const light = (colour) => {
    const [r, g, b] = colour.match(/[\\d.]+/g).slice(0, 3).map((v) => v / 255)
      .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const colour = getComputedStyle(e).backgroundColor;
      if (!/, 0\\)$|transparent/.test(colour)) return colour;
    }
    return "rgb(255, 255, 255)";
  };
  return [...document.querySelectorAll("p, button, label, legend, h1, figcaption, footer, span, select")]
    .filter((e) => e.offsetParent && e.textContent.trim()).map((e) => {
      const [a, b] = [light(getComputedStyle(e).color), light(ground(e))].sort((x, y) => y - x);
      return [(a + 0.05) / (b + 0.05), e.id || e.tagName];
    });
})()"""


@pytest.mark.parametrize(("width", "height", "dark"), [(1280, 800, False), (390, 844, True), (844, 390, False)])
def test_wide_and_narrow_windows_have_room_contrast_and_large_targets(
    made: Path, browser: Chromium, width: int, height: int, dark: bool
) -> None:
    page = opened(browser, (made / PAGE_FOLDER / "index.html").as_uri(), width=width, height=height, dark=dark)
    for part in ("welcome", "trial"):
        if part == "trial":
            page.evaluate("document.getElementById('agree').click()")
            page.evaluate("document.getElementById('start').click()")
            page.wait_for("facediffStudy.current")
        assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
        contrasts = page.evaluate(CONTRAST)
        assert len(contrasts) > 5
        assert [name for ratio, name in contrasts if ratio < 4.5] == []
        targets = page.evaluate(
            "[...document.querySelectorAll('button, select, .options label, .line')].filter((e) => e.offsetParent)"
            ".map((e) => e.getBoundingClientRect().height)"
        )
        assert min(targets) >= 43.5
    assert page.evaluate("[...document.querySelectorAll('input')].every((e) => e.labels.length)")
    choose = "(find => (find.value = 'de', find.onchange()))(document.getElementById('language'))"
    page.evaluate(choose)
    assert page.evaluate("document.getElementById('count').textContent").startswith("Video 1 von ")
    # A question whose name every object has is not answered by that.
    page.evaluate(
        "facediffStudy.current.seen = true, facediffStudy.study.questions[0].name = 'constructor', "
        "document.getElementById('language').onchange(), null"
    )
    assert page.evaluate("document.getElementById('choices').firstChild.classList.contains('now')")
    page.close()


def test_the_page_names_no_method_and_no_control(made: Path) -> None:
    text = (made / PAGE_FOLDER / "index.html").read_text()
    study = read_study(made)
    for word in ("ours", "theirs", "A_one", "A_two", '"kind": "still"', str(made)):
        assert word not in text
    assert {path.name for path in (made / PAGE_FOLDER / "videos").iterdir()} == set(study.videos())
    assert sorted(path.name for path in (made / PAGE_FOLDER).iterdir()) == ["index.html", "videos"]
