"""Motion grows or shrinks region by region, exactly in a region, smoothly between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from facediff.animation import Animation
from facediff.editing.controls.expressiveness import FALL_OFF, region_factors, with_jaw
from facediff.editing.controls.eyelids import Eyes
from tests.fakes.single_controls import scale_regions


def test_one_factor_scales_every_offset(make_animation: Callable[..., Animation]) -> None:
    animation = make_animation(5, jawOpen=np.linspace(0, 1, 5), browOuterUp=0.5)
    scaled = scale_regions(animation, {"all": 1.7})
    np.testing.assert_allclose(
        scaled.vertices - animation.template, 1.7 * (animation.vertices - animation.template), atol=1e-7
    )
    assert scaled.metadata == {"identity": "F1", "edited": "expressiveness (all 1.7)"}
    assert animation.metadata == {"identity": "F1"}
    same = scale_regions(animation, {"all": 1.0, "lips": 1.0})
    np.testing.assert_allclose(same.vertices, animation.vertices, atol=1e-7)


def test_a_region_gets_its_own_factor_and_what_is_far_the_rest(make_animation: Callable[..., Animation]) -> None:
    animation = make_animation(2, jawOpen=0.7, browInnerUp=1.0, eyeBlink=0.2)
    factors = {"upper_face": 1.5, "lips": 0.5, "all": 1.1}
    scaled = scale_regions(animation, factors)
    before, after = (t.vertices[1] - t.template for t in (animation, scaled))
    np.testing.assert_allclose(after[animation.regions["lips"]], 0.5 * before[animation.regions["lips"]], atol=1e-7)
    np.testing.assert_allclose(
        after[animation.regions["upper_face"]], 1.5 * before[animation.regions["upper_face"]], atol=1e-7
    )
    size = np.linalg.norm(np.ptp(animation.template, axis=0))
    jaw = with_jaw(animation.template.astype(np.float64), animation.regions)
    np.testing.assert_allclose(after[jaw], 0.5 * before[jaw], atol=1e-7)
    both = np.concatenate([jaw, animation.regions["upper_face"]])
    far = np.linalg.norm(animation.template[:, None] - animation.template[both], axis=-1).min(1) > FALL_OFF * size
    assert far.sum() > 200
    np.testing.assert_allclose(after[far], 1.1 * before[far], atol=1e-7)


def test_lips_take_the_jaw_along(make_animation: Callable[..., Animation]) -> None:
    """An avatar that is driven by shapes opens its jaw as far as the lips ask for."""
    animation = make_animation(2, jawOpen=0.4)
    opened = make_animation(2, jawOpen=0.6)
    scaled = scale_regions(animation, {"lips": 1.5})
    below = with_jaw(animation.template.astype(np.float64), animation.regions)
    assert len(below) > 2 * len(animation.regions["lips"])
    np.testing.assert_allclose(scaled.vertices[1][below], opened.vertices[1][below], atol=1e-6)


@pytest.mark.parametrize("factors", [{"lips": 4.0}, {"upper_face": 3.0, "lips": 0.0}, {"upper_face": 2.0, "all": 0.5}])
def test_neighbours_differ_by_no_more_than_the_bound(
    factors: dict[str, float], make_animation: Callable[..., Animation]
) -> None:
    """1.5 |f − g| |x − y| / width between two vertices, wherever one region meets the rest."""
    animation = make_animation(1)
    width = FALL_OFF * float(np.linalg.norm(np.ptp(animation.template.astype(float), axis=0)))
    factor = region_factors(animation.template, animation.regions, factors)
    edges = np.concatenate(
        [animation.triangles[:, [0, 1]], animation.triangles[:, [1, 2]], animation.triangles[:, [2, 0]]]
    )
    length = np.linalg.norm(animation.template[edges[:, 0]] - animation.template[edges[:, 1]], axis=-1)
    values = [*factors.values(), 1.0]
    bound = 1.5 * (max(values) - min(values)) * length / width
    jump = np.abs(factor[edges[:, 0]] - factor[edges[:, 1]])
    assert (jump <= bound + 1e-6).all()
    assert jump.max() > 0.1
    assert factor.min() >= min(values) - 1e-9
    assert factor.max() <= max(values) + 1e-9


def test_neighbouring_regions_blend_without_a_step() -> None:
    """Two regions that share a border on a fine line: no step, a mean at the border, own values far from it."""
    line = np.stack([np.linspace(0, 10, 2001), np.zeros(2001), np.zeros(2001)], axis=1)
    halves = {"left": np.arange(1001), "right": np.arange(1001, 2001)}
    factor = region_factors(line, halves, {"left": 2.0, "right": 0.5}, fall_off=1.0)
    assert np.abs(np.diff(factor)).max() < 0.01
    assert factor[1000] == pytest.approx(1.25, abs=0.01)
    np.testing.assert_allclose(factor[[0, 700, 1300, 2000]], [2.0, 2.0, 0.5, 0.5])
    overlapping = {"one": np.arange(2001), "two": np.arange(2001)}
    np.testing.assert_allclose(region_factors(line, overlapping, {"one": 2.0, "two": 1.0}), 1.5)


def test_a_blink_stays_a_blink_where_the_lids_are_known(make_animation: Callable[..., Animation], eyes: Eyes) -> None:
    shut = make_animation(1, eyeBlink=1.0, browInnerUp=0.8)
    brows = make_animation(1, browInnerUp=0.8)
    blind, seeing = (scale_regions(shut, {"all": 2.0}, known) for known in (None, eyes))
    lids, closing = eyes.lids()
    strong = np.linalg.norm(closing, axis=1) > 0.5 * np.linalg.norm(closing, axis=1).max()
    reference = 2 * (brows.vertices[0] - brows.template)[lids] + closing
    ours = (seeing.vertices[0] - seeing.template)[lids]
    np.testing.assert_allclose(ours[strong], reference[strong], atol=3e-4)
    np.testing.assert_allclose((blind.vertices[0] - blind.template)[lids], reference + closing, atol=1e-6)
