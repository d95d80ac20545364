"""The FLAME layer against figures found by hand and a slow computation written out from the papers; its model files."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.errors import FaceDiffError
from facediff.mesh.flame import CHUNK, Flame, FlameArrays, read_flame_arrays, rotations
from tests.fakes.flame import (
    chumpy_array,
    chumpy_reordered,
    compressed,
    flame_arrays,
    foreign,
    model_pickle,
    write_flame,
)

RNG = np.random.default_rng(3)


def by_definition(
    content: dict[str, np.ndarray],
    shape: np.ndarray,
    expression: np.ndarray,
    jaw: np.ndarray,
    head: np.ndarray | None = None,
) -> np.ndarray:
    """One frame (V, 3), vertex by vertex, with 4 × 4 transforms of all five joints (SMPL, eqs. 1 to 10)."""
    coefficients = np.zeros(400)
    coefficients[: len(shape)] = shape
    coefficients[300 : 300 + len(expression)] = expression
    count = len(content["v_template"])
    shaped = np.zeros((count, 3))
    for v in range(count):
        for axis in range(3):
            terms = [content["shapedirs"][v, axis, n] * coefficients[n] for n in range(400)]
            shaped[v, axis] = content["v_template"][v, axis] + sum(terms)
    joints = content["J_regressor"] @ shaped
    pose = np.zeros((5, 3))
    pose[2] = jaw
    pose[0] = 0 if head is None else head
    turns = [turn_by_definition(vector) for vector in pose]
    feature = np.concatenate([(turn - np.eye(3)).ravel() for turn in turns[1:]])
    posed = shaped + content["posedirs"] @ feature
    parents = [-1, *content["kintree_table"][0, 1:].astype(int)]
    chain: list[np.ndarray] = []
    for k, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = turns[k]
        local[:3, 3] = joints[k] - (joints[parent] if parent >= 0 else 0)
        chain.append(local if parent < 0 else chain[parent] @ local)
    result = np.zeros((count, 3))
    for v in range(count):
        for k in range(5):
            rest = np.eye(4)
            rest[:3, 3] = -joints[k]
            result[v] += content["weights"][v, k] * (chain[k] @ rest @ np.append(posed[v], 1))[:3]
    return result


def turn_by_definition(vector: np.ndarray) -> np.ndarray:
    """The matrix exponential of the cross product's matrix, as a power series."""
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    term, total = np.eye(3), np.eye(3)
    for n in range(1, 60):
        term = term @ cross / n
        total = total + term
    return total


def layer(content: dict[str, np.ndarray]) -> Flame:
    parents = np.array([-1, *content["kintree_table"][0, 1:].astype(int)])
    names = ("v_template", "shapedirs", "posedirs", "J_regressor", None, "weights", "f")
    return Flame(FlameArrays(*(parents if name is None else content[name] for name in names)))


def tiny_rig(**changes: np.ndarray) -> dict[str, np.ndarray]:
    """Six vertices. Vertex 0 is the jaw's joint, 1 to 4 hang on the jaw wholly, half, a quarter and not at all."""
    template = np.array([[0, 1, 0], [0, 1, 2], [0, 1, 2], [0, 1, 2], [0, 1, 2], [5, 5, 5]], float)
    jaw = np.array([0, 1, 0.5, 0.25, 0, 0])
    weights = np.zeros((6, 5))
    weights[:, 2], weights[:, 1] = jaw, 1 - jaw
    regressor = np.zeros((5, 6))
    regressor[[0, 1, 3, 4], 5] = regressor[2, 0] = 1
    return {
        "v_template": template,
        "shapedirs": np.zeros((6, 3, 400)),
        "posedirs": np.zeros((6, 3, 36)),
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]]),
        "weights": weights,
        "f": np.array([[0, 1, 2], [3, 4, 5]]),
        **changes,
    }


QUARTER = np.array([[np.pi / 2, 0, 0]])
NOTHING = np.zeros((1, 0))


def test_what_hangs_on_the_jaw_turns_with_it() -> None:
    content = tiny_rig(kintree_table=np.array([[2**32 - 1, 0, 1, 2, 3], [0, 1, 2, 3, 4]]))
    content["weights"][4] = [0, 0, 0, 0, 1]  # a joint whose parent's parent is the jaw
    opened = layer(content).vertices(np.zeros(0), NOTHING, QUARTER)[0]
    np.testing.assert_allclose(opened[4], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(opened, by_definition(content, np.zeros(0), np.zeros(0), QUARTER[0]), atol=1e-12)


def test_any_parameters_agree_with_the_definition() -> None:
    content = flame_arrays(16)
    shape, jaw = RNG.normal(0, 2, 300), RNG.normal(0, 0.7, (3, 3))
    expression = RNG.normal(0, 2, (3, 100))
    for head in (None, RNG.normal(0, 0.7, (3, 3))):
        found = layer(content).vertices(shape, expression, jaw, head=head)
        assert found.dtype == np.float64
        for frame, face in enumerate(found):
            turn = None if head is None else head[frame]
            expected = by_definition(content, shape, expression[frame], jaw[frame], turn)
            np.testing.assert_allclose(face, expected, atol=1e-13)


def test_a_long_clip_is_the_same_frame_by_frame() -> None:
    """Frames are computed in chunks; a frame must not depend on the others."""
    model = layer(flame_arrays(16))
    frames = 2 * CHUNK + 3
    shape, expression, jaw = RNG.normal(size=40), RNG.normal(size=(frames, 50)), RNG.normal(size=(frames, 3))
    together = model.vertices(shape, expression, jaw)
    alone = [model.vertices(shape, expression[t : t + 1], jaw[t : t + 1])[0] for t in range(frames)]
    np.testing.assert_allclose(together, alone, atol=1e-14)
    assert model.vertices(shape, expression[:0], jaw[:0]).shape == (0, 16, 3)


def test_tiny_rotations_are_exact() -> None:
    np.testing.assert_array_equal(rotations(np.zeros((1, 3)))[0], np.eye(3))
    (turn,) = rotations(np.array([[0, 0, 1e-9]]))
    np.testing.assert_allclose(turn - np.eye(3), [[0, -1e-9, 0], [1e-9, 0, 0], [0, 0, 0]], atol=1e-17)


@pytest.mark.parametrize("form", ["2020", "2023", "npz"])
def test_model_files_are_read(form: str, tmp_path: Path) -> None:
    path = write_flame(tmp_path / f"model.{'npz' if form == 'npz' else 'pkl'}", form=form, seed=5)  # type: ignore[arg-type]
    expected = flame_arrays(seed=5)
    arrays = read_flame_arrays(path)
    np.testing.assert_array_equal(arrays.directions, expected["shapedirs"])
    np.testing.assert_array_equal(arrays.pose_directions, expected["posedirs"])
    np.testing.assert_array_equal(arrays.joint_regressor, expected["J_regressor"])
    np.testing.assert_array_equal(arrays.weights, expected["weights"])
    np.testing.assert_array_equal(arrays.parents, [-1, 0, 1, 1, 1])
    parameters = RNG.normal(size=300), RNG.normal(size=(2, 100)), RNG.normal(size=(2, 3))
    tensors = {"flame_model": {name: torch.from_numpy(value.astype(float)) for name, value in expected.items()}}
    torch.save({**tensors, "lmk_embeddings": {}}, tmp_path / "FLAME_with_eye.pt")
    np.testing.assert_array_equal(read_flame_arrays(tmp_path / "FLAME_with_eye.pt").parents, arrays.parents)
    np.testing.assert_allclose(
        Flame.read(path).vertices(*parameters), layer(expected).vertices(*parameters), atol=1e-14
    )


@pytest.mark.parametrize("module", ["scipy.sparse.csc", "scipy.sparse._csc", "scipy.sparse.csr", "scipy.sparse._csr"])
@pytest.mark.parametrize("protocol", [0, 1, 2, 4])
def test_sparse_matrices_of_any_release_and_protocol(module: str, protocol: int, tmp_path: Path) -> None:
    dense = flame_arrays()["J_regressor"]
    kind = f"{module[-3:]}_{'array' if '_' in module else 'matrix'}"
    stored = {**flame_arrays(), "J_regressor": compressed(dense, module, kind)}
    (tmp_path / "m.pkl").write_bytes(model_pickle(stored, python=3, protocol=protocol))
    np.testing.assert_array_equal(read_flame_arrays(tmp_path / "m.pkl").joint_regressor, dense)


def test_chumpy_objects_that_reorder(tmp_path: Path) -> None:
    """A selection of the columns of a longer basis, reshaped; weights that were turned round."""
    content = flame_arrays()
    longer = np.concatenate([content["shapedirs"], RNG.normal(size=(80, 3, 5))], axis=2)
    chosen = np.arange(longer.size).reshape(longer.shape)[:, :, :400]
    select = chumpy_reordered(
        "Select", chumpy_array(longer), idxs=chosen.ravel(), preferred_shape=np.array([80, 3, 400])
    )
    flat = chumpy_array(content["posedirs"].reshape(-1))
    stored = {
        **content,
        "shapedirs": select,
        "posedirs": chumpy_reordered("Reshape", flat, newshape=(80, 3, 36)),
        "weights": chumpy_reordered("transpose", chumpy_array(content["weights"].T), axes=None),
    }
    (tmp_path / "m.pkl").write_bytes(model_pickle(stored))
    arrays = read_flame_arrays(tmp_path / "m.pkl")
    np.testing.assert_array_equal(arrays.directions, content["shapedirs"])
    np.testing.assert_array_equal(arrays.pose_directions, content["posedirs"])
    np.testing.assert_array_equal(arrays.weights, content["weights"])


def self_containing() -> object:
    made = chumpy_array(np.zeros(1))
    made.__dict__["x"] = made
    return made


BAD = flame_arrays()
COUNT = len(BAD["weights"])
REGRESSOR = "scipy.sparse.csc", "csc_matrix"
SPARSE = {"_shape": (5, COUNT), "data": np.ones(1), "indices": np.zeros(1, np.int64)}


@pytest.mark.parametrize(
    "change",
    [
        {"weights": None},
        {"v_template": BAD["v_template"].ravel()},
        {"shapedirs": BAD["shapedirs"][..., :100]},
        {"J_regressor": compressed(BAD["J_regressor"].T)},
        {"J_regressor": foreign(*REGRESSOR, {**SPARSE, "indptr": np.array([0, 3])})},
        {"J_regressor": foreign("scipy.sparse.bsr", "bsr_matrix", {})},
        {"kintree_table": np.array([[-1, 0, 3, 1, 1], [0, 1, 2, 3, 4]])},
        {"weights": np.ones((COUNT, 5))},
        {"weights": np.full((COUNT, 5), np.nan)},
        {"f": np.array([[0, 1, COUNT]])},
        {"v_template": foreign("chumpy.ch_ops", "add", {"a": 1, "b": 2})},
        {"v_template": self_containing()},
    ],
)
def test_what_is_no_model_is_refused(change: dict[str, object], tmp_path: Path) -> None:
    content = {key: value for key, value in {**BAD, **change}.items() if value is not None}
    (tmp_path / "m.pkl").write_bytes(model_pickle(content))
    with pytest.raises(FaceDiffError, match=r"m\.pkl"):
        Flame.read(tmp_path / "m.pkl")


class Bomb:
    """Makes a folder when unpickled by Python's own unpickler."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.mark),)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_hostile_model_is_refused_and_does_not_run(protocol: int, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    hostile = pickle.dumps({**flame_arrays(8), "weights": Bomb(mark)}, protocol)
    (tmp_path / "m.pkl").write_bytes(hostile)
    with pytest.raises(FaceDiffError, match=r"m\.pkl: not a pickle of plain NumPy arrays: it asks for posix\.mkdir"):
        Flame.read(tmp_path / "m.pkl")
    assert not mark.exists()
    pickle.loads(hostile)  # noqa: S301 - it would have run
    assert mark.exists()
