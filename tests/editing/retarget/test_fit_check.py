"""Heads of other people, topologies, units and axes, without landmarks; and results that cannot be used."""

from __future__ import annotations

from dataclasses import replace

import fast_simplification
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from facediff.animation import Animation
from facediff.editing import face_features
from facediff.editing.correspondence import LIDS_AT_REST, Correspondence, correspond, placed
from facediff.editing.face_features import LOWER_LIP, UPPER_LIP, find_features
from facediff.editing.fit_check import check_fit
from facediff.editing.retargeting import transfer, transfer_checked
from facediff.editing.surface import Surface
from facediff.mesh import Mesh
from facediff.mesh.flame import rotations
from facediff.mesh.mesh import triangle_areas
from facediff.synthetic.head.parts import build_head
from tests.fakes.heads import FAMILY, INTERIOR, Head, person, sealed_lips, talking, talking_second
from tests.fakes.small_face import M2, Shape, small_shapes


@pytest.fixture(scope="module")
def animation() -> Animation:
    return talking()


def carried(animation: Animation, head: Head) -> tuple[Animation, Correspondence]:
    found = correspond(animation.template, animation.triangles, head.vertices, head.faces)
    return transfer(animation, found, Mesh(head.vertices, head.faces.astype(np.int32))), found


QUICK = ("slit mask",)
EYES_REST = ("mask", "scan", "painted eyes")
"""Heads whose eyes are one skin."""
RAGGED = ("re-meshed head",)
"""Heads in whose lips no line is found: refused, as the manual says."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in FAMILY])
def test_a_head_from_elsewhere_speaks_or_is_refused(animation: Animation, name: str) -> None:
    head = FAMILY[name]()
    mesh = Mesh(head.vertices, head.faces.astype(np.int32))
    found = correspond(animation.template, animation.triangles, head.vertices, head.faces)
    made, found, report = transfer_checked(animation, found, mesh)
    print(f"{name}, {len(head.vertices)} vertices: {report.summary}")  # rows of docs/own_mesh.md
    assert report.good == (head.alive and name not in RAGGED), report.faults
    if not report.good:
        return
    assert report.lip_ratio is not None
    assert report.lip_ratio <= 0.2
    assert report.eyes is not None
    if name in EYES_REST:
        assert report.eyes.lid_gap is None
        assert report.remarks
    else:
        assert not report.remarks
        assert report.eyes.lid_gap is not None
        assert report.eyes.overshoot is not None
        assert report.eyes.lid_gap <= 0.12
        assert report.eyes.overshoot <= 0.2
        assert report.eyes.inside == 0
        assert report.eyes.hole is not None
        assert report.eyes.hole <= 0.12
    assert report.eyes.stretch < 0.7
    assert report.folded < 0.02
    # The carried pairs of lips say the same without the check's own search for the lips.
    assert made.inner_lip_pairs is not None
    one, two = made.inner_lip_pairs.T
    gaps = np.linalg.norm(made.vertices[:, one] - made.vertices[:, two], axis=2).mean(axis=1)
    assert gaps[0] <= 0.2 * gaps.max()
    expected = animation.inner_lip_pairs
    assert expected is not None
    own = np.linalg.norm(animation.vertices[3, expected[:, 0]] - animation.vertices[3, expected[:, 1]], axis=1).mean()
    assert gaps[3] - gaps[0] == pytest.approx(found.similarity.scale * own, rel=0.35)


def test_a_nod_needs_no_place_on_the_mesh(animation: Animation) -> None:
    """Acting turns the head as a whole: a mask is judged by its face, and carried with the nod."""
    head = FAMILY["slit mask"]()
    mesh = Mesh(head.vertices, head.faces.astype(np.int32))
    found = correspond(animation.template, animation.triangles, head.vertices, head.faces)
    nods = np.zeros((len(animation.vertices), 6))
    nods[1:, 0] = 0.5
    with_nods = np.einsum("tij,tvj->tvi", rotations(nods[:, :3]), animation.vertices).astype(np.float32)
    nodding = replace(animation, vertices=with_nods, head=nods)
    _, _, report = transfer_checked(animation, found, mesh)
    made, _, same = transfer_checked(nodding, found, mesh)
    assert report.covered == pytest.approx(same.covered, abs=1e-3)
    assert (same.good, same.faults) == (True, ())
    assert np.allclose(made.vertices, transfer(nodding, found, mesh).vertices)
    assert np.ptp(made.vertices[1] - made.template, axis=0)[2] > 0.02 * found.similarity.scale


@pytest.mark.slow
@pytest.mark.parametrize("nod", [0.0, 20.0])
def test_a_stylised_head_stays_upright_and_a_head_that_nods_does_not(animation: Animation, nod: float) -> None:
    """A short lower face, a wide head and a forehead that bulges; or a person's head that looks down."""
    head = build_head()
    x, y, z = (head.vertices / 1000).T
    if nod == 0:
        bulge = z + 0.015 * np.exp(-(((y - 0.08) / 0.04) ** 2))
        x, y, z = 1.125 * x, np.where(y < 0.02, 0.02 + 0.875 * (y - 0.02), y), 1.05 * bulge
    turn = Rotation.from_euler("x", nod, degrees=True)
    source = Surface(animation.template.astype(np.float64), animation.triangles.astype(np.int64))
    back, _, _ = placed(source, Surface(turn.apply(np.stack([x, y, z], axis=1)), head.faces[:-1].astype(np.int64)))
    pitch, *others = np.abs(Rotation.from_matrix(back.rotation).as_euler("xyz", degrees=True))
    assert pitch == pytest.approx(nod, abs=4)
    assert max(others) < 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dressed avatar", "sockets and lashes"])
def test_lashes_rest_with_their_lids(animation: Animation, name: str) -> None:
    head = FAMILY[name]()
    _, found = carried(animation, head)
    rests = replace(found, lids=LIDS_AT_REST)
    made = transfer(animation, rests, Mesh(head.vertices, head.faces.astype(np.int32)))
    most = np.linalg.norm(made.vertices - made.template, axis=2).max(axis=0)
    lashes = np.unique(np.concatenate([head.faces[faces] for part, faces in head.parts.items() if "lash" in part]))
    assert len(lashes)
    assert most[lashes].max() == 0.0
    brows = [head.faces[faces] for part, faces in head.parts.items() if "brow" in part]
    assert all(most[part].max() > 0 for part in brows)


@pytest.mark.slow
def test_what_is_worn_stands_still_and_what_lies_on_skin_moves(animation: Animation) -> None:
    head = FAMILY["dressed avatar"]()
    made, _ = carried(animation, head)
    most = np.linalg.norm(made.vertices - made.template, axis=2).max(axis=0)
    moved = {name: float(most[head.faces[faces]].max()) for name, faces in head.parts.items()}
    worn = [name for name in moved if name.startswith(("lens", "bow", "bridge", "earring", "hat", "body", "hair"))]
    assert len(worn) == 10
    assert {name: moved[name] for name in worn} == dict.fromkeys(worn, 0.0)
    assert moved["brows"] > 0.3  # centimetres
    assert moved["lashes"] > 0.6


def test_the_lips_of_the_puppet_are_found_without_being_told(animation: Animation) -> None:
    seen = find_features(np.asarray(animation.template, np.float64), animation.triangles.astype(np.int64))
    assert seen is not None
    assert animation.inner_lip_pairs is not None
    upper, lower = animation.inner_lip_pairs.T
    assert (seen.codes[upper] == UPPER_LIP).all()
    assert (seen.codes[lower] == LOWER_LIP).all()
    assert seen.mouth.width == pytest.approx(0.05, abs=0.003)
    assert seen.mouth.centre[0] == pytest.approx(0, abs=0.001)
    assert [eye is not None and eye.centre[:2] == pytest.approx([x, 0.0255], abs=0.003) for eye, x in zip(
        seen.eyes, (-0.032, 0.032), strict=True
    )] == [True, True]  # fmt: skip


def test_a_calm_mouth_on_a_coarse_mesh_parts_its_lips() -> None:
    """Facing vertices of a coarse mesh lie beside one another, by a third of the gap of a mouth that opens by 4 mm."""
    lively = talking_second()
    points, faces = fast_simplification.simplify(lively.template, lively.triangles, target_reduction=0.5)
    moved = lively.template + np.float32(0.3) * (lively.vertices - lively.template)
    calm = replace(lively, vertices=moved)
    found = correspond(calm.template, calm.triangles, points, faces)
    report = transfer_checked(calm, found, Mesh(points, faces.astype(np.int32)))[2]
    assert report.good, report.faults
    assert report.lip_ratio is not None
    assert report.lip_ratio < 0.1
    assert report.opened == pytest.approx(1, abs=0.05)


def test_an_eye_is_no_mouth(animation: Animation, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mask with holes for eyes and one skin over its mouth, laid so that the holes are about where the mouth is."""
    seen = find_features(animation.template.astype(np.float64), animation.triangles.astype(np.int64))
    assert seen is not None
    vertices, faces = sealed_lips(*person(Shape(), *INTERIOR, "teeth", "eyeball", "pupil", "lid_inner", "ear"))
    assert find_features(vertices, faces, seen) is None
    moved = vertices + [0.01, seen.mouth.centre[1] - 0.0255, 0.0]
    assert find_features(moved, faces, seen) is None
    monkeypatch.setattr(face_features, "ASIDE", (9.0, 9.0))
    assert find_features(moved, faces, seen) is not None


def test_wrecks_are_named(animation: Animation) -> None:
    """The puppet's own face, on which lips are glued, torn or swapped by hand."""
    whole = Mesh(animation.template.astype(np.float64), animation.triangles)
    found = correspond(whole.vertices, whole.faces, whole.vertices, whole.faces)
    good = transfer(animation, found, whole)
    assert check_fit(animation, good, found).good
    pairs = animation.inner_lip_pairs
    assert pairs is not None
    near = np.linalg.norm(animation.template - animation.template[pairs].mean(axis=(0, 1)), axis=1) < 0.045
    glued = good.vertices.copy()
    glued[:, near] = (animation.template + (good.vertices - animation.template)[:, near].mean(axis=1)[:, None])[:, near]
    torn = good.vertices.copy()
    seen = find_features(animation.template.astype(np.float64), animation.triangles.astype(np.int64))
    assert seen is not None
    side = near & (seen.codes == UPPER_LIP) & (animation.template[:, 0] < 0)
    down = (good.vertices - animation.template)[:, pairs[6, 1]]
    torn[:, side] = animation.template[side] + down[:, None]
    swapped = good.vertices.copy()
    swapped[:, pairs] = animation.template[pairs] - (swapped[:, pairs] - animation.template[pairs])
    for vertices in (glued, torn, swapped):
        report = check_fit(animation, replace(good, vertices=vertices), found)
        assert not report.good
    still = replace(animation, vertices=np.repeat(animation.template[None], 3, axis=0))
    assert check_fit(still, transfer(still, found, whole), found).good


def test_wrecks_of_eyes_and_forehead_are_named(animation: Animation) -> None:
    """The puppet's own face with one eye that stays open, lids that pass, lids that stay open, and a torn forehead."""
    whole = Mesh(animation.template.astype(np.float64), animation.triangles)
    found = correspond(whole.vertices, whole.faces, whole.vertices, whole.faces)
    good = transfer(animation, found, whole)
    report = check_fit(animation, good, found)
    assert report.good
    assert report.eyes is not None
    assert report.eyes.lid_gap == 0
    rest = animation.template
    wide = 1.0 * (rest[:, 0] < 0)[:, None]
    wink, still, far = (rest + share * (good.vertices[9] - rest) for share in (wide, np.float32(0), np.float32(1.7)))
    forehead = good.vertices[10].copy()
    ragged = (rest[:, 1] > 0.05) & (rest[:, 2] > 0.04) & (np.arange(len(rest)) % 3 == 0)
    forehead[ragged] += [0, 0.02, 0.004]
    words = []
    for frame, posed in ((9, wink), (9, still), (9, far), (10, forehead)):
        vertices = good.vertices.copy()
        vertices[frame] = posed
        wreck = check_fit(animation, replace(good, vertices=vertices), found)
        assert not wreck.good
        words.append(" ".join(wreck.faults))
    for word, fault in zip(("shut", "shut", "pass", "forehead"), words, strict=True):
        assert word in fault
    notch = 1 - 0.3 * (np.abs(np.abs(rest[:, :1]) - 0.031) < 0.003)  # lids that never shut there
    odd = replace(animation, vertices=rest + notch.astype(np.float32) * (animation.vertices - rest))
    copied, _, _ = transfer_checked(odd, found, whole)
    assert np.allclose(copied.vertices, odd.vertices, atol=1e-6), "on its own mesh"
    blind = replace(animation, vertices=animation.vertices[:9])
    eyes = check_fit(blind, transfer(blind, found, whole), found).eyes
    assert eyes is not None
    assert eyes.lid_gap is None  # an animation that does not blink says nothing of the lids


def test_a_beard_over_the_mouth_is_not_the_face(animation: Animation) -> None:
    vertices, faces = np.float64(animation.template), animation.triangles.astype(np.int64)
    seen = find_features(vertices, faces)
    assert seen is not None
    x, y = np.meshgrid(np.linspace(-0.03, 0.03, 13), np.linspace(-0.02, 0.02, 9))
    card = np.stack([x.ravel(), y.ravel() + seen.mouth.centre[1], 0 * x.ravel() + vertices[:, 2].max() + 0.01], axis=1)
    corner = (np.arange(8)[:, None] * 13 + np.arange(12)).ravel() + len(vertices)
    quads = np.stack([corner, corner + 1, corner + 14, corner + 13], axis=1)
    both = np.concatenate([faces, quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    found = find_features(np.concatenate([vertices, card]), both, seen)
    assert found is not None
    assert not found.skin[len(vertices) :].any()
    assert found.mouth.centre == pytest.approx(seen.mouth.centre, abs=1e-3)


def test_triangles_without_area_do_not_close_the_mouth() -> None:
    """Decimation and written digits leave some; without them, lips that touch would look like a texture's seam."""
    vertices, faces, _ = small_shapes(M2)
    vertices = vertices.round(9)
    for _ in range(2):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    points, corners = fast_simplification.simplify(vertices, faces, 0.6)
    points, corners = (np.float64(points) * 1000).round(8), np.asarray(corners, np.int64)
    assert (triangle_areas(points, corners) == 0).sum() > 100
    found = find_features(points, corners)
    assert found is not None
    upper, lower = found.lips(points, 9).T
    assert (points[upper, 1] >= points[lower, 1] - 0.5).all()
    assert {UPPER_LIP} == set(found.codes[upper])
    assert {LOWER_LIP} == set(found.codes[lower])
