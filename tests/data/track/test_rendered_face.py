"""The tracker on the rendered built-in face, whose motion is known; needs Google's model ($FACEDIFF_FACE_MODEL)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import ArrayLike

import facediff
from facediff.data import Puppet
from facediff.data.track.corpus import track_people
from facediff.data.track.face import pair_distances
from facediff.data.track.model import read_face_model
from facediff.data.track.options import VARIABLE, TrackingOptions
from facediff.data.track.topology import EYELID_PAIRS, LIP_PAIRS, without_webs
from facediff.data.track.tracker import FaceTracker
from facediff.editing.landmarks import puppet_landmarks
from facediff.export import ExportOptions
from facediff.export.video import drawn_frames
from facediff.render import Camera, Renderer, portrait, write_video
from facediff.spaces.rotations import convert, matrices
from facediff.speech.audio import read_speech
from facediff.synthetic import corpus as puppet
from facediff.utils.files import example_recordings

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"needs the model of a face in {VARIABLE}"),
]
CLIPS = ("F1_t01", "F2_t05", "F3_t07", "F5_t06", "M1_t01", "M2_t03", "M4_t01")
Pair = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Puppet:
    root = tmp_path_factory.mktemp("truth") / "corpus"
    puppet.generate(root, only=CLIPS, workers=1, progress=False)
    return Puppet(root=str(root))


def opening(faces: np.ndarray, pairs: ArrayLike) -> np.ndarray:
    """How far the lips are apart in height (T,): their depth is what pictures show least."""
    upper, lower = np.asarray(pairs).T
    return np.asarray(np.abs(faces[:, upper, 1] - faces[:, lower, 1]).mean(axis=1))


def head_angles(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Yaw and pitch in degrees."""
    times = np.arange(frames) / 25
    return 12 * np.sin(2 * np.pi * 0.35 * times), 5 * np.sin(2 * np.pi * 0.5 * times)


def measure(truth: Puppet, folder: Path, size: int) -> dict[str, list[Pair]]:
    """What is true and what was tracked, by quantity, of each clip."""
    assets, corpus = truth.assets(), truth.corpus
    faces, colours = assets.faces, corpus.read_colours()
    assert faces is not None
    videos = {}
    for name in CLIPS:
        clip = corpus.clips[name]
        template = corpus.template(clip).numpy().astype(np.float64)
        motion = corpus.read_motion(clip).numpy() + template
        yaw, pitch = np.radians(head_angles(len(motion)))
        turns = matrices(convert(np.stack([yaw, pitch, 0 * yaw], axis=1), "euler", "quaternion"))
        centre = template.mean(axis=0)
        moved = (motion - centre) @ turns.swapaxes(1, 2) + centre
        regions = {region: vertices.numpy() for region, vertices in assets.regions.items()}
        camera = Camera.framing(portrait(template, regions))
        renderer = Renderer(faces.numpy(), template=template, size=size, camera=camera, colours=colours[clip.identity])
        path = folder / f"{name.replace('_', '-')}.mp4"
        write_video(path, map(renderer.render, moved), 25, read_speech(truth.root / "wav" / f"{name}.wav"), 16_000)
        videos[path.stem] = [path]
    track_people(videos, folder / "people", TrackingOptions(), workers=1)
    marks = puppet_landmarks()
    lips = torch.as_tensor(assets.inner_lip_pairs).numpy()
    lids = torch.as_tensor(truth.eyelid_pairs()).numpy()
    pairs: dict[str, list[Pair]] = {}
    for name in CLIPS:
        clip = corpus.clips[name]
        actual = 1000 * (corpus.read_motion(clip) + corpus.template(clip)).numpy()
        person = name.replace("_", "-")
        tracked = 1000 * np.load(folder / "people" / "vertices_npy" / f"{person}_s001.npy").reshape(-1, 468, 3)
        count = min(len(actual), len(tracked))
        actual, tracked = actual[:count], tracked[:count]
        head = np.load(folder / "people" / "head_npy" / f"{person}_s001.npy")[:count]
        yaw, pitch = head_angles(count)
        width = [(marks["mouth_corner_left"], marks["mouth_corner_right"])]
        for quantity, one, other in (
            ("gap", opening(actual, lips), opening(tracked, LIP_PAIRS)),
            ("width", pair_distances(actual, width), pair_distances(tracked, [(291, 61)])),
            ("lids", pair_distances(actual, lids), pair_distances(tracked, EYELID_PAIRS)),
            ("jaw", actual[:, marks["chin"], 1], tracked[:, 152, 1]),
            ("yaw", yaw, head[:, 1]),
            ("pitch", pitch, head[:, 0]),
        ):
            pairs.setdefault(quantity, []).append((one, other))
    return pairs


def correlation(pairs: list[Pair], lag: int = 0) -> float:
    """Mean correlation over clips, with the tracked motion so many frames later."""
    scores = []
    for one, other in pairs:
        a, b = one[max(0, -lag) : len(one) - max(0, lag)], other[max(0, lag) : len(other) - max(0, -lag)]
        scores.append(np.corrcoef(a, b)[0, 1])
    return float(np.mean(scores))


def area_under_curve(pairs: list[Pair]) -> float:
    """How well the tracked gap tells closed lips (less than 1 mm) from open ones."""
    true, tracked = (np.concatenate(column) for column in zip(*pairs, strict=True))
    closed = true < 1
    return float((tracked[closed][:, None] < tracked[~closed][None]).mean())


def test_lips_lids_jaw_and_head_are_those_of_the_face(truth: Puppet, tmp_path: Path) -> None:
    pairs = measure(truth, tmp_path, 384)
    true, tracked = (np.concatenate(column) for column in zip(*pairs["gap"], strict=True))
    shut = tracked[true < 1]
    assert correlation(pairs["gap"]) >= 0.88
    assert np.abs(true - tracked).mean() <= 1.2
    assert area_under_curve(pairs["gap"]) >= 0.9
    assert np.median(shut) <= 0.7
    assert np.quantile(shut, 0.95) <= 1.3
    assert max(range(-2, 3), key=lambda lag: correlation(pairs["gap"], lag)) == 0
    for quantity, limit in {"width": 0.75, "lids": 0.7, "jaw": 0.55, "yaw": 0.99, "pitch": 0.95}.items():
        assert correlation(pairs[quantity]) >= limit, quantity


def test_a_small_picture_still_shows_closures(truth: Puppet, tmp_path: Path) -> None:
    pairs = measure(truth, tmp_path, 160)
    assert correlation(pairs["gap"]) >= 0.7
    assert area_under_curve(pairs["gap"]) >= 0.8


def test_bars_turns_and_neighbours_do_not_move_the_landmarks() -> None:
    model = read_face_model(Path(os.environ[VARIABLE]))
    spoken = facediff.load("puppet").animate(example_recordings()[0], seed=0)
    (picture,) = drawn_frames([spoken.part([40])], ExportOptions(size=384))
    found = [
        FaceTracker(model, face).landmarks(np.ascontiguousarray(seen))
        for face, seen in (
            ("1", picture),
            ("1", np.pad(picture, ((80, 80), (0, 0), (0, 0)))),
            ("2", np.concatenate([picture, picture], axis=1)),
            ("1", np.rot90(picture)),
        )
    ]
    points, barred, second, turned = (result[0][:, :2] for result in found if result is not None)
    upright = np.stack([383 - turned[:, 1], turned[:, 0]], axis=1)
    errors = [np.linalg.norm(seen - points, axis=1).mean() for seen in (barred - (0, 80), second - (384, 0), upright)]
    assert max(errors) < 1, errors  # pixels of a face of 170


def test_mouth_and_eyes_are_open() -> None:
    triangles = without_webs(read_face_model(Path(os.environ[VARIABLE])).triangles)
    assert len(triangles) == 852
    edges, counts = np.unique(
        np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)), axis=0, return_counts=True
    )
    rims = trimesh.graph.connected_components(edges[counts == 1], min_len=3)
    assert len(rims) == 4  # of the mask, the mouth and the eyes
