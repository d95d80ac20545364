"""The page of an exported model in a real browser: the motion of the Python runtime, and errors in words."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import soundfile

import facediff
from facediff.animation import Animation, metres_per_unit, read_archive
from facediff.pipelines.export_model import export_model
from facediff.runtime.folder import read_folder
from facediff.runtime.onnxruntime_web import web_runtime
from facediff.runtime.site import PAGE, make_site
from facediff.speech.audio import read_speech
from tests.fakes.chromium import Chromium, Page
from tests.fakes.contrasts import CONTRASTS
from tests.runtime.test_every_model import CASES, PLAN, Sources, ready, sources
from tests.runtime.test_runtime import folder as as_exported
from tests.runtime.test_runtime import largest, model, sound
from tests.runtime.test_site import Serve, serve

__all__ = ["as_exported", "model", "serve", "sources"]

pytest.importorskip("onnxscript")

HOSTILE = "</script><img src=x onerror=alert(1)>"
BYTES = """((bytes) => {
  let text = "";
  for (let at = 0; at < bytes.length; at += 32768) text += String.fromCharCode(...bytes.subarray(at, at + 32768));
  return btoa(text);
})"""


@pytest.fixture(scope="module")
def web_files(web_runtime_package: Path) -> dict[str, Path]:
    return web_runtime(web_runtime_package)


@pytest.fixture(scope="module")
def folder(as_exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model whose sampler also takes its first prediction into account, as those of few steps do."""
    path = Path(shutil.copytree(as_exported, tmp_path_factory.mktemp("page") / "tiny-onnx"))
    facts = json.loads((path / "model.json").read_text())
    facts["table"][1].append(0.25)
    (path / "model.json").write_text(json.dumps(facts))
    return path


@pytest.fixture(scope="module")
def site(folder: Path, web_files: dict[str, Path]) -> dict[str, bytes | Path]:
    """The site of the tiny model; what a test changes in it is seen by the pages that are open."""
    recording = record(folder.parent / "an example.wav", 1.2)
    return dict(make_site(folder, web_files, [recording]))


@pytest.fixture(scope="module")
def page(site: dict[str, bytes | Path], browser: Chromium, serve: Serve) -> Iterator[Page]:
    """The page of the model. At the end nothing may have gone wrong in it, and nothing may have left it."""
    address = serve(site)
    shown = browser.open(address)
    shown.wait_for("window.facediff && (facediff.ready || facediff.errors.length)")
    yield shown
    assert shown.problems == []
    assert shown.evaluate("facediff.errors") == []
    assert [url for url in shown.requests if not url.startswith((address, "blob:", "data:"))] == []
    shown.close()


def choose(page: Page, file: Path) -> None:
    """Choose a recording as a person does, and wait for its motion."""
    root = page.send("DOM.getDocument")["root"]["nodeId"]
    field = page.send("DOM.querySelector", nodeId=root, selector="#file")["nodeId"]
    page.send("DOM.setFileInputFiles", files=[str(file)], nodeId=field)
    page.wait_for("facediff.finished || facediff.errors.length")


def archive_of(page: Page, path: Path) -> Animation:
    """The animation that the page gives as a file."""
    packed = "facediff.page.archive().then((parts) => new Blob(parts).arrayBuffer())"
    text = page.evaluate(f"{packed}.then((all) => {BYTES}(new Uint8Array(all)))")
    path.write_bytes(base64.b64decode(text))
    return read_archive(path)


def record(path: Path, seconds: float) -> Path:
    """A recording with a pause at its end, in 16 bits."""
    samples = np.concatenate([sound(seconds - 0.5), np.zeros(8000, np.float32)])
    soundfile.write(path, samples, 16_000, subtype="PCM_16")
    return path


def test_page_gives_the_motion_of_the_python_runtime(folder: Path, page: Page, tmp_path: Path) -> None:
    exported = facediff.load(folder)
    assert page.evaluate("crossOriginIsolated")
    choices = {"identity": "B", "style": "A", "seed": 5, "expressivity": 1.5}
    for seconds in (1.6, 4.3):  # in one pass, and by windows of which the last is short
        file = record(tmp_path / "hello.wav", seconds)
        for name, value in choices.items():
            page.evaluate(f"document.getElementById('{name}').value = '{value}'")
        choose(page, file)
        found = archive_of(page, tmp_path / "found.npz")
        speech = read_speech(file)
        wanted = exported.animate(speech, 16_000, **choices, name="hello")  # type: ignore[call-overload]
        assert largest(found.vertices, wanted.vertices) < 1e-4
        np.testing.assert_array_equal(found.speech, speech)
        np.testing.assert_array_equal(found.triangles, wanted.triangles)
        assert (found.name, found.frame_rate, found.unit) == (wanted.name, wanted.frame_rate, wanted.unit)
        own = {"generator": found.metadata["generator"], "checkpoint": folder.name}  # a page has no name of its folder
        assert {**found.metadata, **own} == {**wanted.metadata, **own}
        assert found.regions.keys() == wanted.regions.keys()
    page.evaluate("facediff.page.animate(facediff.page.choices, facediff.page.delays[0])")
    wanted = exported.animate(speech, 16_000, **choices, low_latency=True)  # type: ignore[call-overload]
    found = archive_of(page, tmp_path / "found.npz")
    assert largest(found.vertices, wanted.vertices) < 1e-4
    assert found.metadata["sampler"] == wanted.metadata["sampler"]


def test_page_plays_and_obeys_keys_and_buttons(page: Page, tmp_path: Path) -> None:
    page.evaluate("document.getElementById('identity').value = 'A'")
    choose(page, record(tmp_path / "hello.wav", 1.6))
    page.wait_for("facediff.frame > 5")  # it plays by itself
    page.press("ArrowLeft")
    page.wait_for("!facediff.playing")
    page.press("End")
    page.wait_for("facediff.frame === 39")
    page.press("Home")
    page.wait_for("facediff.frame === 0")
    shown = "[...facediff.page.stage.face.positions]"
    first = page.evaluate(shown)
    page.press("ArrowRight")
    page.wait_for("facediff.frame === 1")
    page.wait_for(f"String({shown}) !== '{','.join(map(str, first[:3]))}' && facediff.page.stage.shown > 2")
    offsets = np.array(page.evaluate("[...facediff.page.animated.at(1)]")) * 1000
    template = np.array(page.evaluate("[...facediff.page.stage.face.template]"))
    np.testing.assert_allclose(page.evaluate(shown), template + offsets, atol=1e-3)
    page.evaluate("(page => (page.seek(10), page.step(1), page.step(1)))(facediff.page)")  # quicker than pictures
    page.wait_for("facediff.frame === 12")
    # A pause while the model is not as far yet is none of its waits, which end by themselves.
    playing = "document.getElementById('play').classList.contains('playing')"
    page.evaluate("(window.plays = 0, document.getElementById('sound').addEventListener('play', () => plays++), 0)")
    ready = "Object.assign(page.animated, {{ ready: {}, done: {} }})".format
    page.evaluate(f"(page => (page.seek(36), {ready(30, 'false')}, page.play(), 0))(facediff.page)")
    page.wait_for(f"facediff.page.waits && {playing}")
    page.evaluate(f"(page => (page.pause(), {ready(40, 'true')}, page.play(), 0))(facediff.page)")
    page.wait_for(f"!facediff.playing && facediff.frame === 39 && !{playing}")
    assert page.evaluate("plays") == 2
    # Another face of the model has no animation yet.
    page.press(" ")
    page.wait_for(playing)
    page.evaluate(
        "(find => (find.value = 'B', find.dispatchEvent(new Event('change'))))(document.getElementById('identity'))"
    )
    assert page.evaluate("document.getElementById('play').disabled && !document.getElementById('again').disabled")
    page.wait_for(f"!{playing}")
    page.evaluate("document.getElementById('again').click()")
    page.wait_for("facediff.finished")
    assert page.evaluate("facediff.page.animated.names.identity") == "B"
    page.evaluate("(document.getElementById('again').click(), document.getElementById('cancel').click())")
    page.wait_for("!facediff.page.job && !facediff.page.animated")


def test_the_face_needs_nothing_but_the_page(
    site: dict[str, bytes | Path], folder: Path, browser: Chromium, serve: Serve
) -> None:
    """It is drawn before worker, ONNX Runtime and model are asked for, none of which this site has."""
    page = browser.open(serve({PAGE: site[PAGE]}))
    page.wait_for("window.facediff?.errors.length")
    assert page.evaluate("document.body.classList.contains('ready') && facediff.page.stage.shown > 0")
    description, arrays = read_folder(folder)
    template = arrays["templates"][description.faces.index(description.known[0])]
    found = np.reshape(page.evaluate("[...facediff.page.stage.face.positions]"), (-1, 3))
    np.testing.assert_allclose(found, 1000 * metres_per_unit(description.unit) * template, rtol=1e-5, atol=1e-3)
    page.close()


def test_an_example_of_the_site_is_animated_as_a_chosen_file(page: Page) -> None:
    assert page.evaluate("[...document.querySelectorAll('#examples button')].map((each) => each.textContent)") == [
        "an example"
    ]
    page.evaluate("document.querySelector('#examples button').click()")
    page.wait_for("facediff.finished || facediff.errors.length")
    assert page.evaluate("[facediff.page.animated.name, facediff.page.animated.frames]") == ["an example", 30]


def test_the_head_sways_while_it_speaks_unless_that_is_switched_off(page: Page) -> None:
    lean = "(facediff.page.stage.sway({}), Math.max(...facediff.page.stage.lean.map(Math.abs)))"
    assert page.evaluate(lean.format("null")) == page.evaluate(lean.format(0)) == 0
    most = max(page.evaluate(lean.format(time)) for time in range(1, 20))
    assert np.deg2rad(0.5) < most < np.deg2rad(2.5)
    page.evaluate("document.getElementById('sway').click()")
    page.evaluate("facediff.page.show(new Float32Array(facediff.page.size), 5)")
    assert page.evaluate("facediff.page.stage.lean") == [0, 0]
    page.evaluate("document.getElementById('sway').click()")


@pytest.mark.parametrize("rate", [44_100, 48_000, 8000])
def test_resampling_keeps_what_speech_has_and_brings_no_aliases(rate: int, page: Page) -> None:
    """A tone of 1 kHz stays as it is, in whatever pieces it comes; one of 11 kHz, which 16 kHz cannot hold, is gone."""
    script = f"""(() => {{
      const wave = (hertz) => (_, i) => Math.sin((2 * Math.PI * hertz * i) / {rate});
      const tone = (hertz) => Float32Array.from({{ length: {rate} / 4 }}, wave(hertz));
      const heard = (samples, piece) => {{
        const resampler = facediff.resampler({rate}, 16000), made = [];
        for (let at = 0; at < samples.length; at += piece) {{
          made.push(...resampler.feed(samples.subarray(at, at + piece)));
        }}
        return made;
      }};
      return [heard(tone(1000), 882), heard(tone(1000), 77), heard(tone(11000), 882)];
    }})()"""
    kept, again, gone = (np.array(each) for each in page.evaluate(script))
    np.testing.assert_array_equal(kept, again)
    assert len(kept) > 3800
    middle = slice(200, len(kept))  # at its beginning a tone is no pure one
    np.testing.assert_allclose(kept[middle], np.sin(2 * np.pi * np.arange(len(kept)) / 16)[middle], atol=1e-3)
    if rate > 22_000:
        assert np.abs(gone[middle]).max() < 1e-3


def test_recordings_of_other_rates_are_as_long_as_in_python(page: Page, tmp_path: Path) -> None:
    """Of a file in 16 bits, after a remark of an odd number of bytes; one without a rate is no sound."""
    for rate, count in ((48_000, 12_352), (11_025, 1000)):
        wave = np.sin(np.arange(count) * 2500 / rate) / 2
        soundfile.write(tmp_path / "speech.wav", wave, rate, subtype="PCM_16")
        content = (tmp_path / "speech.wav").read_bytes()
        content = content[:36] + b"note\x03\0\0\0abc\0" + content[36:]
        heard = f"""(async () => {{
          const bytes = Uint8Array.from(atob("{base64.b64encode(content).decode()}"), (each) => each.charCodeAt(0));
          const samples = await facediff.page.speechOf(new File([bytes], "speech.wav"));
          bytes.fill(0, 24, 28);
          const refused = await facediff.page.speechOf(new File([bytes], "still.wav")).catch((error) => error.message);
          return [[...samples], refused];
        }})()"""
        samples, refused = page.evaluate(heard)
        np.testing.assert_allclose(samples, read_speech(tmp_path / "speech.wav"), atol=2e-3)
        assert "still.wav" in refused


@pytest.mark.slow
@pytest.mark.parametrize("case", [name for name, (_, options) in CASES.items() if "space" not in options])
def test_every_model_moves_in_the_page_as_in_python(
    case: str,
    tiny_root: Path,
    tmp_path: Path,
    sources: Sources,
    web_files: dict[str, Path],
    browser: Chromium,
    serve: Serve,
) -> None:
    made = ready(case, tiny_root, sources)
    made.windows = PLAN
    export_model(made, tmp_path / "face")
    exported = facediff.load(tmp_path / "face")
    seeded = {"seed": 5} if read_folder(tmp_path / "face")[0].generation == "sampled" else {}
    page = browser.open(serve(make_site(tmp_path / "face", web_files)))
    page.wait_for("window.facediff && (facediff.ready || facediff.errors.length)")
    page.evaluate("document.getElementById('seed').value = 5")
    for seconds in (0.8, 4.3):
        file = record(tmp_path / "hello.wav", seconds)
        choose(page, file)
        found = archive_of(page, tmp_path / "found.npz")
        wanted = exported.animate(file, **seeded)
        assert largest(found.vertices, wanted.vertices) < 1e-4
        assert {**found.metadata, "generator": ""} == {**wanted.metadata, "generator": ""}
    assert page.problems == []
    assert page.evaluate("facediff.errors") == []
    page.close()


@pytest.mark.slow
def test_microphone_is_animated_frame_by_frame(
    folder: Path, web_files: dict[str, Path], program: Path, serve: Serve, tmp_path: Path
) -> None:
    """Chromium's microphone plays a recording over and over; the tiny model is quick enough for any machine."""
    file = record(tmp_path / "speech.wav", 4.0)
    flags = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream"]
    with Chromium(program, [*flags, f"--use-file-for-fake-audio-capture={file}"]) as running:
        page = running.open(serve(make_site(folder, web_files)), width=400, height=500)
        page.wait_for("window.facediff && (facediff.ready || facediff.errors.length)")
        page.evaluate("document.getElementById('microphone').click()")
        page.wait_for("facediff.listening?.shown > 150", 60)
        found = page.evaluate("({...facediff.listening, waiting: facediff.page.listening.queue.length})")
        assert page.evaluate("document.getElementById('open').disabled")
        assert found["lag"] < 1.0
        assert found["lost"] == 0
        assert found["waiting"] < 50  # memory does not grow
        seconds = page.evaluate("(performance.now() - facediff.page.listening.origin) / 1000")
        assert found["shown"] == pytest.approx((seconds - found["lag"]) * 25, abs=15)
        page.evaluate("document.getElementById('microphone').click()")
        page.wait_for("!facediff.listening && !document.getElementById('open').disabled")
        assert page.problems == []
        assert page.evaluate("facediff.errors") == []


@pytest.mark.slow
def test_without_a_microphone_or_leave_it_says_so(
    folder: Path, web_files: dict[str, Path], program: Path, serve: Serve
) -> None:
    with Chromium(program) as running:
        page = running.open(serve(make_site(folder, web_files)))
        page.wait_for("window.facediff && (facediff.ready || facediff.errors.length)")
        page.evaluate("document.getElementById('microphone').click()")
        page.wait_for("facediff.errors.length")
        assert "microphone" in page.evaluate("facediff.errors[0]")
        assert page.evaluate("!facediff.listening && !document.getElementById('open').disabled")
        # What fails after it was switched off does not end what was switched on after it.
        page.evaluate(
            "(facediff.errors.splice(0), window.refuse = [], navigator.mediaDevices.getUserMedia = () =>"
            " new Promise((_, reject) => refuse.push(reject)), null)"
        )
        for _ in range(3):  # on, off, and on again
            page.evaluate("document.getElementById('microphone').click()")
        page.evaluate("(refuse[0](new Error('late')), new Promise((done) => setTimeout(done, 100)))")
        assert page.evaluate("[refuse.length, Boolean(facediff.listening), facediff.errors.length]") == [2, True, 0]
        page.evaluate("(refuse[1](new Error('now')), null)")
        page.wait_for("!facediff.listening && facediff.errors.length === 1")


@pytest.mark.parametrize(("width", "height", "dark"), [(1280, 800, True), (375, 740, False)])
def test_wide_and_narrow_windows_have_room_and_contrast(width: int, height: int, dark: bool, page: Page) -> None:
    page.resize(width, height)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    page.send("Emulation.setEmulatedMedia", features=[scheme])
    facts = page.evaluate(
        """({
          over: document.documentElement.scrollWidth - innerWidth,
          below: document.documentElement.scrollHeight - innerHeight,
          stage: document.getElementById("stage").getBoundingClientRect().height,
          controls: [...document.querySelectorAll("button, select, input")].filter((each) => each.offsetParent)
            .map((each) => [each.getBoundingClientRect().left, each.getBoundingClientRect().right]),
          named: [...document.querySelectorAll("button, select, input")]
            .every((each) => (each.ariaLabel || each.textContent || each.labels?.[0]?.textContent || "").trim()),
        })"""
    )
    assert facts["over"] <= 0
    assert facts["below"] <= 0
    assert facts["stage"] > 150
    assert facts["named"]
    assert all(left >= 0 and right <= width for left, right in facts["controls"])
    contrasts = page.evaluate(CONTRASTS)
    assert len(contrasts) > 10
    assert min(contrasts)[0] >= 4.5, min(contrasts)


def test_damaged_model_is_refused_in_words_and_names_are_text(
    folder: Path, site: dict[str, bytes | Path], page: Page
) -> None:
    """Models that are changed after the page was made, as on anybody's server."""
    whole, about = dict(site), json.loads((folder / "model.json").read_text())
    arrays = (folder / "arrays.npz").read_bytes()
    flipped = arrays[:120] + bytes([arrays[120] ^ 1]) + arrays[121:]  # in the numbers of the first array
    speech = b"!" * about["sizes"]["speech.onnx"]
    reload = "facediff.page.load('wasm').then(() => '', (error) => error.message)"

    def described(**fields: object) -> bytes:
        return json.dumps({**about, **fields}).encode()

    cases: list[tuple[str, bytes, str]] = [
        ("model.json", b"{", "model.json"),
        ("model.json", b"[]", "model.json"),
        ("model.json", described(frame_rate=1e9), "frame_rate"),
        ("model.json", described(windows={"seconds": 1e9}), "windows"),
        ("model.json", described(sizes={}), "sizes"),
        ("model.json", described(faces=["A", HOSTILE]), "templates"),
        ("arrays.npz", arrays + b"!", "arrays.npz"),
        ("arrays.npz", flipped, "arrays.npz"),
        ("speech.onnx", speech, "speech.onnx"),
    ]
    for name, content, named in cases:
        site[f"model/{name}"] = content
        assert named in page.evaluate(reload)
        site.update(whole)
    example = "facediff.page.openExample('an example.wav').then(() => '', (error) => error.message)"
    assert "not loaded" in page.evaluate(example)
    page.evaluate("facediff.page.facts.threads = 3")
    assert page.evaluate(reload) == ""
    assert "WebAssembly, 3 threads" in page.evaluate("document.getElementById('about').textContent")
    hostile = [HOSTILE, *about["faces"][1:]]
    site["model/model.json"] = described(model=HOSTILE, faces=hostile, identities=hostile[:2], styles=about["styles"])
    page.evaluate("(facediff.page.about = null, document.getElementById('identity').replaceChildren())")
    assert page.evaluate(reload) == ""
    assert page.evaluate("document.getElementById('identity').value") == HOSTILE
    assert HOSTILE in page.evaluate("document.getElementById('about').textContent")
    assert page.evaluate("document.images.length") == 0
