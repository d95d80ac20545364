"""A FLAME model file in miniature: the same keys, types and classes as the real ones, with a made-up head."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tests.fakes.biwi import faces_of
from tests.fakes.vocaset import Python2Pickler, template_of

VERTICES = 80
"""A multiple of eight: the mesh is a grid with eight columns."""
PARENTS = np.array([2**32 - 1, 0, 1, 1, 1], np.uint32)


def flame_arrays(vertices: int = VERTICES, seed: int = 0) -> dict[str, np.ndarray]:
    """Plain arrays under the keys of a model file. The lower half of the face hangs on the jaw, more and more so."""
    rng = np.random.default_rng(seed)
    template = template_of("FaceTalk_000000_00000_TA", vertices)
    height = np.arange(vertices) / vertices
    jaw = np.where(height > 0.5, np.minimum(1.0, 4 * (height - 0.5)), 0.0)
    eyes = np.where(height < 0.1, 0.5, 0.0)
    weights = np.stack([0 * jaw, (1 - jaw) * (1 - 2 * eyes), jaw, eyes * (1 - jaw), eyes * (1 - jaw)], 1)
    regressor = np.zeros((5, vertices))
    for joint, row in enumerate(regressor):
        row[rng.choice(vertices, 4, replace=False)] = 0.1 + 0.6 * (np.arange(4) == joint % 4)
    regressor /= regressor.sum(1, keepdims=True)
    return {
        "v_template": template,
        "shapedirs": rng.normal(0, 1e-3, (vertices, 3, 400)),
        "posedirs": rng.normal(0, 1e-3, (vertices, 3, 36)),
        "J_regressor": regressor,
        "kintree_table": np.stack([PARENTS, np.arange(5, dtype=np.uint32)]),
        "weights": weights,
        "f": faces_of(vertices).astype(np.uint32),
    }


def foreign(module: str, name: str, state: dict[str, Any]) -> object:
    """An object whose pickle asks for ``module.name`` and gives it a state; no such module is there."""
    made: object = type(name, (), {"__module__": module})()
    made.__dict__.update(state)
    return made


def chumpy_array(value: np.ndarray) -> object:
    """A chumpy ``Ch`` with the attributes that it keeps in a pickle."""
    own = {"x": value, "_dirty_vars": {"x"}, "_itr": None, "_depends_on_deps": {}}
    return foreign("chumpy.ch", "Ch", own | {"_make_dense": False, "_make_sparse": False})


def chumpy_reordered(name: str, inner: object, **terms: object) -> object:
    """A chumpy object that reorders another, e.g. ``Select``."""
    return foreign("chumpy.reordering", name, {"a": inner, **terms, "_dirty_vars": set(), "_itr": None})


def compressed(dense: np.ndarray, module: str = "scipy.sparse.csc", name: str = "csc_matrix") -> object:
    """SciPy's sparse matrix of a dense one; ``module`` is where the release that wrote the file has its class."""
    by_column = name.startswith("csc")
    table = dense.T if by_column else dense
    major, minor = np.nonzero(table)
    ends = np.concatenate([[0], np.cumsum(np.count_nonzero(table, axis=1))]).astype(np.int32)
    state = {"_shape": dense.shape, "maxprint": 50, "data": table[major, minor]}
    return foreign(module, name, {**state, "indices": minor.astype(np.int32), "indptr": ends})


class ForeignPickler(pickle._Pickler):
    """Writes the names of classes that are not there to be imported."""

    def save_global(self, obj: type, name: str | None = None) -> None:
        if obj.__module__.startswith(("chumpy.", "scipy.")):
            self.write(pickle.GLOBAL + f"{obj.__module__}\n{obj.__name__}\n".encode())
            self.memoize(obj)
        else:
            super().save_global(obj, name)


class OldForeignPickler(Python2Pickler):
    """The same as Python 2 wrote it, whose built-in classes had another place."""

    def save_global(self, obj: type, name: str | None = None) -> None:
        if obj.__module__ == "builtins":
            self.write(pickle.GLOBAL + f"__builtin__\n{name or obj.__name__}\n".encode())
            self.memoize(obj)
        else:
            super().save_global(obj, name)


def model_pickle(content: object, *, python: Literal[2, 3] = 2, protocol: int = 2) -> bytes:
    """A model file's bytes, as Python 2 or 3 would have written them where chumpy and SciPy are there."""
    stream = io.BytesIO()
    (OldForeignPickler if python == 2 else ForeignPickler)(stream, protocol=protocol).dump(content)
    return stream.getvalue()


def write_flame(
    path: Path,
    *,
    vertices: int = VERTICES,
    form: Literal["2020", "2023", "npz"] = "2020",
    seed: int = 0,
) -> Path:
    """Write a model file.

    ``2020`` is a pickle of Python 2 with chumpy's and SciPy's objects, as FLAME 2020's ``generic_model.pkl``; ``2023``
    is one of Python 3 with NumPy arrays and SciPy's matrix; ``npz`` is an archive with plain arrays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = flame_arrays(vertices, seed)
    if form == "npz":
        np.savez(path, **content)
        return path
    extras = {"bs_style": "lbs", "bs_type": "lrotmin", "J": content["J_regressor"] @ content["v_template"]}
    if form == "2020":
        chumpy = {key: chumpy_array(content[key]) for key in ("v_template", "shapedirs", "posedirs", "weights")}
        content |= {**chumpy, "J_regressor": compressed(content["J_regressor"]), **extras}
        path.write_bytes(model_pickle(content))
    else:
        content |= {"J_regressor": compressed(content["J_regressor"], "scipy.sparse._csc"), **extras}
        path.write_bytes(model_pickle(content, python=3, protocol=4))
    return path
