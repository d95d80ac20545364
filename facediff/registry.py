"""Names for the replaceable parts of a system: the one place where a word becomes a class.

Each *kind* (``decoder``, ``fusion`` …) is an object of this module; each registered name is an importable class
below it. ``facediff.registry.decoder.gru`` is therefore a path that configs and checkpoints can store and that
survives moving files, and ``--model.decoder=gru`` works on the command line because the path ends in the name.

Third parties add a component by installing a package with an entry point in the group ``facediff.<kind>``::

    [project.entry-points."facediff.decoder"]
    my_decoder = "my_package.my_module:MyDecoder"

This module depends on the standard library only.
"""

from __future__ import annotations

import importlib
import inspect
import keyword
import pkgutil
import types
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, TypeVar

from facediff.errors import FaceDiffError, choices

T = TypeVar("T", bound=type)


class RegistrationError(FaceDiffError):
    """A component was registered under a name that is malformed or taken."""


class UnknownComponentError(FaceDiffError, AttributeError):
    """A name was asked for that no component of the kind has."""


@dataclass(frozen=True)
class Entry:
    """One registered component.

    Attributes:
        name: the word that chooses it.
        implementation: the class as written by its author.
        alias: the empty subclass importable as ``facediff.registry.<kind>.<name>``.
    """

    name: str
    implementation: type
    alias: type

    @property
    def owner(self) -> str:
        """Import path of the implementation."""
        return f"{self.implementation.__module__}.{self.implementation.__qualname__}"

    @property
    def summary(self) -> str:
        """First line of the implementation's docstring."""
        lines = (inspect.getdoc(self.implementation) or "").splitlines()
        return lines[0] if lines else ""


class Kind:
    """The components of one kind, by name.

    Args:
        name: the word for the kind.
        package: import path of the package whose modules register the built-in components.
        title: what a component of this kind does, in a few words.
    """

    def __init__(self, name: str, package: str, title: str) -> None:
        self.kind = name
        self.title = title
        self._package = package
        self._entries: dict[str, Entry] = {}
        self._loaded = False

    def register(self, name: str) -> Callable[[T], T]:
        """Class decorator that registers a component under ``name``.

        Raises:
            RegistrationError: if the name is not a lower-snake-case identifier, is reserved, or is taken by
                another class; the message names both owners.
        """

        def decorate(implementation: T) -> T:
            self._add(name, implementation)
            return implementation

        return decorate

    def _add(self, name: str, implementation: type) -> None:
        """Register ``implementation`` under ``name``; see :meth:`register`."""
        malformed = not name.isidentifier() or keyword.iskeyword(name) or name != name.lower() or name.startswith("_")
        if malformed or name in dir(self):
            raise RegistrationError(
                f'{self.kind} name "{name}" cannot be registered: use a lower snake case identifier that is none '
                f"of the registry's own words"
            )
        owner = f"{implementation.__module__}.{implementation.__qualname__}"
        taken = self._entries.get(name)
        if taken is not None and taken.owner != owner:
            raise RegistrationError(
                f'{self.kind} name "{name}" is wanted by {owner} but belongs to {taken.owner}: rename one of them'
            )
        self._entries[name] = Entry(name, implementation, self._make_alias(name, implementation))

    def _make_alias(self, name: str, implementation: type) -> type:
        """Make the empty subclass whose import path ends in the registered name."""

        def body(namespace: dict[str, Any]) -> None:
            namespace.update(__module__=__name__, __qualname__=f"{self.kind}.{name}", __doc__=implementation.__doc__)

        return types.new_class(name, (implementation,), exec_body=body)

    def load(self) -> None:
        """Import the built-in components and the installed plug-ins, once."""
        if self._loaded:
            return
        self._loaded = True
        package = importlib.import_module(self._package)
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"{self._package}.{module.name}")
        for point in entry_points(group=f"facediff.{self.kind}"):
            try:
                self._add(point.name, point.load())
            except Exception as error:  # noqa: BLE001 - whatever a plug-in raises must not take facediff down
                source = point.dist.name if point.dist is not None else point.value
                warnings.warn(
                    f'the {self.kind} "{point.name}" of the installed package "{source}" was left out: '
                    f"{type(error).__name__}: {error}",
                    stacklevel=2,
                )

    def names(self) -> list[str]:
        """All registered names, sorted."""
        self.load()
        return sorted(self._entries)

    def entries(self) -> list[Entry]:
        """All registered components, sorted by name."""
        return [self._entries[name] for name in self.names()]

    def get(self, name: str) -> Any:  # noqa: ANN401 - the kinds' base classes are not known here
        """The class registered under ``name``.

        Raises:
            UnknownComponentError: naming the nearest and all known names.
        """
        self.load()
        if name not in self._entries:
            raise UnknownComponentError(self.unknown(name))
        return self._entries[name].alias

    def unknown(self, name: str) -> str:
        """The sentence for a name that does not exist: the nearest one, then all."""
        return f'there is no {self.kind} "{name}": {choices(name, self.names())}'

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        """Make ``facediff.registry.<kind>.<name>`` importable and picklable."""
        if name.startswith("_"):
            raise AttributeError(name)
        return self.get(name)

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over the components, sorted by name."""
        return iter(self.entries())


audio_encoder = Kind("audio_encoder", "facediff.components.audio_encoder", "speech to one feature per frame")
identity_encoder = Kind("identity_encoder", "facediff.components.identity_encoder", "who the face is, from a label")
mesh_encoder = Kind("mesh_encoder", "facediff.components.mesh_encoder", "a mesh's motion to one feature per frame")
style_encoder = Kind(
    "style_encoder", "facediff.components.style_encoder", "how the person moves, from a reference motion"
)
fusion = Kind("fusion", "facediff.components.fusion", "speech features meet the noisy motion")
decoder = Kind("decoder", "facediff.components.decoder", "fused features and style to clean motion")
sampler = Kind("sampler", "facediff.diffusion.samplers", "runs the reverse diffusion process")

KINDS: dict[str, Kind] = {
    kind.kind: kind for kind in (audio_encoder, identity_encoder, mesh_encoder, style_encoder, fusion, decoder, sampler)
}


def alias_path(component: type) -> str:
    """Import path to store for a component class: its registered path if it has one, else its own.

    Args:
        component: a registered alias, an implementation that is registered, or any other class.
    """
    for kind in KINDS.values():
        for entry in kind._entries.values():  # noqa: SLF001 - same module; loading everything is not wanted here
            if component in (entry.implementation, entry.alias):
                return f"{__name__}.{kind.kind}.{entry.name}"
    return f"{component.__module__}.{component.__qualname__}"
