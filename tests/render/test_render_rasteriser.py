"""What the pictures show."""

import pickle
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from facediff.render import EVEN, VIEWS, Camera, Light, Look, Renderer, portrait
from facediff.render.rasteriser import TABLE_SIZE, light_table
from facediff.utils.colours import to_linear

MakeSphere = Callable[..., tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]]

# Black behind everything and no hollows' tint: what is lit is the mesh.
PLAIN = Look(lights=EVEN, background_top=(0, 0, 0), background_bottom=(0, 0, 0), hollow=(0, 0, 0))


def _drawn(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    return np.asarray(picture.max(axis=2) > 8)


def test_picture_is_not_blank_and_follows_the_motion(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    renderer = Renderer(faces, template=vertices, size=96)
    rest, moved = renderer.render(vertices), renderer.render(vertices + [0.1, 0, 0])
    assert rest.shape == (96, 96, 3)
    assert rest.dtype == np.uint8
    assert rest.std() > 10
    assert (rest != moved).any()
    np.testing.assert_array_equal(renderer.render(vertices), rest)  # nothing is left over from the frame before


def test_motion_moves_the_picture_the_right_way(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    renderer = Renderer(faces, template=vertices, size=96, look=PLAIN)
    centre = [np.argwhere(_drawn(renderer.render(vertices * 0.5 + shift))).mean(axis=0) for shift in np.eye(3) * 0.4]
    assert centre[0][1] > 60  # +x is right
    assert centre[1][0] < 36  # +y is up, rows count down
    np.testing.assert_allclose(centre[2], 47.5, atol=0.5)  # +z comes nearer


def test_the_near_triangle_hides_the_far_one_in_any_order() -> None:
    triangle = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], dtype=float)
    vertices = np.concatenate([triangle, triangle * 0.6 + [0, 0, 0.5]])
    colours = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 3, axis=0)
    for faces in ([[0, 1, 2], [3, 4, 5]], [[3, 4, 5], [0, 1, 2]]):
        picture = Renderer(np.array(faces), template=vertices, size=64, look=PLAIN).render(vertices, colours=colours)
        rows, columns = np.nonzero(_drawn(picture))
        middle = picture[34, 32].astype(int)
        corner = picture[rows.max() - 2, columns.min() + 6].astype(int)
        assert middle[2] > middle[0] + 60
        assert corner[0] > corner[2] + 60


def test_the_inside_shows_through_a_hole_and_is_darker(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    hole = (vertices[faces].mean(axis=1)[:, :2] ** 2).sum(axis=1) < 0.1
    holed = faces[~(hole & (vertices[faces].mean(axis=1)[:, 2] > 0))]
    whole, open_ = (Renderer(mesh, template=vertices, size=64, look=PLAIN).render(vertices) for mesh in (faces, holed))
    assert 8 < open_[32, 32].max() < 0.6 * whole[32, 32].max()


@pytest.mark.parametrize("view", list(VIEWS))
@pytest.mark.parametrize("size", [96, (96, 72), (72, 96)])
def test_the_template_fills_the_picture_with_a_margin(
    view: str, size: int | tuple[int, int], sphere: MakeSphere
) -> None:
    vertices, faces = sphere()
    vertices = vertices * [70, 100, 90] + [0, 1500, 30]  # millimetres, far from the origin
    picture = Renderer(faces, template=vertices, size=size, view=view, look=PLAIN).render(vertices)
    rows, columns = np.nonzero(_drawn(picture))
    height, width, _ = picture.shape
    free = np.array([rows.min(), height - 1 - rows.max(), columns.min(), width - 1 - columns.max()])
    assert free.min() >= 2
    assert free.min() <= 0.09 * max(height, width)
    assert abs(int(free[0]) - int(free[1])) <= 2
    assert abs(int(free[2]) - int(free[3])) <= 2


def test_supersampling_softens_edges_and_keeps_the_area(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    shares, areas = [], []
    for supersample in (1, 2, 4):
        look = Look(lights=(), sky=(1, 1, 1), ground=(1, 1, 1), albedo=(1, 1, 1), background_top=(0, 0, 0),
                    background_bottom=(0, 0, 0))  # fmt: skip
        picture = Renderer(faces, template=vertices, size=80, supersample=supersample, look=look).render(vertices)
        light = to_linear(picture[..., 0] / 255)
        shares.append(float(((light > 0.02) & (light < 0.5)).mean()))
        areas.append(float(light.sum()))
    assert shares[0] < 1e-3
    assert shares[1] > 0.005
    np.testing.assert_allclose(areas, areas[-1], rtol=0.03)


def test_a_symmetric_mesh_under_even_light_gives_a_symmetric_picture(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    renderer = Renderer(faces, template=vertices, size=96, look=Look(lights=EVEN))
    picture = renderer.render(vertices).astype(int)
    assert np.abs(picture - picture[:, ::-1]).mean() < 0.5
    studio = Renderer(faces, template=vertices, size=96).render(vertices).astype(int)
    assert np.abs(studio - studio[:, ::-1]).mean() > 3  # the default's key light stands on the left


def test_colours_as_floats_and_as_bytes_agree(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    bytes_ = np.random.default_rng(0).integers(0, 256, vertices.shape).astype(np.uint8)
    renderer = Renderer(faces, template=vertices, size=48)
    picture = renderer.render(vertices, colours=bytes_)
    np.testing.assert_array_equal(picture, renderer.render(vertices, colours=bytes_ / 255))
    own = Renderer(faces, template=vertices, size=48, colours=bytes_)
    np.testing.assert_array_equal(picture, own.render(vertices))
    assert (picture != renderer.render(vertices)).any()


def test_the_light_table_against_lambert() -> None:
    look = Look(lights=(Light((0, 0, 1), (0.5, 0.5, 0.5), wrap=0.0),), sky=(0, 0, 0), ground=(0, 0, 0))
    table = light_table(look)
    axis = np.linspace(-1, 1, TABLE_SIZE)
    x, y = np.meshgrid(axis, axis)
    depth = 1 - x * x - y * y
    inside = depth > 0
    np.testing.assert_allclose(table[inside][:, 0], 0.5 * np.sqrt(depth[inside]), atol=1e-6)


def test_vertices_outside_or_behind_the_camera_give_background(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    renderer = Renderer(faces, template=vertices, size=48)
    empty = renderer.render(vertices + [100.0, 0, 0])
    np.testing.assert_array_equal(renderer.render(vertices + [0, 0, 1000.0]), empty)
    assert (renderer.render(vertices) != empty).any()


def test_a_body_that_reaches_behind_the_camera_does_not_cover_the_face(sphere: MakeSphere) -> None:
    vertices, faces = sphere()
    camera = Camera.framing(vertices)
    body = 3 * vertices + [0, -4, camera.distance]
    both = np.concatenate([vertices, body])
    joined = np.concatenate([faces, faces + len(vertices)])
    renderer = Renderer(joined, template=both, size=48, camera=camera, look=PLAIN)
    alone = Renderer(faces, template=vertices, size=48, camera=camera, look=PLAIN).render(vertices)
    top = slice(0, 20)
    assert np.mean(_drawn(renderer.render(both))[top] != _drawn(alone)[top]) < 0.01


def test_one_camera_for_two_topologies_keeps_their_sizes(sphere: MakeSphere) -> None:
    big, small = sphere(), sphere(12, 24)
    camera = Camera.framing([big[0], small[0] * 0.5])
    widths = []
    for (vertices, faces), scale in ((big, 1.0), (small, 0.5)):
        picture = Renderer(faces, template=vertices, camera=camera, size=128, look=PLAIN).render(vertices * scale)
        widths.append(np.ptp(np.nonzero(_drawn(picture))[1]))
    assert widths[1] / widths[0] == pytest.approx(0.5, abs=0.04)
    assert pickle.loads(pickle.dumps(camera)) == camera  # noqa: S301 - our own bytes


def test_a_portrait_leaves_out_shoulders_but_no_chin() -> None:
    heights = np.array([0.12, 0.05, 0.0, -0.04, -0.06, -0.095, -0.12, -0.3])  # crown to chest; lips at -0.04
    bust = np.stack([np.zeros_like(heights), heights, np.zeros_like(heights)], axis=1)
    kept = portrait(bust, {"lips": [3], "upper_face": [1, 2]})
    assert kept[:, 1].tolist() == heights[:6].tolist()
    assert portrait(bust, {"lips": [3]}) is bust
    assert portrait(bust, {"lips": [0], "upper_face": [3]}) is bust  # upside down: not a face that we know
