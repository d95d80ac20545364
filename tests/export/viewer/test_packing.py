"""What is written into a page, read back by a decoder of its own, and what is refused."""

from __future__ import annotations

import base64
import html.parser
import io
import json
import wave
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.animation import Animation
from facediff.editing.controls.direction import METADATA, Direction, Key, channel_of
from facediff.editing.controls.expressiveness import region_factors
from facediff.export.viewer import write_page
from facediff.render.panels import heat_ramp
from tests.fakes.clicks import FRAMES, OPEN_FRAMES, OPENING, RATE, SAMPLE_RATE, clicks

HOSTILE = '</script><script>window.hacked = 1</script><img src=x onerror="window.hacked = 1">{{facts}}&amp;\u2028'


class Reader(html.parser.HTMLParser):
    """Every element, by the rules of HTML: what a browser treats as a script is one here."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self._open: dict[str, str | None] | None = None
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "script":
            self._open = dict(attrs)
            self.scripts.append((self._open, ""))

    def handle_endtag(self, tag: str) -> None:
        if tag == "script":
            self._open = None

    def handle_data(self, data: str) -> None:
        if self._open is not None:
            self.scripts[-1] = (self._open, self.scripts[-1][1] + data)


class Written:
    """A page, taken apart."""

    def __init__(self, path: Path) -> None:
        self.text = path.read_text(encoding="utf-8")
        self.reader = Reader(self.text)
        named = {str(attributes.get("id")): text for attributes, text in self.reader.scripts}
        self.facts = json.loads(named["facts"])
        self.named = named

    def blob(self, number: int) -> bytes:
        return zlib.decompress(base64.b64decode(self.named[f"blob-{number}"], validate=True))

    def motion(self, number: int) -> np.ndarray:
        """Positions (T, V, 3) in mm, as the page's script has to make them."""
        facts, animation = self.facts, self.facts["animations"][number]
        template = np.frombuffer(self.blob(animation["template"]), "<f4").reshape(-1, 3).astype(np.float64)
        chunks = []
        for place, blob in enumerate(animation["chunks"]):
            frames = min(facts["chunkFrames"], facts["frames"] - place * facts["chunkFrames"])
            low, high = (
                np.frombuffer(self.blob(blob), np.uint8).reshape(2, 3, animation["vertices"], frames).astype(int)
            )
            folded = low + 256 * high
            differences = np.where(folded % 2, -(folded + 1) // 2, folded // 2)
            steps = np.cumsum(differences, axis=-1)
            chunks.append(((steps + 2**15) % 2**16 - 2**15).transpose(2, 1, 0))
        return template + facts["step"] * np.concatenate(chunks)


def random_animation(
    seed: int, *, frames: int = 70, vertices: int = 9, unit: str = "m", size: float = 0.002
) -> Animation:
    rng = np.random.default_rng(seed)
    template = rng.normal(0, 0.1, (vertices, 3)).astype(np.float32)
    return Animation(
        name=f"random {seed}",
        vertices=(template + rng.normal(0, size, (frames, vertices, 3))).astype(np.float32),
        template=template,
        frame_rate=30,
        faces=np.arange(vertices, dtype=np.int32).reshape(-1, 3),
        unit=unit,
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["m", "cm", "0.5"]), st.sampled_from([1, 31, 32, 33, 70]))
def test_page_positions_come_back_within_the_stated_bound(
    tmp_path_factory: pytest.TempPathFactory, seed: int, unit: str, frames: int
) -> None:
    scale = {"m": 1000, "cm": 10, "0.5": 500}[unit]
    animation = random_animation(seed, frames=frames, unit=unit, size=0.3)  # jumps of up to a metre between two frames
    path = tmp_path_factory.mktemp("page") / "a.html"
    write_page(path, [animation])
    off = np.linalg.norm(Written(path).motion(0) - animation.vertices.astype(np.float64) * scale, axis=2)
    # Half a step on each of three axes, and the template's own rounding to 32 bits.
    assert off.max() <= 0.05 * 3**0.5 / 2 + 1e-4 < 0.05


def test_page_turns_a_mesh_that_is_wound_inside_out(tmp_path: Path) -> None:
    """The picture's script treats what is wound clockwise for the dark hollow of the mouth."""
    animation = clicks()
    write_page(tmp_path / "a.html", [animation, replace(animation, faces=animation.triangles[:, ::-1])])
    page = Written(tmp_path / "a.html")
    for facts in page.facts["animations"]:
        assert np.array_equal(np.frombuffer(page.blob(facts["faces"]), "<u4").reshape(-1, 3), animation.triangles)


def test_page_keeps_each_mesh_and_equal_parts_once(tmp_path: Path) -> None:
    first, second = random_animation(0), random_animation(1, vertices=12)
    write_page(tmp_path / "a.html", [first, second, replace(first, name="again")])
    page = Written(tmp_path / "a.html")
    assert [animation["name"] for animation in page.facts["animations"]] == ["random 0", "random 1", "again"]
    for number, animation in enumerate([first, second, first]):
        facts = page.facts["animations"][number]
        assert np.allclose(page.motion(number), animation.vertices * 1000.0, atol=0.05)
        faces = np.frombuffer(page.blob(facts["faces"]), "<u4").reshape(-1, 3)
        assert any(np.array_equal(faces, wound) for wound in (animation.triangles, animation.triangles[:, ::-1]))
        low, high = animation.template.min(0) * 1000, animation.template.max(0) * 1000
        assert np.allclose(facts["centre"], (low + high) / 2, atol=1e-2)
        assert np.allclose(facts["extent"], (high - low) / 2, atol=1e-2)
    assert page.facts["animations"][0]["chunks"] == page.facts["animations"][2]["chunks"]
    assert page.facts["sound"] is None
    assert page.facts["heat"] is None


def test_page_keeps_speech_of_a_finer_rate_at_16_khz(tmp_path: Path) -> None:
    tone = 0.5 * np.sin(2 * np.pi * 440 * np.arange(48_000) / 48_000).astype(np.float32)
    write_page(tmp_path / "a.html", [replace(random_animation(0, frames=30), speech=tone, sample_rate=48_000)])
    page = Written(tmp_path / "a.html")
    with wave.open(io.BytesIO(page.blob(page.facts["sound"]))) as file:
        assert (file.getframerate(), file.getnframes()) == (16_000, 16_000)  # a second
        sound = np.frombuffer(file.readframes(8000), "<i2") / 32768
    np.testing.assert_allclose(sound[200:], tone[: 3 * 8000 : 3][200:], atol=1e-3)


def test_page_sound_and_curve_show_the_clicks_at_their_frames(tmp_path: Path) -> None:
    write_page(tmp_path / "a.html", [clicks(speech=False), clicks()])
    page = Written(tmp_path / "a.html")
    with wave.open(io.BytesIO(page.blob(page.facts["sound"]))) as file:
        assert (file.getnchannels(), file.getsampwidth(), file.getframerate()) == (1, 2, SAMPLE_RATE)
        sound = np.frombuffer(file.readframes(file.getnframes()), "<i2")
    assert len(sound) * RATE == FRAMES * SAMPLE_RATE
    loud = np.flatnonzero(sound)
    starts = loud[np.diff(loud, prepend=-1000) > 1]
    assert (starts * RATE / SAMPLE_RATE).tolist() == list(OPEN_FRAMES)
    curve = np.frombuffer(page.blob(page.facts["animations"][0]["opening"]), "<f4")
    assert np.flatnonzero(curve).tolist() == list(OPEN_FRAMES)
    assert curve.max() == pytest.approx(OPENING)


def test_page_heat_map_has_the_renderers_colours_where_topologies_agree(tmp_path: Path) -> None:
    truth, other = random_animation(0), random_animation(1, vertices=12)
    near = replace(truth, vertices=truth.vertices + np.float32([0.003, 0, 0]), name="3 mm off")
    write_page(tmp_path / "a.html", [truth, near, other], truth=0)
    page = Written(tmp_path / "a.html")
    assert page.facts["truth"] == 0
    assert [animation["compared"] for animation in page.facts["animations"]] == [False, True, False]
    assert np.array_equal(np.frombuffer(page.blob(page.facts["heat"]["ramp"]), np.uint8).reshape(-1, 3), heat_ramp())
    assert page.facts["heat"]["highest"] in (3, 4)  # 3 mm but for float32
    write_page(tmp_path / "b.html", [truth, other], truth=0)
    assert Written(tmp_path / "b.html").facts["heat"] is None


def test_page_keeps_hostile_names_as_text_and_refers_to_nothing(tmp_path: Path) -> None:
    write_page(tmp_path / "a.html", [replace(clicks(name=HOSTILE), metadata={HOSTILE: HOSTILE})])
    page = Written(tmp_path / "a.html")
    assert page.facts["animations"][0]["name"] == HOSTILE
    assert page.facts["animations"][0]["metadata"] == {HOSTILE: HOSTILE}
    programs = [text for attributes, text in page.reader.scripts if "type" not in attributes]
    assert len(programs) == 1
    assert "hacked" not in programs[0]
    assert not [tag for tag, _ in page.reader.elements if tag in ("img", "iframe", "object", "embed", "base")]
    for _, attributes in page.reader.elements:
        assert str(attributes.get("href", "data:")).startswith("data:")
        assert "src" not in attributes
        assert not [name for name in attributes if name.startswith("on")]
    policies = [a["content"] for _, a in page.reader.elements if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1
    assert policies[0] is not None
    assert policies[0].startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policies[0]


def test_page_has_the_keys_of_its_animation_and_what_their_preview_needs(tmp_path: Path) -> None:
    keys = Direction([Key(0.5, "expressiveness.lips", 2.0), Key(1.0, "style", HOSTILE, "step")], instead_of=["blinks"])
    animation = replace(clicks(), regions={"lips": np.arange(4, 8)}, metadata={METADATA: keys.text()})
    odd = replace(clicks(name="odd"), metadata={METADATA: "no keys"})
    write_page(tmp_path / "a.html", [animation, odd])
    page = Written(tmp_path / "a.html")
    first, second = page.facts["animations"]
    assert first["direction"] == keys.rows()
    assert first["insteadOf"] == ["blinks"]
    assert second["direction"] is None  # and stays among the metadata
    assert second["metadata"] == odd.metadata
    weights = np.frombuffer(page.blob(first["weights"]["lips"]), np.uint8) / 255
    assert np.allclose(
        weights, region_factors(animation.template, animation.regions, {"lips": 1, "all": 0}), atol=0.002
    )
    assert np.frombuffer(page.blob(first["regions"]["lips"]), "<i4").tolist() == [4, 5, 6, 7]
    channels = page.facts["direction"]["channels"]
    for name, facts in channels.items():
        limits = channel_of(name).range
        assert facts["range"] == (None if limits is None else [limits.least, limits.most])
        assert limits is None or facts["rest"] in limits


def test_page_has_little_code_of_its_own(tmp_path: Path) -> None:
    """Many pages are mailed."""
    write_page(tmp_path / "a.html", [clicks(speech=False)])
    assert (tmp_path / "a.html").stat().st_size < 161_000
    page = Written(tmp_path / "a.html")
    (program,) = [text for attributes, text in page.reader.scripts if "type" not in attributes]
    assert len(program) < 121_000
    assert "\n//" not in program
    assert "\n " not in program


def test_page_is_the_same_every_time(tmp_path: Path) -> None:
    for name in "ab":
        write_page(tmp_path / f"{name}.html", [clicks()])
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_the_page_has_each_faces_own_colours(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    faces = [replace(clicks(name=name), colours=random.integers(0, 256, (12, 3)).astype(np.uint8)) for name in "ab"]
    write_page(tmp_path / "a.html", faces)
    page = Written(tmp_path / "a.html")
    for face, animation in zip(faces, page.facts["animations"], strict=True):
        assert page.blob(animation["colours"]) == face.colours.tobytes()  # type: ignore[union-attr]
