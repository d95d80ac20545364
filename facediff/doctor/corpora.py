"""Which corpus a folder is: the data modules that are known, and how they are told apart."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from facediff.doctor.folder import Folder
from facediff.errors import FaceDiffError, choices

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule

    Module = type[SpeechMotionDataModule]

HALF = 0.5
"""Share of the names that a corpus must know to be recognised by them."""

FACEXHUBERT = re.compile(r"[FM]\d_(\d\d)(_cut)?")
"""BIWI's clips in FaceXHuBERT's preparation: NN for a neutral sequence, NN + 40 for an emotional one."""


def known() -> list[Module]:
    """Every data module that can be made, facediff's own first."""
    from facediff.data import SpeechMotionDataModule

    def below(module: Any) -> Iterator[Module]:  # noqa: ANN401 - an abstract class is no Module to mypy
        for child in module.__subclasses__():
            yield child
            yield from below(child)

    found = [m for m in dict.fromkeys(below(SpeechMotionDataModule)) if not inspect.isabstract(m) and named(m)]
    return sorted(found, key=lambda module: not module.__module__.startswith("facediff."))


def named(module: Module) -> str | None:
    """Name of the corpus that a data module reads; None if it does not say."""
    return getattr(module, "corpus_name", None)


def by_name(name: str, n_vertices: int | None) -> Module:
    """The data module of a corpus name (``biwi``), a class name (``Biwi``) or an import path (``package.Class``).

    Args:
        name: what was asked for.
        n_vertices: vertices found in the folder; decides between several modules of one corpus.

    Raises:
        FaceDiffError: naming the known corpora.
    """
    if "." in name:
        return _import(name)
    wanted = [m for m in known() if name.lower() in (str(named(m)).lower(), m.__name__.lower())]
    if not wanted:
        names = dict.fromkeys(str(named(module)) for module in known())
        raise FaceDiffError(
            f'--corpus: there is no "{name}": {choices(name, names)}; a data module of your own is given by its import '
            f"path, package.module.Class"
        )
    return next((module for module in wanted if module.n_vertices == n_vertices), wanted[0])


def _import(path: str) -> Module:
    from facediff.data import SpeechMotionDataModule

    place, _, name = path.rpartition(".")
    try:
        module = getattr(importlib.import_module(place), name)
    except Exception as error:  # a module can fail in any way while it is imported
        raise FaceDiffError(f"--corpus {path}: cannot be imported ({error}); expected package.module.Class") from error
    if not (isinstance(module, type) and issubclass(module, SpeechMotionDataModule)) or inspect.isabstract(module):
        raise FaceDiffError(f"--corpus {path}: is no data module; expected a subclass of SpeechMotionDataModule")
    return module


def recognise(folder: Folder, said: object, n_vertices: int | None) -> Module | None:
    """The data module that a folder is for; None if that cannot be told.

    What ``manifest.json`` says decides; else most of the clips' names together with the vertex count; else names of a
    form of their own (so that wrong vertices are told as such); else a vertex count that only one corpus has.

    Args:
        folder: the folder.
        said: the corpus that ``manifest.json`` names, if it does.
        n_vertices: vertices found in the folder.
    """
    modules = known()
    if isinstance(said, str):
        wanted = [m for m in modules if named(m) in (said, said.removeprefix("facediff-"))]
        if wanted:
            return next((module for module in wanted if module.n_vertices == n_vertices), wanted[0])
    fitting = [module for module in modules if module.n_vertices == n_vertices]
    best = _most_known(fitting, folder.names) or _most_known([m for m in modules if names_tell(m)], folder.names)
    if best is not None:
        return best
    if facexhubert_names(folder.names):
        return by_name("biwi", n_vertices)
    return fitting[0] if len({named(module) for module in fitting}) == 1 else None


def _most_known(modules: Sequence[Module], names: Sequence[str]) -> Module | None:
    scores = {module: sum(knows(module, name) for name in names) for module in modules}
    best = max(scores, key=lambda module: scores[module], default=None)
    return best if best is not None and scores[best] and scores[best] >= HALF * len(names) else None


def knows(module: Module, name: str) -> bool:
    """Whether a name is one of the corpus's, as far as its data module can tell without the folder."""
    clip = module.parse_name(name)
    return clip is not None and (names_tell(module) or clip.subject in module.identities)


def names_tell(module: Module) -> bool:
    """Whether a data module has a form of names of its own."""
    from facediff.data import SpeechMotionDataModule

    return module.parse_name.__func__ is not SpeechMotionDataModule.parse_name.__func__  # type: ignore[attr-defined]


def facexhubert_names(names: Sequence[str]) -> list[str]:
    """The names in FaceXHuBERT's manner, if numbers above 40, which stand for emotional sequences, are among them."""
    found = {name: int(match[1]) for name in names if (match := FACEXHUBERT.fullmatch(name))}
    return list(found) if any(number > 40 for number in found.values()) else []


def variants(module: Module) -> list[str | None]:
    """The ways in which a data module can be told to split its clips; a single None if there is one way only."""
    parameter = inspect.signature(module).parameters.get("split")
    hint: Any = None if parameter is None else get_type_hints(module.__init__).get("split")
    return list(get_args(hint)) if get_origin(hint) is Literal else [None]
