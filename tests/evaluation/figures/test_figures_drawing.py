"""The files of figures: sizes, fonts, texts, equal bytes, and colours that stand for the numbers."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from facediff.errors import FaceDiffError
from facediff.evaluation.figures import (
    Curves,
    FigureData,
    Moment,
    Paper,
    SpeechTrack,
    TimedPhoneme,
    draw_frames,
    draw_heatmap,
    draw_lips,
)
from facediff.evaluation.figures import lips as lips_module
from facediff.evaluation.figures.material import FLAT, Painter
from facediff.evaluation.figures.page import SMALLEST_TEXT, Grid, Heading
from facediff.render.panels import heat_ramp

SMALL = Paper(width=85, dpi=100)
TIMES = (np.arange(50) + 0.5) / 25
LIPS = Curves(TIMES, {"truth": np.sin(TIMES) ** 2, "ours": np.cos(TIMES) ** 2, "_th$irs": np.abs(np.sin(3 * TIMES))})
SPEECH = np.sin(np.arange(32_000) / 20).astype("f4")
PHONEMES = [
    TimedPhoneme(0, 0.2, ""),
    TimedPhoneme(0.2, 0.5, "m", "PP"),
    TimedPhoneme(0.5, 1.0, "ˈɑː", "AA"),
    TimedPhoneme(1, 1.1, "ʃ"),
]


def draw(name: str, material: FigureData, path: Path) -> None:
    if name == "frames":
        draw_frames(material, "A_e06", [Moment(0.1, PHONEMES[1]), Moment(0.5)], path, paper=SMALL)
    elif name == "heatmap":
        draw_heatmap(material, ["A_e06"], path, paper=SMALL)
    else:
        sound = SpeechTrack(SPEECH, phonemes=PHONEMES)
        draw_lips(LIPS, sound, path, paper=SMALL, scale=(1000, "mm"), remark="tiny: synthetic corpus")


TEXTS = {
    "frames": ["truth", "ours", "theirs", "/m/", "0.10 s", "0.50 s", "tiny: synthetic corpus"],
    "heatmap": ["truth", "ours", "theirs", "mean of motion [mm]", "std of motion [mm]", "tiny: synthetic corpus"],
    "lips": ["truth", "ours", "_th$irs", "lip opening [mm]", "time [s]", "m", "ɑː", "ʃ", "/p/, /b/, /m/", "sound"],
}


@pytest.mark.parametrize(
    "name", [name if name == "lips" else pytest.param(name, marks=pytest.mark.slow) for name in TEXTS]
)
def test_every_figure_in_every_format(name: str, own_material: FigureData, tmp_path: Path) -> None:
    material = replace(own_material, remark="tiny: synthetic corpus")
    files = [tmp_path / "new" / f"figure.{suffix}" for suffix in ("png", "pdf", "svg")]
    for path in files:
        draw(name, material, path)
        first = path.read_bytes()
        draw(name, material, path)
        assert path.read_bytes() == first, f"{path.suffix} differs from one time to the next"
        assert not re.search(rb"CreationDate|dc:date|<dc:creator|Software", first)
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["figure.pdf", "figure.png", "figure.svg"]
    with Image.open(files[0]) as picture:
        assert picture.size[0] == round(85 / 25.4 * 100)
        assert picture.info["dpi"] == pytest.approx((100, 100), abs=0.1)
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
        height = picture.size[1]
    check_pdf(files[1].read_bytes(), height)
    check_svg(files[2], TEXTS[name])


def check_pdf(content: bytes, height: int) -> None:
    assert content.startswith(b"%PDF-1.")
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL)
    plain = content + b"".join(map(inflated, streams))
    assert b"/FontFile2" in plain  # TrueType, embedded
    assert b"/Type3" not in plain
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", plain)
    assert box is not None
    assert float(box[1]) == pytest.approx(85 / 25.4 * 72, abs=0.5)
    assert float(box[2]) == pytest.approx(height / 100 * 72, abs=0.5)


def inflated(stream: bytes) -> bytes:
    try:
        return zlib.decompress(stream)
    except zlib.error:
        return b""


def check_svg(path: Path, texts: list[str]) -> None:
    root = ElementTree.parse(path).getroot()  # noqa: S314 - our own file
    found = {}
    for element in root.iter("{http://www.w3.org/2000/svg}text"):
        size = re.search(r"([\d.]+)px", element.get("style", ""))
        assert size is not None
        found["".join(element.itertext()).strip()] = float(size[1])
    words = {word for text in found for word in text.split()}  # long labels are broken into lines
    assert {word for text in texts for word in text.split()} <= words, found
    assert min(found.values()) >= SMALLEST_TEXT


def test_the_users_own_settings_neither_matter_nor_change(own_material: FigureData, tmp_path: Path) -> None:
    import matplotlib

    draw("lips", own_material, tmp_path / "one.svg")
    with matplotlib.rc_context({"font.size": 30, "lines.linewidth": 9, "axes.facecolor": "red"}):
        draw("lips", own_material, tmp_path / "two.svg")
        assert matplotlib.rcParams["font.size"] == 30
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "two.svg").read_bytes()


def test_colours_of_the_heat_map_are_those_of_the_bar(own_material: FigureData, tmp_path: Path) -> None:
    """A surface that faces the viewer shows the ramp's colour itself, so that it can be read off the bar."""
    faces, shape = own_material.mesh(["A_e06"])
    painter = Painter(faces, shape, look=FLAT)
    painter.set_size(round(200 * painter.aspect), 200)
    for level in (0, 128, 255):
        picture = painter.paint(shape, np.tile(heat_ramp()[level], (len(shape), 1)))
        drawn = picture[(picture != 255).any(-1)].astype(int)
        np.testing.assert_allclose(np.median(drawn, axis=0), heat_ramp()[level], atol=4)
    draw_heatmap(own_material, ["A_e06"], tmp_path / "heat.png", paper=SMALL)
    with Image.open(tmp_path / "heat.png") as picture:
        pixels = {tuple(int(c) for c in pixel) for pixel in np.asarray(picture.convert("RGB")).reshape(-1, 3)}
    assert sum(tuple(map(int, colour)) in pixels for colour in heat_ramp()) > 60  # the bar


def test_a_known_motion_has_the_colours_of_its_numbers(
    own_material: FigureData, damaged: Callable[..., FigureData], tmp_path: Path
) -> None:
    """Vertices that all stay 2 mm off the template: at four fifths of a scale to 2.5 mm, without deviation."""
    still = np.repeat(own_material.template("A_e06")[None], 24, axis=0) + (0.002, 0, 0)
    material = damaged(still)
    truth = replace(material.truths["A_e06"], path=material.methods["ours"]["A_e06"])
    material = replace(material, truths={"A_e06": truth})
    draw_heatmap(material, ["A_e06"], tmp_path / "heat.png", paper=SMALL, highest=(2.5, 1.0))
    with Image.open(tmp_path / "heat.png") as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    faces = pixels[:, : round(0.75 * pixels.shape[1])]
    for part, level in ((faces[: len(faces) // 2], 204), (faces[len(faces) // 2 :], 0)):
        coloured = part[np.ptp(part, axis=-1) > 8]  # neither white nor letters
        np.testing.assert_allclose(np.median(coloured, axis=0), heat_ramp()[level], atol=4)
    bars = pixels[: len(pixels) // 2, round(0.8 * pixels.shape[1]) :]
    apart = bars[..., 0] - bars[..., 2]  # the ramp runs from blue to yellow
    top, bottom = (np.nonzero(end.any(1))[0].mean() for end in (apart > 100, apart < -50))
    assert top < bottom


def test_pictures_are_white_around_and_as_large_as_asked(own_material: FigureData) -> None:
    faces, shape = own_material.mesh(["A_e06"])
    for region in (None, range(6)):
        painter = Painter(faces, shape, region=region)
        painter.set_size(round(120 * painter.aspect), 120)
        picture = painter.paint(shape)
        assert picture.shape == (120, round(120 * painter.aspect), 3)
        drawn = (picture != 255).any(-1)
        rows = np.nonzero(drawn.any(1))[0]
        if region is None:
            assert not drawn[0].any()
            assert np.ptp(rows) > 0.85 * 120  # the face fills the picture


def test_the_grid_leaves_room_for_its_labels() -> None:
    long = "a method of a long name (ours, 2026)"
    grid = Grid(Paper(85, 100), ["truth", long], [Heading("/m/", "0.1 s")] * 4, aspect=0.7, highest=50)
    assert grid.left >= 2 * 3.5  # its name takes two lines
    assert grid.end <= 85 + 1e-6
    assert grid.place(1, 3) == pytest.approx((grid.left + 3 * (grid.width + 1), grid.header + grid.height + 1))
    wide = Grid(Paper(175, 100), ["truth"], [Heading("one")], aspect=0.7, highest=50)
    assert wide.height == 50
    assert wide.left - (175 - wide.end) == pytest.approx(4.5, abs=0.1)  # in the middle, but for the name


def test_fonts(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match=r'--font: there is no font "DejaVu Sanss": did you mean "DejaVu Sans'):
        draw_lips(LIPS, SpeechTrack(), tmp_path / "a.png", paper=Paper(font="DejaVu Sanss"))
    assert list(tmp_path.iterdir()) == []


def test_lips_are_drawn_at_their_times_and_in_their_unit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    saved: list[Figure] = []
    monkeypatch.setattr(lips_module, "save", lambda figure, path: saved.append(figure))
    click = np.zeros(32_000, "f4")
    click[16_000] = 1
    sound = SpeechTrack(click, phonemes=PHONEMES)
    draw_lips(LIPS, sound, tmp_path / "a.png", paper=SMALL, scale=(1000, "mm"), span=(0.1, 1.6))
    opening, _, wave = saved[0].axes
    assert opening.get_xlim() == wave.get_xlim() == (0.1, 1.6)
    for line, values in zip(opening.lines, LIPS.openings.values(), strict=True):
        np.testing.assert_allclose(line.get_xydata(), np.stack([TIMES, 1000 * values], 1))
    (grey,) = opening.patches  # the only phoneme for which lips close
    assert (grey.get_x(), grey.get_x() + grey.get_width()) == pytest.approx((0.2, 0.5))
    outline = wave.collections[0].get_paths()[0].vertices
    assert outline[outline[:, 1].argmax(), 0] == pytest.approx(1.0, abs=0.01)
