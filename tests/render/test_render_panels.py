"""Panels, labels and sheets."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from facediff.render import Renderer, contact_sheet, save_image, side_by_side
from facediff.render.panels import _text_mask, _wide_font

MakeSphere = Callable[..., tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]]

# An octahedron that rises.
VERTICES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
MOTION = VERTICES + np.linspace(0, 0.2, 3)[:, None, None] * [0, 1, 0]


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(FACES, template=VERTICES, size=(96, 80))


def test_side_by_side_shows_the_renderers_pictures_under_their_labels(renderer: Renderer) -> None:
    frames = list(side_by_side(renderer, [MOTION, MOTION[::-1]], ["truth", "facediff"], footer="synthetic corpus"))
    assert len(frames) == 3
    height, width, _ = frames[0].shape
    assert width == 160
    assert height > 96
    top = next(row for row in range(height) if (frames[0][row : row + 96, :80] == renderer.render(MOTION[0])).all())
    np.testing.assert_array_equal(frames[0][top : top + 96, 80:], renderer.render(MOTION[2]))
    strip, foot = frames[0][:top], frames[0][top + 96 :]
    assert strip[:, :80].min() < 100  # dark ink on a light ground
    assert strip[:, 80:].min() < 100
    assert foot.min() < 150
    # The labels differ, and stay the same while the faces move.
    assert (strip[:, :80] != strip[:, 80:]).any()
    np.testing.assert_allclose(strip.astype(int), frames[2][:top].astype(int), atol=1)


def test_side_by_side_mixes_topologies_and_colours(renderer: Renderer, sphere: MakeSphere) -> None:
    vertices, faces = sphere(8, 12)
    other = Renderer(faces, template=vertices, size=(96, 64))
    still = np.tile(vertices, (3, 1, 1))
    heat = np.random.default_rng(0).random(MOTION.shape)
    frames = list(side_by_side([renderer, other], [MOTION, still], ["a", "b"], colours=[heat, None]))
    assert frames[0].shape[1] == 80 + 64
    np.testing.assert_array_equal(frames[1][-96:, :80], renderer.render(MOTION[1], colours=heat[1]))


def test_contact_sheet_places_pictures_row_by_row() -> None:
    pictures = [np.full((10, 12, 3), 10 * index, np.uint8) for index in range(5)]
    sheet = contact_sheet(iter(pictures), 3)
    assert sheet.shape == (26, 48, 3)
    assert [int(sheet[5, 5 + 18 * column, 0]) for column in range(3)] == [0, 10, 20]
    assert [int(sheet[21, 5 + 18 * column, 0]) for column in range(3)] == [30, 40, 255]
    assert contact_sheet(pictures, 3, labels=list("abcde")).shape[0] > 26


def test_save_image_round_trip(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (9, 7, 3)).astype(np.uint8)
    save_image(tmp_path / "new" / "a.png", picture)
    with Image.open(tmp_path / "new" / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), picture)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a.png"]


def test_letters_with_accents_are_drawn_and_no_boxes(renderer: Renderer, monkeypatch: pytest.MonkeyPatch) -> None:
    def label(text: str) -> bytes:
        _text_mask.cache_clear()
        return next(iter(side_by_side(renderer, [MOTION[:1]], [text]))).tobytes()

    if _wide_font() is not None:
        assert len({label(text) for text in ("Zoe", "Zoë", "Zoü", "Zoж")}) == 4  # a box would make two of them alike
    assert label("Zoë\nZoë") == label("Zoë\x85 Zoë") == label("Zoë Zoë")  # file names may have line breaks
    monkeypatch.setattr("facediff.render.panels._wide_font", lambda: None)
    assert label("Zoë") == label("Zoe")
