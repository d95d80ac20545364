"""The head is a sound, symmetric mesh, and the people are different people."""

import itertools

import numpy as np

from facediff import synthetic as puppet
from facediff.synthetic.corpus import regions, rig_of
from facediff.synthetic.face import build_face
from facediff.synthetic.rig import lip_pairs
from facediff.synthetic.speakers import SPEAKERS


def test_every_vertex_is_used_and_no_face_is_degenerate() -> None:
    mesh = build_face()
    assert len(mesh.vertices) == puppet.N_VERTICES
    assert 700 <= puppet.N_VERTICES <= 1500
    assert np.array_equal(np.unique(mesh.faces), np.arange(puppet.N_VERTICES))
    for speaker in SPEAKERS:
        a, b, c = np.moveaxis(rig_of(speaker).neutral[mesh.faces], 1, 0)
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        assert area.min() > 1e-8, speaker


def test_every_edge_belongs_to_at_most_two_faces_that_agree_on_the_outside() -> None:
    faces = build_face().faces
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)


def test_skin_has_no_hole_but_mouth_eyes_and_neck() -> None:
    mesh = build_face()
    directed = {tuple(edge) for face in mesh.faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)}
    open_ends = {a for a, b in directed if (b, a) not in directed}
    skin = open_ends & set(mesh.both("skin", "crown").tolist())
    assert skin
    assert mesh.vertices[sorted(skin), 1].max() < -0.14


def test_neutral_heads_are_symmetric_and_of_human_size() -> None:
    mesh = build_face()
    flip = np.array([-1.0, 1.0, 1.0])
    for speaker in SPEAKERS:
        head = rig_of(speaker).neutral
        np.testing.assert_allclose(head[mesh.mirror], head * flip, atol=1e-12)
        width, height, depth = np.ptp(head, axis=0)
        assert 0.13 < width < 0.21
        assert 0.24 < height < 0.34
        assert 0.17 < depth < 0.27
    mirrored = {tuple(sorted(face)) for face in mesh.mirror[mesh.faces].tolist()}
    assert mirrored == {tuple(sorted(face)) for face in mesh.faces.tolist()}


def test_people_differ() -> None:
    heads = {name: rig_of(name).neutral for name in SPEAKERS}
    face = np.concatenate(list(regions().values()))
    for first, second in itertools.combinations(heads, 2):
        apart = np.linalg.norm(heads[first][face] - heads[second][face], axis=1)
        assert np.sqrt((apart**2).mean()) > 0.002, (first, second)


def test_regions_are_where_they_should_be() -> None:
    mesh = build_face()
    areas = regions()
    assert not set(areas["lve"]) & set(areas["fdd"])
    lips, upper = mesh.vertices[areas["lve"]], mesh.vertices[areas["fdd"]]
    assert np.abs(lips[:, 1] + 0.048).max() < 0.015
    assert upper[:, 1].min() > 0.01
    top, bottom = lip_pairs(mesh)
    assert set(top) | set(bottom) <= set(areas["lve"])
    assert len(top) == len(bottom) == 13
    assert (np.diff(mesh.vertices[top, 0]) > 0).all()
