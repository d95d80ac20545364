"""The page's editor of keys, its preview, its comparison of takes and its downloads, in a real browser.

What the page computes is compared with what Python computes from the same keys, and what it writes is read by the
readers of the command line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation, read_archive
from facediff.editing.controls.direction import METADATA, STEP_SECONDS, Direction, Key, curve, read_direction
from facediff.errors import FaceDiffError
from facediff.export.format import linear_colours
from facediff.speech.phonemes import TimedPhoneme, phonemes_text
from facediff.synthetic.known_faces import built_in_shapes
from tests.fakes.chromium import Page
from tests.fakes.clicks import FRAMES, RATE, SAMPLE_RATE, clicks
from tests.fakes.contrasts import CONTRASTS
from tests.fakes.glb_reader import Reader
from tests.fakes.waiting import wait_until

Show = Callable[..., Page]
HOSTILE = "</script><img src=x onerror='window.hacked = 1'>"
LOW = "low <img src=x onerror='window.hacked = 1'>"
KEYS = Direction(
    [
        Key(0.2, "expressiveness", 1.0),
        Key(0.6, "expressiveness", 2.5, "linear"),
        Key(1.0, "expressiveness", 1.5, "step"),
        Key(1.4, "expressiveness", 3.0, slope=4.0),
        Key(1.8, "expressiveness", 3.25),
        Key(2.4, "expressiveness", 0.5),
        Key(0.1, "head.yaw", -10.0, "linear"),
        Key(2.0, "head.yaw", 20.0),
        Key(0.5, "style", HOSTILE, "step"),
    ]
)


TAKE = {"options": json.dumps(["--blinks", "12", "--eyes", "my eyes.json"])}


def directed(keys: Direction = KEYS, **changes: object) -> Animation:
    """The face of clicks, with two regions, made with keys."""
    regions = {"lips": np.arange(4, 8), LOW: np.arange(8, 12)}
    made = clicks()
    return replace(made, regions=regions, metadata={**made.metadata, **TAKE, METADATA: keys.text()}, **changes)  # type: ignore[arg-type]


def keys_in(page: Page) -> Direction:
    return Direction.parse(page.evaluate("facediff.direction"), "page")


def lane(page: Page, name: str) -> tuple[float, float, float, float]:
    """Left, top, width and height of the part of a channel's lane in which keys lie."""
    found = page.evaluate(
        f"(async () => {{ const canvas = [...document.querySelectorAll('.lane')].find((each) => each.textContent"
        f".startsWith('{name}')).querySelector('canvas');"
        f" canvas.scrollIntoView({{ block: 'nearest' }}); canvas.focus();"
        # The browser gives a click to what its last picture has there: scrolling must have been drawn.
        f" for (let i = 0; i < 2; i++) await new Promise(requestAnimationFrame);"
        f" const box = canvas.getBoundingClientRect(); return [box.left, box.top, box.width, box.height]; }})()"
    )
    left, top, width, height = found
    return left + 46, top + 9, width - 60, height - 18


def at(page: Page, name: str, seconds: float, share: float) -> tuple[float, float]:
    """A point of a lane, by time and by share of the channel's range."""
    left, top, width, height = lane(page, name)
    return left + width * seconds * RATE / FRAMES, top + (1 - share) * height


def double_click(page: Page, point: tuple[float, float]) -> None:
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            x, y = point
            page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=count)


def press(page: Page, key: str, modifiers: int = 0) -> None:
    """Press a key: modifiers are 2 for Ctrl and 8 for Shift."""
    for kind in ("keyDown", "keyUp"):
        page.send("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers)


def downloaded(page: Page, folder: Path, action: Callable[[], object]) -> Path:
    """The file that an action makes the page give its reader."""
    folder.mkdir()
    page.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
    action()

    def files() -> list[Path]:  # whole: while it comes, its name is held by an empty file
        ours = (".json", ".npz", ".glb", ".wav", ".csv")
        return [file for file in folder.iterdir() if file.suffix in ours and file.stat().st_size]

    wait_until(files)
    return files()[0]


def test_keys_come_back_as_they_were_and_their_curves_are_those_of_python(show: Show) -> None:
    spoken = phonemes_text([TimedPhoneme(0.1, 0.5, "m", word=HOSTILE), TimedPhoneme(0.5, 1.4, "ɑː", word=HOSTILE)])
    made = directed()
    page = show([replace(made, metadata={**made.metadata, "phonemes": spoken}), clicks(name="other")])
    assert page.evaluate("[sounds.ariaLabel ?? sounds.getAttribute('aria-label'), voice.hidden]") == [HOSTILE, False]
    assert page.evaluate("sounds.getContext('2d').getImageData(0, 0, sounds.width, sounds.height).data.some(Boolean)")
    assert keys_in(page).rows() == KEYS.rows()
    times = np.linspace(-0.1, 3.1, 161)
    for name, easing, eased in (
        ("expressiveness", 0, False),
        ("expressiveness", STEP_SECONDS, True),
        ("head.yaw", 0, False),
    ):
        expected = curve(KEYS.channels[name], times, eased=eased)
        found = page.evaluate(f"{times.tolist()}.map((time) => facediff.directed('{name}', time, {easing}))")
        assert np.allclose(found, expected, atol=1e-9)
    assert page.evaluate("[direction.hidden, document.querySelectorAll('.lane').length]") == [False, 3]
    offered = page.evaluate("[...document.getElementById('add-channel').options].map(({ value }) => value)")
    assert {"acting", "head.pitch", "expressiveness.lips", f"expressiveness.{LOW}"} < set(offered)
    assert "head" not in offered
    assert page.evaluate("window.hacked") is None
    # Lanes that have left the page are not drawn any more, when the colours change.
    page.evaluate(
        "(async () => { for (const number of [1, 0]) {"
        " directed.value = number; directed.dispatchEvent(new Event('change')); }"
        " for (let i = 0; i < 2; i++) await new Promise(requestAnimationFrame);"
        " const paper = CanvasRenderingContext2D.prototype, { clearRect } = paper;"
        " window.drawn = { true: 0, false: 0 };"
        " paper.clearRect = function (...box) {"
        " drawn[this.canvas.isConnected] += 1; clearRect.apply(this, box); }; })()"
    )
    page.send("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    page.wait_for("matchMedia('(prefers-color-scheme: dark)').matches && drawn.true >= 3")
    assert page.evaluate("drawn.false") == 0


def test_keys_are_added_dragged_changed_removed_undone_and_saved(show: Show, tmp_path: Path) -> None:
    page = show([directed(Direction([Key(1.0, "expressiveness", 2.0)]))], width=760, height=800)
    before = page.evaluate("facediff.direction")
    double_click(page, at(page, "expressiveness", 1.611, 0.75))
    after_adding = keys_in(page).channels["expressiveness"]
    assert [key.time for key in after_adding] == [1.0, 1.6]  # the nearest frame
    assert after_adding[1].value == pytest.approx(3.0, abs=0.1)
    # A drag is one step of the history, and stays between the neighbours.
    start, end = at(page, "expressiveness", 1.6, after_adding[1].value / 4), at(page, "expressiveness", 2.207, 0.25)
    page.drag(start, end)
    moved = keys_in(page).channels["expressiveness"][1]
    assert moved.time == pytest.approx(2.2)
    assert moved.value == pytest.approx(1.0, abs=0.1)
    press(page, "z", 2)
    assert keys_in(page).channels["expressiveness"] == after_adding
    press(page, "z", 2 + 8)
    assert keys_in(page).channels["expressiveness"][1] == moved
    # By keyboard alone: choose, move, raise, bend, add at the shown frame, remove.
    page.evaluate("facediff.seek(20)")
    lane(page, "expressiveness")
    for key, modifiers in (("Escape", 0), ("ArrowRight", 0), ("ArrowRight", 8), ("ArrowUp", 0), ("2", 0)):
        press(page, key, modifiers)
    first = keys_in(page).channels["expressiveness"][0]
    assert first == Key(26 / RATE, "expressiveness", 2.1, "linear")
    page.evaluate("facediff.seek(20)")
    press(page, "Enter")
    assert [key.time for key in keys_in(page).keys] == [20 / RATE, 26 / RATE, moved.time]
    press(page, "Delete")
    # A channel without keys yet, and numbers that are typed.
    add = "document.getElementById('add-channel')"
    page.evaluate(f"{add}.value = 'head.pitch', {add}.dispatchEvent(new Event('change'))")
    lane(page, "head.pitch")
    press(page, "Enter")
    for name, words in (("value", "99"), ("kind", "step"), ("time", "0.333")):
        field = f"document.getElementById('key-{name}')"
        page.evaluate(f"{field}.value = '{words}', {field}.dispatchEvent(new Event('change'))")
    assert keys_in(page).channels["head.pitch"] == (Key(0.333, "head.pitch", 30.0, "step"),)
    assert min(page.evaluate(CONTRASTS))[0] >= 4.5
    wanted = keys_in(page)
    saved = downloaded(page, tmp_path / "saved", lambda: page.evaluate("document.getElementById('save-keys').click()"))
    assert saved.name == "clicks_keys.json"
    assert read_direction(saved).rows() == wanted.rows()
    command = page.evaluate("document.getElementById('command').textContent")
    assert command.startswith("facediff animate SPEECH.wav --still --checkpoint ")
    assert "--identity nobody" in command
    assert "--blinks 12 --eyes 'my eyes.json' --direction clicks_keys.json" in command
    for _ in range(12):
        press(page, "z", 2)
    assert page.evaluate("facediff.direction") == before
    # The file comes back by the page's own button, and a wrong one changes nothing.
    open_file = (
        "(async (text) => { const given = new DataTransfer(), input = document.getElementById('keys-file');"
        " given.items.add(new File([text], 'keys.json')); input.files = given.files;"
        " input.dispatchEvent(new Event('change')); await new Promise((done) => setTimeout(done, 100));"
        " return document.getElementById('direction-said').textContent; })"
    )
    page.evaluate(f"{open_file}({json.dumps(saved.read_text())})")
    assert keys_in(page).rows() == wanted.rows()
    # Texts may stand for numbers.
    row = {"time": "1.5", "channel": "brows", "value": "-2e0", "slope": "+.5"}
    page.evaluate(f"{open_file}({json.dumps(json.dumps([row]))})")
    assert keys_in(page) == Direction.parse([row], "page")
    page.evaluate(f"{open_file}({json.dumps(saved.read_text())})")
    row = {"time": 0, "channel": "expressiveness", "value": 1}
    for change, words in (
        ({"time": "00:00:01:12"}, "row 1: time"),
        ({"time": ["1"]}, "row 1: time"),
        ({"frame": 1}, "row 1: frame"),
        ({"value": "1_0"}, "row 1: value"),
        ({"slope": "steep"}, "row 1: slope"),
        ({"slope": 2e6}, "row 1: slope"),
        ({"slope": 1, "channel": "style", "value": "a"}, "row 1: slope"),
        ({"ease": 1}, "row 1: ease"),
    ):
        with pytest.raises(FaceDiffError, match="row 1: "):
            Direction.parse([{**row, **change}], "python")
        assert words in page.evaluate(f"{open_file}({json.dumps(json.dumps([{**row, **change}]))})")
        assert keys_in(page).rows() == wanted.rows()
    for wrong, words in (
        ('{"keys": [{"time": 1, "channel": "brow", "value": 1}]}', "row 1: channel"),
        ('{"keys": [{"time": 1, "channel": "expressiveness", "value": 5}]}', "row 1: value"),
        ('{"keys": [{"time": "1 s", "channel": "expressiveness", "value": 1}]}', "row 1: time"),
        ('{"keys": [], "framerate": 25}', "framerate: "),
        ('{"keys": [], "format": null}', "no keys file"),
        ('{"keys": [], "version": null}', "version null"),
        ('{"keys": [null]}', "row 1: channel"),
        ("null", "keys.json: holds no list"),
        ("{", "nothing was changed"),
    ):
        assert words in page.evaluate(f"{open_file}({json.dumps(wrong)})")
        assert keys_in(page).rows() == wanted.rows()


def test_preview_of_changed_keys_is_what_a_new_run_makes(show: Show) -> None:
    """The page starts from the take that was made with old keys; the other way is from the bare motion."""
    bare = directed(Direction([Key(0, "head.roll", 0.0)]))
    bare = replace(bare, metadata={})
    old = [Key(0, "expressiveness", 2.0), Key(0, "head.yaw", -10.0, "linear"), Key(2, "head.yaw", 20.0)]
    new = [Key(0, "expressiveness", 0.5), Key(0, "expressiveness.lips", 3.0), Key(0, "head.pitch", 25.0)]
    made = bare.control(direction=Direction(old), sway=3.0)
    page = show([made], width=600, height=500)
    frame = "(async (frame) => { await facediff.seek(frame); return [...facediff.positions(0)]; })"
    before = np.reshape(page.evaluate(f"{frame}(31)"), (-1, 3))
    assert np.allclose(before, made.vertices[31], atol=0.03)
    page.evaluate(f"facediff.openKeys({json.dumps(json.dumps({'keys': Direction(new).rows()}))})")
    wanted = bare.control(direction=Direction(new), sway=3.0)
    for number in (31, 63):
        found = np.reshape(page.evaluate(f"{frame}({number})"), (-1, 3))
        assert np.allclose(found, wanted.vertices[number], atol=0.2)  # weights in 255ths of up to 60 mm
        assert not np.allclose(found, made.vertices[number], atol=2)
    page.evaluate("document.getElementById('preview').click()")
    assert np.array_equal(np.reshape(page.evaluate(f"{frame}(31)"), (-1, 3)), before)


def test_lanes_are_magnified_and_several_keys_are_moved_copied_and_pasted(show: Show) -> None:
    keys = [Key(time, "head.pitch", value) for time, value in ((0.4, 0.0), (0.8, 3.0), (1.2, -1.0), (2.0, 0.0))]
    page = show([directed(Direction([*keys, Key(0.8, "brows", 5.0)]))], width=1000, height=900)

    def mouse(kind: str, point: tuple[float, float], modifiers: int = 0, **more: object) -> None:
        page.send("Input.dispatchMouseEvent", type=kind, x=point[0], y=point[1], modifiers=modifiers, **more)

    def drag(start: tuple[float, float], end: tuple[float, float], modifiers: int = 0) -> None:
        mouse("mousePressed", start, modifiers, button="left", buttons=1, clickCount=1)
        mouse("mouseMoved", end, modifiers, button="left", buttons=1)
        mouse("mouseReleased", end, modifiers, button="left", clickCount=1)

    def point(name: str, seconds: float, value: float) -> tuple[float, float]:
        """A point of a lane as it is magnified."""
        left, top, width, height = lane(page, name)
        (start, end), (low, high) = page.evaluate(f"[facediff.stretch, facediff.seen('{name}')]")
        return left + width * (seconds - start) / (end - start), top + height * (high - value) / (high - low)

    def rows(name: str) -> list[tuple[float, float]]:
        return [(round(key.time, 6), float(key.value)) for key in keys_in(page).channels.get(name, ())]

    # Ctrl and the wheel magnify the time by e in 250 pixels, about the pointer; Shift scrolls it; 0 shows all.
    whole = FRAMES / RATE
    mouse("mouseWheel", point("head.pitch", 1.2, 0), 2, deltaX=0, deltaY=-250)
    page.wait_for(f"facediff.stretch[1] < {whole - 0.01}")
    start, end = page.evaluate("facediff.stretch")
    assert end - start == pytest.approx(whole / math.e)
    assert (1.2 - start) / (end - start) == pytest.approx(1.2 / whole, abs=0.01)
    # The shown time turns the page, by keyboard too.
    page.evaluate("facediff.seek(70)")
    assert page.evaluate("facediff.stretch[1] >= 70 / 25")
    for key, expected in (("PageUp", end - start), ("-", 1.5 * (end - start)), ("0", whole)):
        press(page, key)
        assert page.evaluate("facediff.stretch[1] - facediff.stretch[0]") == pytest.approx(expected)
    # A nod of three degrees fills its lane, and a drag by a tenth of the lane is a tenth of that.
    low, high = page.evaluate("facediff.seen('head.pitch')")
    assert (low, high) == (-10, 10)
    press(page, "f")
    low, high = page.evaluate("facediff.seen('head.pitch')")
    assert (low + high) / 2 == pytest.approx(1, abs=0.1)
    assert high - low == pytest.approx(5, abs=0.1)
    drag(point("head.pitch", 0.8, 3), point("head.pitch", 0.8, 2.5))
    assert rows("head.pitch")[1] == (0.8, pytest.approx(2.5, abs=0.16))
    press(page, "z", 2)
    # A box over two lanes, one more key by a click, and a drag of all of them: one step of the history.
    assert rows("head.pitch")[1] == (0.8, 3)
    drag(point("head.pitch", 0.6, 3.2), point("brows", 0.9, 0.0), 8)
    drag(point("head.pitch", 1.2, -1), point("head.pitch", 1.2, -1), 8)
    drag(point("head.pitch", 1.2, -1), point("head.pitch", 1.29, -0.5))
    assert rows("brows") == [(0.88, 5)]
    assert rows("head.pitch") == [
        (0.4, 0),
        (0.88, pytest.approx(3.5, abs=0.16)),
        (1.28, pytest.approx(-0.5, abs=0.16)),
        (2, 0),
    ]
    press(page, "z", 2)
    assert rows("brows") == [(0.8, 5)]
    assert rows("head.pitch")[1] == (0.8, 3)
    # By keyboard: two keys are copied, pasted at the shown frame, and moved, raised, bent and removed together.
    lane(page, "head.pitch")
    for key, modifiers in (("Escape", 0), ("ArrowRight", 0), ("ArrowRight", 0), ("ArrowRight", 2), ("c", 2)):
        press(page, key, modifiers)
    page.evaluate("facediff.seek(55)")
    press(page, "v", 2)
    assert rows("head.pitch")[-2:] == [(2.2, 3), (2.6, -1)]
    for key, modifiers in (("ArrowRight", 8), ("ArrowUp", 0), ("2", 0)):
        press(page, key, modifiers)
    raised = (high - low) / 40
    assert rows("head.pitch")[-2:] == [(2.24, pytest.approx(3 + raised)), (2.64, pytest.approx(-1 + raised))]
    assert [key.interpolation for key in keys_in(page).channels["head.pitch"][-2:]] == ["linear", "linear"]
    press(page, "Delete")
    assert len(rows("head.pitch")) == 4
    # Keys of one channel go into the lane that has the focus, within its range.
    lane(page, "brows")
    press(page, "v", 2)
    assert rows("brows") == [(0.8, 5), (2.2, 3), (2.6, -1)]
    press(page, "a", 2)
    press(page, "x", 2)
    assert rows("brows") == []
    for _ in range(9):
        press(page, "z", 2)
    assert keys_in(page).rows() == Direction([*keys, Key(0.8, "brows", 5.0)]).rows()
    assert page.evaluate("[...document.querySelectorAll('#direction button')].every((each) => each.textContent.trim())")


def test_shapes_brows_and_lids_are_previewed_and_acting_becomes_keys(show: Show, tmp_path: Path) -> None:
    """Within 0.1 mm of what the command makes of the same keys, from the take that was made with other ones."""
    (neutral, faces, shapes), frames = built_in_shapes("F1"), 60
    opening = (0.25 + 0.25 * np.sin(np.arange(frames) / 4))[:, None, None] * (shapes["jawOpen"] - neutral)
    loud = np.sin(np.arange(frames * 640) / 12) * (np.sin(np.arange(frames * 640) / 2500) > 0)
    bare = Animation(
        "puppet",
        (neutral + opening).astype(np.float32),
        neutral.astype(np.float32),
        RATE,
        faces=faces.astype(np.int32),
        speech=loud.astype(np.float32),
        metadata={"options": json.dumps(["--blinks", "40", "--acting", "prosody", "--controls-seed", "3"])},
    )
    old = Direction([Key(0, "shape.jawOpen", 0.2), Key(0, "brows", 2.0), Key(0, "head.yaw", 5.0)])
    new = [
        *(
            Key(0, "shape.jawOpen", 0.5, "linear"),
            Key(1.5, "shape.jawOpen", -0.2),
            Key(0.5, "shape.mouthSmileLeft", 0.8),
        ),
        *(Key(0, "brows", -3.0, "linear"), Key(2, "brows", 4.0), Key(0.4, "lids", 0.0), Key(1.2, "lids", 0.7)),
    ]
    made = bare.control(direction=old, blinks=40, acting="prosody", controls_seed=3)
    page = show([made], width=700, height=700)
    frame = "(async (frame) => { await facediff.seek(frame); return [...facediff.positions(0)]; })"

    def furthest(expected: Animation, numbers: tuple[int, ...]) -> float:
        """Millimetres between the page's vertices and an animation's, at most."""
        return max(
            float(
                np.linalg.norm(
                    np.reshape(page.evaluate(f"{frame}({number})"), (-1, 3)) - 1000 * expected.vertices[number], axis=1
                ).max()
            )
            for number in numbers
        )

    numbers = (0, 17, 29, 44, 59)
    assert furthest(made, numbers) < 0.05
    page.evaluate(f"facediff.openKeys({json.dumps(json.dumps({'keys': Direction(new).rows()}))})")
    changed = bare.control(direction=Direction(new), blinks=40, acting="prosody", controls_seed=3)
    assert np.linalg.norm(changed.vertices - made.vertices, axis=2).max() > 0.003
    assert furthest(changed, numbers) < 0.1
    # What rules did becomes keys: the same motion, without the options that made it, and one step of the history.
    page.evaluate("document.getElementById('turn-into-keys').click()")
    command = "document.getElementById('command').textContent"
    assert not {"--blinks", "--acting", "--controls-seed"} & set(page.evaluate(command).split())
    turned = keys_in(page)
    assert {"brows", "lids", "head.pitch", "head.yaw", "head.roll"} <= set(turned.channels)
    edited = bare.control(direction=turned)
    assert furthest(edited, numbers) < 0.1
    # Keys are thinned out by amounts, which are more millimetres on the built-in head than on the mask of before.
    assert np.linalg.norm(edited.vertices - changed.vertices, axis=2).max() < 0.00035
    assert len(turned.channels["lids"]) < frames / 2
    assert turned.instead_of == ("acting", "blinks")
    press(page, "z", 2)
    assert keys_in(page).rows() == Direction(new).rows()
    assert "--acting prosody" in page.evaluate(command)
    # A file says what its keys stand for: nothing is done twice when it is opened, nor left out by another file.
    page.evaluate(f"facediff.openKeys({json.dumps(turned.text())})")
    assert keys_in(page) == replace(turned, source="page")
    assert furthest(edited, numbers) < 0.1
    assert "--acting" not in page.evaluate(command)
    assert page.evaluate("document.getElementById('turn-into-keys').disabled")
    page.evaluate(f"facediff.openKeys({json.dumps(replace(Direction(new), instead_of=('blinks',)).text())})")
    assert "--acting prosody --controls-seed 3 --direction" in page.evaluate(command)
    assert furthest(bare.control(direction=Direction(new), acting="prosody", controls_seed=3), numbers) < 0.1
    page.evaluate(f"facediff.openKeys({json.dumps(Direction(new).text())})")
    assert furthest(changed, numbers) < 0.1
    assert "--blinks 40 --acting prosody" in page.evaluate(command)
    # A mood is the keys that the command takes by its name.
    page.evaluate("facediff.openKeys('[]')")
    page.evaluate("(mood.value = 'sad', mood.dispatchEvent(new Event('change')))")
    assert keys_in(page).rows() == read_direction("sad").rows()
    sad = bare.control(direction="sad", blinks=40, acting="prosody", controls_seed=3)
    assert furthest(sad, numbers[:2]) < 0.1


def test_a_take_is_downloaded_as_an_archive_that_the_command_line_reads(show: Show, tmp_path: Path) -> None:
    head = np.linspace(0, 0.1, 6 * FRAMES).reshape(FRAMES, 6)
    animation = replace(directed(name="wäre/es: so?"), unit="cm", head=head)
    page = show([clicks(), animation])
    keys = "document.getElementById('take-keys').disabled"
    assert page.evaluate(f"(downloads.click(), {keys})")  # the first take has none
    page.evaluate("(taken.value = '1', taken.dispatchEvent(new Event('change')))")
    assert not page.evaluate(keys)
    click = "document.getElementById('take-motion').click()"
    path = downloaded(page, tmp_path / "taken", lambda: page.evaluate(click))
    assert path.name == "wäre_es_ so_.npz"
    found = read_archive(path)
    assert (found.name, found.frame_rate, found.unit, found.sample_rate) == (animation.name, RATE, "mm", SAMPLE_RATE)
    off = np.linalg.norm(found.vertices - 10 * animation.vertices, axis=2)
    assert off.max() <= 0.05 * 3**0.5 / 2 + 1e-3
    assert np.allclose(found.template, 10 * animation.template)
    assert np.array_equal(found.triangles, animation.triangles)
    assert found.head is not None
    assert np.allclose(found.head, head * [1, 1, 1, 10, 10, 10])
    for name in ("colours", "inner_lip_pairs"):
        assert np.array_equal(getattr(found, name), getattr(animation, name))
    assert {name: each.tolist() for name, each in found.regions.items()} == {
        name: each.tolist() for name, each in animation.regions.items()
    }
    assert found.speech is not None
    assert animation.speech is not None
    assert np.abs(found.speech - animation.speech).max() < 1e-4
    assert {**animation.metadata, **found.metadata} == found.metadata
    assert read_direction(path).rows() == KEYS.rows()
    click = "(document.getElementById('take-glb').click(), 0)"
    reader = Reader(downloaded(page, tmp_path / "scene", lambda: page.evaluate(click)))
    assert len(reader.primitive.targets) == 1  # one lip, one way
    assert reader.weights.min() >= 0
    assert reader.weights.max() <= 1
    for frame in (0, 1, 7, 74):
        off = np.linalg.norm(reader.at(frame / RATE) * 1000 - found.vertices[frame], axis=1)
        assert off.max() <= 0.05 + 1e-4
    corners = reader.values(reader.primitive.indices).reshape(-1, 3)
    assert np.array_equal(corners, animation.triangles)
    linear = linear_colours(animation.colours)
    assert np.allclose(reader.values(reader.primitive.attributes.COLOR_0), linear, atol=1e-5)
