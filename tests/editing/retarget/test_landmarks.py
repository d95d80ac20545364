"""Named places of faces, pairs of places on disk, and what they do for a correspondence."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.creation import icosphere

from facediff.editing import retargeting
from facediff.editing.correspondence import correspond
from facediff.editing.fit_check import FitReport, check_fit
from facediff.editing.landmarks import (
    FLAME,
    FLAME_VERTICES,
    NAMES,
    Landmarks,
    SurfacePoints,
    common_landmarks,
    known_landmarks,
    known_topology,
    landmarks_by_shape,
    puppet_landmarks,
    read_landmarks,
    write_landmarks,
)
from facediff.editing.surface import Surface, nearest
from facediff.editing.symmetry import Plane, symmetry_plane
from facediff.errors import FaceDiffError
from facediff.mesh import Mesh
from facediff.synthetic.head.parts import build_head
from tests.fakes.heads import (
    LONG,
    ROUND,
    STRONG,
    YOUNG,
    lower_face,
    lower_face_marks,
    nearest_vertices,
    talking,
    talking_second,
    turned,
)
from tests.fakes.small_face import LANDMARKS, Shape, build_face, build_rig

FACE, HEAD = build_face(), build_head()


@pytest.mark.parametrize("shape", [Shape(), ROUND, LONG, STRONG, YOUNG])
def test_a_topology_is_known_in_every_unit_and_pose_and_not_in_another_order(shape: Shape) -> None:
    points = shape(HEAD.vertices / 1000)
    found = known_topology(1000 * points @ turned(90, 30, 200).T + 7)
    assert found is not None
    assert (found.topology, found.missing) == ("puppet", [])
    assert known_topology(np.random.default_rng(0).permutation(points)) is None
    assert known_topology(points[:-1]) is None


def flame_like() -> np.ndarray:
    """A mesh with FLAME's number of vertices, in which FLAME's landmarks are where the puppet's are."""
    points = np.random.default_rng(1).normal(0, 0.05, (FLAME_VERTICES, 3))
    for name, vertex in puppet_landmarks().items():
        points[FLAME[name]] = HEAD.vertices[vertex] / 1000
    return points


def test_meshes_of_two_topologies_have_common_landmarks() -> None:
    found = common_landmarks(HEAD.vertices, flame_like())
    assert found is not None
    assert found.names == tuple(NAMES)
    assert nearest_vertices(found) == [[puppet_landmarks()[name], FLAME[name]] for name in NAMES]
    assert common_landmarks(HEAD.vertices, np.random.default_rng(2).normal(size=(FLAME_VERTICES, 3))) is None


def test_shape_alone_shows_the_mouth_the_eyes_and_the_nose() -> None:
    found = landmarks_by_shape(FACE.vertices, FACE.faces)
    truth = LANDMARKS
    assert set(found) == {name for name in NAMES if name.startswith(("eye", "mouth")) or name in SEEN}
    away = {name: np.linalg.norm(FACE.vertices[vertex] - FACE.vertices[truth[name]]) for name, vertex in found.items()}
    assert max(away.values()) < 0.006  # metres
    assert away["nose_tip"] == 0.0
    order = np.random.default_rng(0).permutation(len(FACE.vertices))
    known = known_landmarks(FACE.vertices[order], np.argsort(order)[FACE.faces])
    assert known.topology is None
    assert {name: int(order[vertex]) for name, vertex in known.vertices.items()} == found
    ball = icosphere(2)
    assert landmarks_by_shape(np.array(ball.vertices), np.array(ball.faces)) == {}


SEEN = ("nose_tip", "upper_lip_middle", "lower_lip_middle")


# On disk.


def some() -> Landmarks:
    inside = SurfacePoints(np.array([[4, 4, 4], [1, 2, 3]]), np.array([[1.0, 0.0, 0.0], [0.25, 0.5, 0.25]]))
    return Landmarks(("nose_tip", "mole"), SurfacePoints.of_vertices(np.array([124, 7])), inside)


def test_landmarks_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "marks.json"
    write_landmarks(path, some(), 1008, 42)
    found = read_landmarks(path)
    assert found.names == ("nose_tip", "mole")
    assert nearest_vertices(found) == [[124, 4], [7, 2]]
    for one, other in ((found.source, some().source), (found.target, some().target)):
        assert np.array_equal(one.weights, other.weights)
        assert np.array_equal(one.corners, other.corners)
    write_landmarks(tmp_path / "again.json", found, 1008, 42)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_names_stand_for_vertices_where_the_topology_is_known(tmp_path: Path) -> None:
    known = known_topology(HEAD.vertices)
    tip, outer = (puppet_landmarks()[name] for name in ("nose_tip", "eye_outer_left"))
    path = tmp_path / "a.csv"
    path.write_text("animation,mine\nnose_tip,4034\n7,chin\neye_outer_left\n")
    found = read_landmarks(path, known, known)
    assert nearest_vertices(found) == [[tip, 4034], [7, puppet_landmarks()["chin"]], [outer, outer]]
    assert found.names == ("nose_tip", "chin", "eye_outer_left")
    path.write_text("nose_tip,4034\n")  # a name is no header
    assert len(read_landmarks(path, known)) == 1
    with pytest.raises(FaceDiffError, match="nose_tip is not known on the source"):
        read_landmarks(path)


# What they do.


def test_a_landmark_within_a_triangle_is_held_as_a_vertex_is() -> None:
    """On a ball, whose shape says nothing of where its places are, the landmarks alone do."""
    ball, other = icosphere(2), icosphere(3)
    points, faces = np.array(ball.vertices), np.array(ball.faces)
    targets, corners = np.array(other.vertices), np.array(other.faces)
    random = np.random.default_rng(0)
    some_faces = random.choice(len(corners), 12, replace=False)
    weights = random.dirichlet([2, 2, 2], 12)
    target = SurfacePoints(corners[some_faces], weights)
    turn = turned(25, -10, 40)
    # The same places, turned, as points of triangles of the source.
    wanted = target.points(targets) @ turn.T
    there = nearest(Surface(points, faces), wanted, np.zeros_like(wanted), 0.0)
    marks = Landmarks(("",) * 12, SurfacePoints(there.corners, there.weights), target)
    found = correspond(points, faces, 3 * targets, corners, landmarks=marks)
    places = np.einsum("vk,vkd->vd", found.weights, points[found.corners])  # of the target's vertices on the source
    away = np.linalg.norm(target.points(places) - marks.source.points(points), axis=1)
    assert away.max() < 0.02  # of a radius of 1; the alignment alone is off by 0.1
    with pytest.raises(FaceDiffError, match="target vertex 5000"):
        correspond(points, faces, targets, corners, landmarks=np.array([[0, 5000]]))


def test_the_plane_of_symmetry_is_that_of_the_pose() -> None:
    turn = turned(10, -15, 8)
    points = 100 * build_rig(STRONG).neutral @ turn.T + [3, 4, 5]
    found = symmetry_plane(points, Plane(np.array([1.0, 0.0, 0.0]), float(np.median(points[:, 0]))))
    assert np.allclose(found.normal, turn[:, 0], atol=1e-6)
    assert np.allclose(found.mirror(points), points[FACE.mirror], atol=1e-4)


def test_named_landmarks_of_both_topologies_are_tried_where_the_result_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Landmarks | None] = []

    def refused(*_: object, landmarks: Landmarks | None, face_triangles: object) -> None:
        given.append(landmarks)
        raise FaceDiffError(f"attempt {len(given)}")

    monkeypatch.setattr(retargeting, "correspond", refused)
    animation = talking_second()
    target = tmp_path / "other.ply"
    mesh = trimesh.Trimesh(LONG(HEAD.vertices / 1000), HEAD.faces[::-1], process=False)
    mesh.export(target)
    with pytest.raises(FaceDiffError, match="attempt 2"):
        retargeting.retarget(animation, target, check=lambda *_: None)
    first, second = given
    assert first is None
    assert second is not None
    assert nearest_vertices(second) == [[vertex, vertex] for vertex in puppet_landmarks().values()]
    given.clear()
    (tmp_path / "own.csv").write_text("nose_tip,5\n")
    with pytest.raises(FaceDiffError, match="attempt 1"):  # a person's own landmarks are the last word
        retargeting.retarget(animation, target, None, tmp_path / "own.csv", check=lambda *_: None)
    assert given[0] is not None
    assert nearest_vertices(given[0]) == [[puppet_landmarks()["nose_tip"], 5]]


@pytest.mark.slow
def test_six_landmarks_cure_a_mask_that_is_refused_without() -> None:
    head, animation = lower_face(), talking()
    marks, mine = lower_face_marks(head), LANDMARKS
    pairs = np.array([[mine[name], vertex] for name, vertex in marks.items()])

    def report(landmarks: np.ndarray | None) -> FitReport:
        found = correspond(animation.template, animation.triangles, head.vertices, head.faces, landmarks=landmarks)
        return check_fit(animation, retargeting.transfer(animation, found, Mesh(head.vertices, head.faces)), found)

    assert not report(None).good
    found = report(pairs)
    assert found.good
    assert found.lip_ratio is not None
    assert found.lip_ratio < 0.2


def test_the_manual_lists_the_names_with_their_vertices() -> None:
    page = (Path(__file__).parents[3] / "docs" / "own_mesh.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \| [^|]+ \| (\d+ \| \d+) \|$", page, re.MULTILINE))
    face = puppet_landmarks()
    assert rows == {name: f"{face[name]} | {FLAME[name]}" for name in NAMES}


@pytest.mark.parametrize("pairs", [[(1, 1), (2, 2), (1, 3)], [(1, 1), (2, 1)]])
def test_pairs_that_contradict_each_other_are_refused(pairs: list[tuple[int, int]], tmp_path: Path) -> None:
    rows = [{"name": "", "source": source, "target": target} for source, target in pairs]
    (tmp_path / "a.json").write_text(json.dumps({"format": "facediff landmarks 1", "landmarks": rows}))
    (tmp_path / "a.csv").write_text("source,target\n" + "".join(f"{one},{other}\n" for one, other in pairs))
    for name in ("a.json", "a.csv"):
        with pytest.raises(FaceDiffError, match="two places of the other mesh"):
            read_landmarks(tmp_path / name)


def test_named_landmarks_come_second() -> None:
    head = HEAD.vertices
    attempts: list[Landmarks | None] = []

    def attempt(landmarks: Landmarks | None) -> str:
        attempts.append(landmarks)
        if landmarks is None:
            raise FaceDiffError("no line between its lips was found")
        return "by names"

    assert retargeting.by_shape_or_names(attempt, head, head) == "by names"
    assert [marks and "chin" in marks.names for marks in attempts] == [None, True]
    assert retargeting.by_shape_or_names(str, head, head) == "None"
    with pytest.raises(FaceDiffError, match="no line"):
        retargeting.by_shape_or_names(attempt, head[:-1], head)
