"""The page in a real browser: it loads without an error, plays, and its picture follows the sound's clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from facediff.animation import Animation
from facediff.export.viewer import write_page
from facediff.render.occlusion import occlusion
from tests.fakes.chromium import Chromium, Page
from tests.fakes.clicks import FRAMES, OPEN_FRAMES, RATE, SAMPLE_RATE, clicks

Show = Callable[..., Page]
HOSTILE = '</script><script>window.hacked = 1</script><img src=x onerror="window.hacked = 1">'

# Goes to a frame; gives the frame that is shown, the colour, and the sound's time.
SEEK = """(async (frame) => {
  await facediff.seek(frame);
  facediff.turn(0, 0);
  await new Promise(requestAnimationFrame);
  return [facediff.frame, pixel(), document.getElementById("sound").currentTime];
})"""
# A number for what each half of the canvas shows.
# How many points of a face are drawn behind the words, and how wide the first panel's face is, in pixels of the page.
# Notes at every picture the clock before and after the player's own work, the frame it shows, and the colour.
NOTES = """
window.notes = [];
window.natural = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (work) => natural((now) => {
  const sound = document.getElementById("sound"), before = sound.currentTime;
  facediff.turn(0, 0); // asks for a picture even if the frame stays
  work(now);
  notes.push([before, sound.currentTime, facediff.frame, pixel(), facediff.playing]);
});
"""


def is_open(colour: list[int]) -> bool:
    red, _, blue, alpha = colour
    assert alpha == 255, "the face is not drawn in the middle"
    return blue > red


def frame_after(page: Page, script: str) -> int:
    """The frame that is on the screen some pictures after a script has run."""
    found: int = page.evaluate(
        f"(async () => {{ await ({script}); for (let i = 0; i < 4; i++) await new Promise(requestAnimationFrame);"
        f" return facediff.frame; }})()"
    )
    return found


def test_while_it_plays_the_picture_follows_the_sound_by_less_than_half_a_frame(show: Show) -> None:
    page = show([clicks()])
    page.evaluate(NOTES)
    page.evaluate("facediff.play()")
    page.wait_for("document.getElementById('sound').ended")
    notes = [note for note in page.evaluate("notes") if note[4]]
    assert len({frame for _, _, frame, _, _ in notes}) > 10
    assert notes[-1][1] > 2
    for before, after, frame, colour, _ in notes:
        assert before * RATE - 0.5 <= frame + 1
        assert frame <= after * RATE + 0.5
        assert is_open(colour) == (frame in OPEN_FRAMES)
    # The sound has ended a moment before its event is handled.
    page.wait_for("document.getElementById('play').ariaLabel === 'Play'")
    assert page.evaluate("facediff.frame") == FRAMES - 1


def test_the_browser_hears_the_clicks_where_it_shows_the_mouth_open(show: Show) -> None:
    page = show([clicks()])
    loud = page.evaluate(
        f"""(async () => {{
          const text = atob(document.getElementById(`blob-${{facediff.facts.sound}}`).textContent);
          const bytes = Uint8Array.from(text, (letter) => letter.charCodeAt(0));
          const wav = new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate")));
          const context = new OfflineAudioContext(1, {SAMPLE_RATE}, {SAMPLE_RATE});
          const sound = (await context.decodeAudioData(await wav.arrayBuffer())).getChannelData(0);
          return [sound.length, [...sound.keys()].filter((i) => Math.abs(sound[i]) > 0.1)];
        }})()"""
    )
    assert loud[0] == FRAMES * SAMPLE_RATE // RATE
    heard = np.array(loud[1])
    starts = heard[np.diff(heard, prepend=-1000) > 100]
    assert starts.tolist() == [frame * SAMPLE_RATE // RATE for frame in OPEN_FRAMES]
    for frame in sorted({0, 1, 6, 7, 8, 30, 31, 33, 34, 50, 73, 74}):
        seen = page.evaluate(f"{SEEK}({frame})")
        assert seen[0] == frame
        assert is_open(seen[1]) == (frame in OPEN_FRAMES)
        assert seen[2] * RATE == pytest.approx(frame, abs=0.01)


def test_every_frame_is_unpacked_as_it_was_written(show: Show) -> None:
    rng = np.random.default_rng(0)
    template = rng.normal(0, 60, (30, 3)).astype(np.float32)
    vertices = (template + rng.normal(0, 300, (70, 30, 3)).clip(-1600, 1600)).astype(np.float32)
    animation = Animation("wild", vertices, template, 24, np.arange(30, dtype=np.int32).reshape(-1, 3), unit="mm")
    page = show([animation])
    for frame in (69, 0, 31, 32, 33, 63, 64):
        found = page.evaluate(f"(async () => {{ await facediff.seek({frame}); return [...facediff.positions(0)]; }})()")
        off = np.linalg.norm(np.reshape(found, (-1, 3)) - vertices[frame], axis=1)
        assert off.max() < 0.05


def test_keys_buttons_and_the_curve_move_through_time(show: Show) -> None:
    page = show([clicks()])
    page.evaluate("facediff.seek(30)")
    for key, frame in (("ArrowRight", 31), ("ArrowLeft", 30), ("ArrowLeft", 29), ("End", 74), ("Home", 0)):
        page.press(key)
        assert frame_after(page, "null") == frame
    assert frame_after(page, "document.getElementById('forward').click()") == 1
    scrub = "document.getElementById('scrub')"
    assert frame_after(page, f"{scrub}.value = 44, {scrub}.dispatchEvent(new Event('input'))") == 44
    box = page.evaluate("(({left, top, width, height}) => [left, top, width, height])(curve.getBoundingClientRect())")
    point = (box[0] + 46 + (box[2] - 60) * 20.5 / FRAMES, box[1] + box[3] / 2)  # between the axis and the margin
    page.drag(point, point)
    assert frame_after(page, "null") == 20
    page.press(" ")
    page.wait_for("facediff.playing && facediff.frame > 22")
    page.press(" ")
    assert not page.evaluate("facediff.playing")
    standing = frame_after(page, "null")
    assert standing == pytest.approx(page.evaluate("sound.currentTime") * RATE, abs=1)
    assert page.evaluate("document.getElementById('frame').textContent") == f"frame {standing} / {FRAMES - 1}"


@pytest.mark.slow
def test_it_loops_at_another_speed_and_without_sound(show: Show) -> None:
    page = show([clicks(speech=False)])
    assert page.evaluate("document.getElementById('mute').hidden")
    page.evaluate("document.getElementById('loop').click()")
    page.evaluate("speed.value = '2', speed.dispatchEvent(new Event('change'))")
    page.evaluate("facediff.seek(60)")
    began = page.evaluate("facediff.play(), window.began = performance.now()")
    assert began > 0
    page.wait_for("facediff.frame < 40")  # over the end
    clock, since = page.evaluate("[facediff.clock, (performance.now() - began) / 1000]")
    assert clock == pytest.approx((60 / RATE + 2 * since) % (FRAMES / RATE), abs=0.05)
    assert page.evaluate("facediff.playing")
    went_on = page.evaluate("(document.getElementById('loop').click(), facediff.clock)")
    assert went_on < 0.9 * FRAMES / RATE  # this round is played to its end
    page.wait_for("!facediff.playing")
    assert frame_after(page, "null") == FRAMES - 1


@pytest.mark.slow
def test_the_heat_map_is_the_distance_from_the_truth(show: Show) -> None:
    truth, other = clicks(name="truth"), clicks(name="guess", lower=4)
    page = show([truth, other], truth=0)
    plain = page.evaluate("[key.hidden, heat.hidden]")
    assert plain == [True, False]
    page.press("h")
    found = page.evaluate("(async () => { await facediff.seek(10); return [...facediff.distances(1)]; })()")
    assert np.allclose(found, [0] * 8 + [4] * 4, atol=0.09)
    assert page.evaluate("[key.hidden, highest.value]") == [False, "4"]
    assert page.evaluate("document.querySelectorAll('.error')[1].textContent") == "mean 1.33 mm\nlargest 4.00 mm"
    page.press("h")
    assert page.evaluate("key.hidden")
    alone = show([truth, replace(other, faces=other.triangles[::-1])], truth=0)
    assert alone.evaluate("heat.hidden")


def test_the_page_has_the_same_occlusion_as_pictures(show: Show) -> None:
    ring, ball = trimesh.creation.torus(0.05, 0.02, 24, 12), trimesh.creation.icosphere(1, 0.01)
    shape = trimesh.util.concatenate([ring, ball.apply_translation([0.05, 0.0, 0.0])])  # the ball lies in the ring
    template, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.int32)
    still = Animation(name="ring", vertices=template[None], template=template, faces=faces, frame_rate=25.0, unit="m")
    sky = show([still]).evaluate("[...facediff.sky(0)]")
    assert np.allclose(sky, occlusion(template, faces), atol=0.02)
    assert min(sky) < 0.8
    assert np.allclose(sky[-42:], 0.67)


def test_names_from_files_cannot_become_scripts_and_no_other_code_runs(show: Show) -> None:
    page = show([replace(clicks(name=HOSTILE), metadata={"identity": HOSTILE, HOSTILE: HOSTILE})])
    assert page.evaluate("document.querySelector('.name b').textContent") == HOSTILE
    assert page.evaluate("document.title").startswith(HOSTILE)
    assert page.evaluate("document.getElementById('about').textContent").count(HOSTILE) == 4
    assert page.evaluate("document.images.length") == 0
    script = "document.head.append(Object.assign(document.createElement('script'), {textContent: 'window.hacked = 1'}))"
    page.evaluate(f"({script}, new Promise((done) => setTimeout(done, 50)))")
    assert page.evaluate("window.hacked") is None
    assert len(page.problems) == 1
    assert "Content Security Policy" in page.problems.pop()
    assert page.evaluate("facediff.errors.splice(0).length") == 1


def test_one_frame_without_sound_lips_or_colours_outlives_a_lost_graphics_card(show: Show) -> None:
    animation = clicks(speech=False)
    bare = replace(animation, vertices=animation.vertices[:1], inner_lip_pairs=None, colours=None, frame_rate=23.976)
    page = show([bare])
    assert page.evaluate("document.getElementById('opening').hidden")
    page.evaluate("window.card = view.getContext('webgl2').getExtension('WEBGL_lose_context'), card.loseContext()")
    page.wait_for("view.getContext('webgl2').isContextLost()")
    page.evaluate("card.restoreContext()")
    page.wait_for("!view.getContext('webgl2').isContextLost()")
    assert frame_after(page, "facediff.play()") == 0
    colour = page.evaluate("(facediff.turn(0, 0), new Promise(requestAnimationFrame).then(pixel))")
    assert colour[3] == 255
    assert colour[0] > colour[2] > 50  # skin again


def test_without_webgl_it_says_so(program: Path, tmp_path: Path) -> None:
    write_page(tmp_path / "a.html", [clicks()])
    with Chromium(program, ["--disable-3d-apis"]) as browser:
        page = browser.open((tmp_path / "a.html").as_uri())
        page.wait_for("window.facediff && facediff.errors.length")
        assert "no WebGL 2" in page.evaluate("message.textContent")
        assert not page.evaluate("message.hidden")
