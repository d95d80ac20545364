"""An avatar's own shapes and bones play an animation: values, names of rigs, and what must stay in the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from facediff.animation import Animation
from facediff.errors import FaceDiffError
from facediff.export import write_animations
from facediff.export.glb_own_shapes import drive_avatar, own_shapes
from facediff.mesh import read_mesh
from facediff.mesh.glb import Glb, open_glb
from facediff.mesh.glb_scene import placed_parts
from facediff.spaces import layout
from facediff.spaces.arkit import ALPHABETICAL
from facediff.spaces.visemes import visemes
from tests.fakes.avatar import AvatarPart, avatar_parts, write_avatar
from tests.fakes.glb_reader import without_new_animation
from tests.fakes.glb_targets import pack
from tests.fakes.gltf_scene import GltfScene
from tests.fakes.small_face import F1, small_shapes

FRAMES = 30
NECK = np.array([0.0, 1.5, 0.0])  # where the avatar's bone of the head is


@pytest.fixture(scope="module")
def parts() -> dict[str, AvatarPart]:
    return avatar_parts(rounds=0)


@pytest.fixture(scope="module")
def spoken() -> Animation:
    """Weights of ARKit's shapes that go up and down one after the other, with a head that turns."""
    rest, faces, _ = small_shapes(F1)
    times = np.arange(FRAMES) / 25
    values = np.zeros((FRAMES, 52), np.float32)
    for k, name in enumerate(
        ("jawOpen", "mouthPucker", "eyeBlinkLeft", "eyeBlinkRight", "browInnerUp", "eyeLookUpLeft")
    ):
        values[:, ALPHABETICAL.index(name)] = np.clip(np.sin(4 * times + k), 0, 1)
    head = np.zeros((FRAMES, 6))
    head[:, :3] = 0.2 * np.sin(np.outer(times, [3, 2, 1]))
    points = np.repeat(rest[None].astype(np.float32), FRAMES, axis=0)
    plain = Animation("talk", points, points[0], 25.0, faces=faces, head=head)
    return plain.made_of(layout("arkit"), values)


def tracks(glb: Glb) -> dict[tuple[str, str], np.ndarray]:
    """Values of the animation that was added by the node's name and what moves, one row a frame."""
    motion = glb.content["animations"][0]
    result = {}
    for channel in motion["channels"]:
        sampler, path = motion["samplers"][channel["sampler"]], channel["target"]["path"]
        count = glb.content["accessors"][sampler["input"]]["count"]
        rows = glb.numbers(sampler["output"], "SCALAR" if path == "weights" else "VEC4", ("f4",))
        node = glb.content["nodes"][channel["target"]["node"]]
        result[node["name"], path] = rows.reshape(count, -1)
    return result


def posed(path: Path, frame: int) -> dict[str, np.ndarray]:
    """Vertices of each node's mesh at a frame: targets by their weights, then the skin of bones that have turned."""
    glb = open_glb(path)
    moving = tracks(glb)
    nodes = {node["name"]: node for node in glb.content["nodes"] if "mesh" not in node}
    for (name, kind), rows in moving.items():
        if kind == "rotation":
            nodes[name]["rotation"] = rows[frame].tolist()
    result = {}
    for part in placed_parts(glb):
        points = part.local.copy()
        weights = moving.get((glb.content["nodes"][part.node]["name"], "weights"))
        for k, target in enumerate(part.primitive.get("targets", []) if weights is not None else []):
            points += weights[frame, k] * glb.numbers(target["POSITION"], "VEC3", ("f4",), len(points))
        matrix = np.broadcast_to(np.eye(4) if part.matrix is None else part.matrix, (len(points), 4, 4))
        points = np.einsum("vij,vj->vi", matrix[:, :3, :3], points) + matrix[:, :3, 3]
        result[glb.content["nodes"][part.node]["name"]] = points
    return result


def test_weights_go_by_name_and_all_else_stays(tmp_path: Path, parts: dict[str, AvatarPart], spoken: Animation) -> None:
    write_avatar(tmp_path / "avatar.glb", parts)
    (written,) = write_animations(tmp_path / "out.glb", [spoken], into=tmp_path / "avatar.glb", own_shapes=True)
    old, new = open_glb(tmp_path / "avatar.glb"), open_glb(written)
    assert new.binary.startswith(old.binary)
    assert without_new_animation(new.content, old.content) == old.content
    moving = tracks(new)
    assert spoken.values is not None
    names = list(parts["Head"].targets)
    for part in ("Head", "Teeth", "Tongue"):
        for k, name in enumerate(names):
            expected = spoken.values[:, ALPHABETICAL.index(name)]
            np.testing.assert_allclose(moving[part, "weights"][:, k], expected, atol=1e-6)
    # Three meshes with the same targets share one track of 52 weights.
    grown = written.stat().st_size - (tmp_path / "avatar.glb").stat().st_size
    assert grown < 4 * FRAMES * (52 + 4 + 1) + 3000
    # The head turns about its bone as the animation's does, with what hangs on it.
    assert spoken.head is not None
    before, after = posed(tmp_path / "out.glb", 0), posed(tmp_path / "out.glb", 17)
    turn = Rotation.from_rotvec(spoken.head[17, :3])
    np.testing.assert_allclose(after["Hair"] - NECK, turn.apply(before["Hair"] - NECK), atol=1e-5)
    np.testing.assert_allclose(after["Body"], before["Body"], atol=1e-6)
    assert np.ptp(after["Hair"] - before["Hair"], axis=0).max() > 0.01


LAYOUTS: dict[str, dict[str, Any]] = {
    "skinned, centimetres, z up": {},
    "skinned, stored in a pose": {"posed": True, "sparse": False},
    "quantised positions": {"skinned": False, "quantised": True},
    "one mesh": {"joined": True, "unit": 1.0, "z_up": False, "skinned": False, "sparse": False},
}


def test_a_slider_of_the_avatar_stays_where_it_rests(
    tmp_path: Path, parts: dict[str, AvatarPart], spoken: Animation
) -> None:
    write_avatar(tmp_path / "avatar.glb", parts, names={"browInnerUp": "HeadWidth"})
    glb, at = open_glb(tmp_path / "avatar.glb"), list(parts["Head"].targets).index("browInnerUp")
    for mesh in glb.content["meshes"]:
        if "weights" in mesh or "targets" in mesh["primitives"][0]:
            mesh["weights"] = [-0.5 * (k == at) for k in range(len(parts["Head"].targets))]
    (tmp_path / "avatar.glb").write_bytes(pack(glb.content, glb.binary))
    drive_avatar(tmp_path / "out.glb", tmp_path / "avatar.glb", spoken)
    assert (tracks(open_glb(tmp_path / "out.glb"))["Head", "weights"][:, at] == -0.5).all()


@pytest.mark.parametrize("which", LAYOUTS)
def test_carried_motion_is_solved_for_on_the_avatar(tmp_path: Path, parts: dict[str, AvatarPart], which: str) -> None:
    """A motion that the avatar's shapes can make comes back on every layout."""
    write_avatar(tmp_path / "avatar.glb", parts, **LAYOUTS[which])
    mesh = read_mesh(tmp_path / "avatar.glb")
    rest = mesh.vertices.astype(np.float32)
    vertices, before = np.repeat(rest[None], FRAMES, axis=0), 0
    opening = np.clip(np.sin(np.arange(FRAMES) / 5), 0, 0.8)
    glb, names = open_glb(tmp_path / "avatar.glb"), list(parts["Head"].targets)
    for part in placed_parts(glb):
        targets = part.primitive.get("targets")
        for shape, weights in (("jawOpen", opening), ("eyeBlinkLeft", opening[::-1])):
            if targets:
                position = targets[names.index(shape)]["POSITION"]
                moves = part.turned(glb.numbers(position, "VEC3", ("f4",), len(part.local)))
                vertices[:, before : before + len(part.local)] += (weights[:, None, None] * moves).astype(np.float32)
        before += len(part.local)
    animation = Animation("talk", vertices, rest, 25.0, faces=mesh.faces)
    drive_avatar(tmp_path / "out.glb", tmp_path / "avatar.glb", animation)
    rows = tracks(open_glb(tmp_path / "out.glb"))["Head", "weights"]
    assert np.abs(rows[:, names.index("jawOpen")] - opening).max() < 0.03
    assert np.abs(rows[:, names.index("eyeBlinkLeft")] - opening[::-1]).max() < 0.03
    with pytest.raises(FaceDiffError, match="vertices"):
        drive_avatar(tmp_path / "out.glb", tmp_path / "avatar.glb", Animation("other", vertices[:, :9], rest[:9], 25.0))


@pytest.mark.parametrize("which", LAYOUTS)
def test_another_reader_sees_the_avatar_as_weights_and_head_have_it(
    tmp_path: Path, parts: dict[str, AvatarPart], spoken: Animation, which: str
) -> None:
    """At frames and between them, to a tenth of a millimetre, from the avatar's shapes in metres."""
    stored_as = LAYOUTS[which]
    write_avatar(tmp_path / "avatar.glb", parts, **stored_as)
    drive_avatar(tmp_path / "out.glb", tmp_path / "avatar.glb", spoken)
    scene = GltfScene(tmp_path / "out.glb")
    assert spoken.values is not None
    assert spoken.head is not None
    times = np.arange(FRAMES) / 25
    heads = Slerp(times, Rotation.from_rotvec(spoken.head[:, :3]))
    for time in (0.0, 3 / 25, 0.37, 0.611, times[-1], 9.0):
        at = min(time, times[-1])
        weights = {name: np.interp(at, times, spoken.values[:, k]) for k, name in enumerate(ALPHABETICAL)}
        seen = scene.vertices(time)
        for name, part in parts.items():
            points = part.vertices + sum((weights[shape] * delta for shape, delta in part.targets.items()), 0.0)
            if stored_as.get("skinned", True) and part.joint:
                # A part that is stored in a pose hangs on the head by some weights, and on the spine by the others.
                height = part.vertices[:, 1] - part.vertices[:, 1].min()
                share = (0.5 + 0.5 * height / height.max() if stored_as.get("posed") else np.ones(len(height)))[:, None]
                stored = Rotation.from_rotvec([0.4, 0, 0] if stored_as.get("posed") else [0, 0, 0])
                turned = (heads(at) * stored).apply(points - NECK) + NECK
                points = share * turned + (1 - share) * points
            assert np.linalg.norm(seen[f"{name}Material"] - points, axis=1).max() < 1e-4, (name, time)


VISEMES = dict(
    zip(("jawOpen", "mouthSmileLeft", "mouthPucker", "mouthStretchLeft", "mouthFunnel"), "AIUEO", strict=True)
)


def test_visemes_are_driven_where_the_avatar_has_no_arkit_mouth(
    tmp_path: Path, parts: dict[str, AvatarPart], spoken: Animation
) -> None:
    other = {name: f"x{k}" for k, name in enumerate(ALPHABETICAL)}
    vrm = {
        **other,
        **{name: f"Face.Fcl_MTH_{vowel}" for name, vowel in VISEMES.items()},
        "eyeBlinkLeft": "Fcl_EYE_Close",
    }
    write_avatar(tmp_path / "vrm.glb", parts, names=vrm)
    assert own_shapes(tmp_path / "vrm.glb").binds.keys() >= {*"AIUEO"}
    write_avatar(tmp_path / "jaw.glb", parts, names={**vrm, "mouthSmileRight": "jawOpen"})
    assert own_shapes(tmp_path / "jaw.glb").kind == "VRM"  # a jaw alone is no mouth
    assert spoken.values is not None
    truth, space = visemes(spoken.values, layout("arkit"), "vrm")
    drive_avatar(tmp_path / "out.glb", tmp_path / "vrm.glb", spoken)
    rows = tracks(open_glb(tmp_path / "out.glb"))["Head", "weights"]
    names = list(parts["Head"].targets)
    for name, vowel in VISEMES.items():
        expected = truth[:, space.channels.index(vowel)]
        np.testing.assert_allclose(rows[:, names.index(name)], expected, atol=1e-6)
    blinks = spoken.values[:, [ALPHABETICAL.index(f"eyeBlink{side}") for side in ("Left", "Right")]]
    np.testing.assert_allclose(rows[:, names.index("eyeBlinkLeft")], blinks.mean(1), atol=1e-6)
    assert rows.any(axis=0).sum() <= 6
    # The same expressions, bound by VRM's extensions to targets of any name.
    write_avatar(tmp_path / "plain.glb", parts, names=other)
    glb = open_glb(tmp_path / "plain.glb")
    head = next(i for i, node in enumerate(glb.content["nodes"]) if node["name"] == "Head")
    mesh, at = glb.content["nodes"][head]["mesh"], names.index("jawOpen")
    zero = [
        {"presetName": vowel.lower(), "binds": [{"mesh": mesh, "index": at + k, "weight": 50}]}
        for k, vowel in enumerate("AIUEO")
    ]
    one = {
        preset: {"morphTargetBinds": [{"node": head, "index": at + k, "weight": 0.5}]}
        for k, preset in enumerate(("aa", "ih", "ou", "ee", "oh"))
    }
    for extension in (
        {"VRM": {"blendShapeMaster": {"blendShapeGroups": zero}}},
        {"VRMC_vrm": {"expressions": {"preset": one}}},
    ):
        (tmp_path / "bound.glb").write_bytes(pack({**glb.content, "extensions": extension}, glb.binary))
        drive_avatar(tmp_path / "out.glb", tmp_path / "bound.glb", spoken)
        bound = tracks(open_glb(tmp_path / "out.glb"))["Head", "weights"]
        np.testing.assert_allclose(bound[:, at], 0.5 * truth[:, space.channels.index("A")], atol=1e-6)


def test_oculus_visemes_under_the_names_of_exporters(
    tmp_path: Path, parts: dict[str, AvatarPart], spoken: Animation
) -> None:
    spelled = ("PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR", "aa", "E", "I", "O", "U")
    names = {name: f"x{k}" for k, name in enumerate(ALPHABETICAL)}
    mouth = [name for name in ALPHABETICAL if name.startswith("mouth")][: len(spelled)]
    names |= {name: f"viseme_{viseme}" for name, viseme in zip(mouth, spelled, strict=True)}
    write_avatar(tmp_path / "avatar.glb", parts, names=names)
    own = own_shapes(tmp_path / "avatar.glb")
    assert own.kind == "Oculus"
    assert set(own.binds) == {"PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR", "aa", "E", "ih", "oh", "ou"}
    drive_avatar(tmp_path / "out.glb", tmp_path / "avatar.glb", spoken)
    assert spoken.values is not None
    truth, space = visemes(spoken.values, layout("arkit"), "oculus")
    rows = tracks(open_glb(tmp_path / "out.glb"))["Head", "weights"]
    at = list(parts["Head"].targets).index(mouth[spelled.index("O")])
    np.testing.assert_allclose(rows[:, at], truth[:, space.channels.index("oh")], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "bone"),
    [
        ("Head", "head"),
        ("mixamorig:Head", "head"),
        ("CC_Base_Head", "head"),
        ("J_Bip_C_Neck", "neck"),
        ("LeftEye", "left_eye"),
        ("eye.R", "right_eye"),
        ("J_Adj_L_FaceEye", "left_eye"),
        ("CC_Base_JawRoot", None),
        ("JawJoint", "jaw"),
        ("Forehead", None),
        ("HeadTop_End", None),
    ],
)
def test_bones_by_their_names(
    tmp_path: Path, parts: dict[str, AvatarPart], spoken: Animation, name: str, bone: str | None
) -> None:
    """Eyes and jaw turn by bones where no shape does it, about the scene's axes whatever the rig's."""
    without = ("eyeLook", "jawOpen") if bone == "jaw" else ("eyeLook",)
    gone = {n: f"x{k}" for k, n in enumerate(ALPHABETICAL) if n.startswith(without)}
    write_avatar(tmp_path / "avatar.glb", parts, names=gone)
    glb = open_glb(tmp_path / "avatar.glb")
    joint = next(node for node in glb.content["nodes"] if node["name"] == "HeadJoint")
    joint["name"] = name
    # A bone whose rest is a matrix, which an animated node must not have.
    matrix = np.eye(4)
    matrix[:3, 3] = joint.pop("translation")
    joint["matrix"] = matrix.T.ravel().tolist()
    (tmp_path / "bone.glb").write_bytes(pack(glb.content, glb.binary))
    own = own_shapes(tmp_path / "bone.glb")
    assert own.names == ({} if bone is None else {bone: name})
    drive_avatar(tmp_path / "out.glb", tmp_path / "bone.glb", spoken)
    moving = tracks(open_glb(tmp_path / "out.glb"))
    if bone is None:
        assert {kind for _, kind in moving} == {"weights"}
        return
    assert spoken.head is not None
    assert spoken.values is not None
    up = spoken.values[:, ALPHABETICAL.index("eyeLookUpLeft")]
    opening = spoken.values[:, ALPHABETICAL.index("jawOpen")]
    none = np.zeros(FRAMES)
    turns = {
        "head": spoken.head[:, :3],
        "neck": spoken.head[:, :3],
        "left_eye": np.stack([-0.44 * up, none, none], axis=1),
        "right_eye": np.zeros((FRAMES, 3)),
        "jaw": np.stack([np.deg2rad(25) * opening, none, none], axis=1),
    }[bone]
    before = posed_at_rest(tmp_path / "bone.glb")
    for frame in (3, 17):
        after = posed(tmp_path / "out.glb", frame)
        turned = Rotation.from_rotvec(turns[frame]).apply(before["Hair"] - NECK) + NECK
        np.testing.assert_allclose(after["Hair"], turned, atol=1e-5)


@pytest.mark.parametrize("name", ["Head", "LeftEye", "JawJoint"])
def test_bones_of_vrms_older_version_turn_about_a_face_that_looks_back(
    tmp_path: Path, parts: dict[str, AvatarPart], spoken: Animation, name: str
) -> None:
    without = ("eyeLook", "jawOpen") if name == "JawJoint" else ("eyeLook",)
    gone = {n: f"x{k}" for k, n in enumerate(ALPHABETICAL) if n.startswith(without)}
    write_avatar(tmp_path / "avatar.glb", parts, names=gone)
    glb = open_glb(tmp_path / "avatar.glb")
    next(node for node in glb.content["nodes"] if node["name"] == "HeadJoint")["name"] = name
    before = posed_at_rest(tmp_path / "avatar.glb")["Hair"] - NECK
    after = {}
    for version in ("VRM", "VRMC_vrm"):
        (tmp_path / "bone.glb").write_bytes(pack({**glb.content, "extensions": {version: {}}}, glb.binary))
        drive_avatar(tmp_path / "out.glb", tmp_path / "bone.glb", spoken)
        after[version] = posed(tmp_path / "out.glb", 17)["Hair"] - NECK
    assert np.abs(after["VRMC_vrm"] - before).max() > 0.01
    notes = own_shapes(tmp_path / "bone.glb").left_out(replace(spoken, channels=None))  # solved for by shapes alone
    assert ("the jaw's bone stays still" in " ".join(notes)) == (name == "JawJoint")
    # Seen from behind, the one turns as the other does seen from the front.
    turn = Rotation.align_vectors(after["VRM"], before)[0].as_rotvec()
    usual = Rotation.align_vectors(after["VRMC_vrm"], before)[0].as_rotvec()
    np.testing.assert_allclose(turn, usual * [-1, 1, -1], atol=1e-5)


def posed_at_rest(path: Path) -> dict[str, np.ndarray]:
    glb = open_glb(path)
    return {glb.content["nodes"][part.node]["name"]: part.points for part in placed_parts(glb)}
