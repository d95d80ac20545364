"""Recordings of ARKit's weights are played by the built-in face, and written again as they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import facediff
from facediff.animation import Animation
from facediff.cli.app import main
from facediff.spaces import layout
from facediff.spaces.arkit import ARKIT
from facediff.spaces.files import ParameterClip, read_parameters, write_parameters
from facediff.synthetic.known_faces import built_in_rig
from tests.fakes.glb_reader import Reader
from tests.fakes.small_face import F1, small_shapes


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_a_recording_is_played_and_written_again(tmp_path: Path, suffix: str) -> None:
    space = layout("live_link")
    values = np.random.default_rng(0).random((40, 61)).astype(np.float32) / 4
    take = tmp_path / f"take{suffix}"
    write_parameters(take, ParameterClip("take", values, space, 30.0))
    animation = facediff.read(take)
    assert (animation.frame_rate, len(animation.vertices)) == (30.0, 40)
    rig = built_in_rig()
    decoded = rig.decode(np.asarray(values[:, [space.index(name) for name in rig.names]]))
    np.testing.assert_allclose(animation.still().vertices, decoded, atol=1e-5)
    animation.save(tmp_path / "again.csv")
    again = read_parameters(tmp_path / "again.csv")
    columns = slice(61) if suffix == ".csv" else slice(52)
    np.testing.assert_allclose(again.values[:40, columns], values[:, columns], atol=1e-6)


def test_names_in_another_case_move_the_face_too(tmp_path: Path) -> None:
    frames = '[{"weights": [1, 0], "time": 0}, {"weights": [0, 0], "time": 0.1}]'
    for name in ("jawOpen", "JawOpen"):
        (tmp_path / f"{name}.json").write_text(f'{{"names": ["{name}", "mouthPucker"], "frames": {frames}}}')
    usual, other = (facediff.read(tmp_path / f"{name}.json") for name in ("jawOpen", "JawOpen"))
    assert np.ptp(usual.vertices, axis=0).max() > 0.01
    np.testing.assert_array_equal(other.vertices, usual.vertices)
    assert other.space.channels == ("jawOpen", "mouthPucker")


def test_an_excerpt_keeps_its_place_in_the_sound(tmp_path: Path) -> None:
    frames = '[{"weights": [0], "time": 0.5}, {"weights": [1], "time": 0.6}, {"weights": [0], "time": 0.7}]'
    (tmp_path / "a.json").write_text(f'{{"names": ["jawOpen"], "frames": {frames}}}')
    animation = facediff.read(tmp_path / "a.json")
    moved = np.abs(animation.vertices - animation.vertices[0]).max((1, 2))
    assert moved.argmax() / animation.frame_rate == pytest.approx(0.6)


def take_of(path: Path, frames: int = 30) -> ParameterClip:
    """Weights above 1, a head and eyes that turn."""
    space, rng, time = layout("live_link"), np.random.default_rng(3), np.arange(frames)[:, None] / 30
    values = np.abs(np.sin(time * rng.uniform(1, 9, 61))) * rng.uniform(0.0, 0.6, 61)
    values[:, space.index("jawOpen")] = 0.5 + 0.55 * np.sin(6 * time[:, 0])
    for turn in space.rotations:
        values[:, list(turn.channels)] = 0.3 * np.sin(time * rng.uniform(1, 9, 3))
    clip = ParameterClip("take", values.astype(np.float32), space, 30.0)
    write_parameters(path, clip)
    return clip


def test_a_glb_has_the_weights_under_their_names_and_the_turns_of_head_and_eyes(tmp_path: Path) -> None:
    clip = take_of(tmp_path / "take.csv")
    assert main(["export", str(tmp_path / "take.csv"), "-o", str(tmp_path / "take.npz")]) == 0
    for source in ("take.csv", "take.npz"):
        assert main(["export", str(tmp_path / source), "-o", str(tmp_path / "a.glb")]) == 0
        read, recorded = Reader(tmp_path / "a.glb"), facediff.read(tmp_path / "take.csv")
        names = read.gltf.meshes[0].extras["targetNames"]
        assert set(names) == set(ARKIT)
        written = read.weights[:30]
        kept = clip.values[:, [clip.space.index(name) for name in names]]
        np.testing.assert_allclose(written, kept, atol=1e-6)  # as the table's digits
        assert kept.max() > 1
        shapes = np.stack([read.values(target["POSITION"]) for target in read.primitive.targets])
        face = read.values(read.primitive.attributes.POSITION) + np.tensordot(written, shapes, 1)
        rig = built_in_rig()
        decoded = rig.decode(np.asarray(clip.values[:, [clip.space.index(name) for name in rig.names]]))
        np.testing.assert_allclose(face, decoded, atol=1e-6)
        nodes, motion = read.gltf.nodes, read.gltf.animations[0]
        curves = {
            (nodes[channel.target.node].name, channel.target.path): read.values(motion.samplers[channel.sampler].output)
            for channel in motion.channels
        }
        for turn in clip.space.rotations:
            made = Rotation.from_quat(curves[turn.joint, "rotation"][:30])
            euler = clip.values[:, list(turn.channels)]
            assert (made.inv() * Rotation.from_euler("YXZ", euler)).magnitude().max() < 1e-5
        head, shift = Rotation.from_quat(curves["head", "rotation"]), curves["head", "translation"]
        posed = np.stack([head[t].apply(face[t]) + shift[t] for t in (0, 11, 29)])
        np.testing.assert_allclose(posed, recorded.vertices[[0, 11, 29]], atol=1e-5)


def test_a_glb_of_vertices_that_are_not_the_sum_of_the_weights_is_exact(tmp_path: Path) -> None:
    take_of(tmp_path / "take.csv")
    recorded = facediff.read(tmp_path / "take.csv").still()
    wrong = recorded.made_of(recorded.space, np.asarray(recorded.values)[::-1].copy(), recorded.deltas)
    wrong.save(tmp_path / "a.glb")
    assert "jawOpen" not in Reader(tmp_path / "a.glb").gltf.meshes[0].extras["targetNames"]


def test_the_command_writes_the_weights_of_a_take_and_plays_it_on_an_avatars_own_rig(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip, take = take_of(tmp_path / "take.csv"), str(tmp_path / "take.csv")
    assert main(["export", take, "-o", str(tmp_path / "again.csv")]) == 0
    assert main(["export", take, "-o", str(tmp_path / "vowels.csv"), "--tracks", "vrm"]) == 0
    again = read_parameters(tmp_path / "again.csv")
    np.testing.assert_allclose(again.values[:30], clip.values, atol=1e-5)
    assert "Blink_L" in (tmp_path / "vowels.csv").read_text().splitlines()[0]
    rest, faces, shapes = small_shapes(F1)  # another head than the one that plays takes, of another topology
    avatar = Animation("avatar", rest[None].astype(np.float32), rest.astype(np.float32), 30.0, faces=faces)
    deltas = np.stack([shapes[name] - rest for name in layout("arkit").channels])
    avatar.made_of(layout("arkit"), np.zeros((1, 52), np.float32), deltas).save(tmp_path / "avatar.glb")
    words = ["retarget", take, "--target-mesh", str(tmp_path / "avatar.glb")]
    assert main([*words, "-o", str(tmp_path / "speaks.glb")]) == 0
    read = Reader(tmp_path / "speaks.glb")
    targets = read.gltf.meshes[0].extras["targetNames"]
    (motion,) = [motion for motion in read.gltf.animations if motion.name == "take"]
    played = read.values(motion.samplers[motion.channels[0].sampler].output).reshape(30, -1)
    wanted = clip.values[:, [clip.space.index(name) for name in targets]]
    np.testing.assert_allclose(played, np.clip(wanted, 0, 1), atol=1e-6)
    capsys.readouterr()
    assert main([*words, "--part", "Head", "-o", str(tmp_path / "x.glb")]) == 2
    assert "--part: has no effect without --carry" in capsys.readouterr().err
