"""Everything that can be chosen by name: components, models, corpora, metrics and export formats.

Each *kind* (``decoder``, ``model``, ``metric`` …) is an object of this module. A component is registered under a lower
snake case name and is an attribute of its kind: ``facediff.registry.decoder.gru`` is a path that configs and
checkpoints can store and that survives moving files. Models and corpora are registered under their class names.

Third parties add an entry of any kind by installing a package with an entry point in the group ``facediff.<kind>``::

    [project.entry-points."facediff.decoder"]
    my_decoder = "my_package.my_module:MyDecoder"

This module needs no library but the standard one.
"""

from __future__ import annotations

import importlib
import inspect
import keyword
import pkgutil
import sys
import threading
import types
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, TypeVar

from facediff.errors import FaceDiffError, choices, import_failure
from facediff.utils import hints

T = TypeVar("T", bound=type)
_loading = threading.RLock()  # one for all kinds: what one of them loads may ask for another


class RegistrationError(FaceDiffError):
    """A name that is malformed or taken was to be registered."""


class UnknownComponentError(FaceDiffError, AttributeError):
    """Nothing of a kind has the name that was asked for."""


@dataclass(frozen=True)
class Entry:
    """One registered class."""

    name: str
    implementation: type

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
    """The components of one kind, by name."""

    def __init__(self, name: str, modules: str, title: str, *, component: bool = False) -> None:
        self.kind = name
        self.title = title
        self.component = component  # of models, whose options are checked as options of the model
        self._modules = modules.split()  # which register the built-in ones; of a package all with .* behind it
        self._entries: dict[str, Entry] = {}
        self._loaded = False

    def register(self, name: str) -> Callable[[T], T]:
        """Class decorator that registers a component under ``name``, which no other class of its kind may have."""

        def decorate(implementation: T) -> T:
            self._add(name, implementation)
            return implementation

        return decorate

    def _add(self, name: str, implementation: type) -> None:
        """Register ``implementation`` under ``name``; see :meth:`register`."""
        malformed = not name.isidentifier() or keyword.iskeyword(name) or name.startswith("_")
        malformed = malformed or (self.component and name != name.lower())
        if malformed or name in dir(self):
            raise RegistrationError(
                f'{self.kind} name "{name}" cannot be registered: use a lower snake case identifier that is no '
                f"attribute of the registry"
            )
        if not isinstance(implementation, type):
            raise RegistrationError(f'{self.kind} "{name}" is {implementation!r:.80}, which is no class')
        entry, present = Entry(name, implementation), self._entries.get(name)
        if present is not None and present.owner != entry.owner:
            raise RegistrationError(
                f'{self.kind} name "{name}" is wanted by {entry.owner} but belongs to {present.owner}: rename one'
            )
        if self.component and "__init__" in vars(implementation) and present is None:
            component: Any = implementation
            component.__init__ = hints.checks_arguments(component.__init__, f"model.{self.kind}", sizes="model")
        self._entries[name] = entry

    def load(self) -> None:
        """Import the built-in components and the installed plug-ins, once; another thread waits for them."""
        with _loading:
            if self._loaded:
                return
            self._loaded = True
            for module in self._modules:
                package = importlib.import_module(module.removesuffix(".*"))
                for part in pkgutil.iter_modules(package.__path__) if module.endswith(".*") else ():
                    importlib.import_module(f"{package.__name__}.{part.name}")
            for point in entry_points(group=f"facediff.{self.kind}"):
                try:
                    self._add(point.name, point.load())
                except Exception as error:  # noqa: BLE001 - whatever a plug-in raises must not take facediff down
                    source = point.dist.name if point.dist is not None else point.value
                    warnings.warn(
                        f'the {self.kind} "{point.name}" of the installed package "{source}" was left out: '
                        f"{import_failure(error)}",
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
        """The class registered under ``name``, which may be the registered path.

        Raises:
            UnknownComponentError: naming the nearest and all known names.
        """
        self.load()
        name = name.removeprefix(f"{__name__}.{self.kind}.")
        if name not in self._entries:
            raise UnknownComponentError(self.unknown(name))
        return self._entries[name].implementation

    def read(self, text: str) -> tuple[str, dict[str, Any]]:
        """The name and the options of ``NAME:option=value,option=value``; see :meth:`options`."""
        text = text.replace(" ", "")
        name, _, rest = text.partition(":")
        parts = (word.partition("=") for word in filter(None, rest.split(",")))
        pairs = [(option, value) for option, _, value in parts]
        return name, self.options(name, pairs, f"{self.kind} {text}")

    def options(self, name: str, pairs: Sequence[tuple[str, str]], source: str) -> dict[str, Any]:
        """The options of a component as its constructor takes them."""
        component = self.get(name)
        parameters = {name: p for name, p in hints.options_of(component).items() if p.default is not p.empty}
        options = {}
        for option, value in pairs:
            if option not in parameters:
                offered = choices(option, parameters) if parameters else "it has none"
                raise FaceDiffError(f"{source}: {name} has no option {option!r}: {offered}")
            hint, default = parameters[option].annotation, parameters[option].default
            try:
                options[option] = hints.read(type(default) if hint is Any and default is not None else hint, value)
            except ValueError as error:
                raise FaceDiffError(f"{source}: option {option} is {value!r}; expected {error}") from error
        return options

    def unknown(self, name: str) -> str:
        """The sentence for a name that does not exist: the nearest one, then all."""
        return f'there is no {self.kind} "{name}": {choices(name, self.names())}'

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        """Make ``facediff.registry.<kind>.<name>`` importable."""
        if name.startswith("_"):
            raise AttributeError(name)
        return self.get(name)

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over the components, sorted by name."""
        return iter(self.entries())


motion_space = Kind(
    "motion_space", "facediff.models.motion_space", "the numbers of a frame that are noised", component=True
)
audio_encoder = Kind(
    "audio_encoder",
    "facediff.models.audio_encoders facediff.models.bundled_encoder facediff.models.speech_networks "
    "facediff.models.deepspeech",
    "speech to one feature per frame",
    component=True,
)
identity_encoder = Kind(
    "identity_encoder", "facediff.models.speaker_encoders", "a speaker's label to a vector", component=True
)
mesh_encoder = Kind(
    "mesh_encoder", "facediff.models.mesh_encoders", "a mesh's motion to one feature per frame", component=True
)
style_encoder = Kind(
    "style_encoder", "facediff.models.speaker_encoders", "a reference motion to its speaking style", component=True
)
fusion = Kind("fusion", "facediff.models.fusions", "speech features meet the noisy motion", component=True)
decoder = Kind("decoder", "facediff.models.decoders", "fused features and style to clean motion", component=True)
sampler = Kind("sampler", "facediff.models.samplers", "runs the reverse diffusion process", component=True)
model = Kind(
    "model",
    "facediff.models.dual_path facediff.models.style_content facediff.models.published.*",
    "a method, as a LightningModule",
)
corpus = Kind(
    "corpus",
    "facediff.data.puppet facediff.data.biwi facediff.data.vocaset facediff.data.mead3d facediff.data.parametric "
    "facediff.data.people",
    "a data set, as a LightningDataModule",
)
metric = Kind("metric", "facediff.metrics", "a score of predicted motion, as a torchmetrics class")
augmentation = Kind("augmentation", "facediff.data.augmentation", "a change of training speech")
voice_gate = Kind("voice_gate", "facediff.speech.voice_activity", "finds the pauses of speech")
acting = Kind("acting", "facediff.editing.acting", "moves brows, head and lids with the speech")
puppet_voice = Kind(
    "puppet_voice",
    "facediff.synthetic.recordings facediff.synthetic.voices",
    "speaks the sentences of the built-in corpus",
)
export_format = Kind(
    "export_format",
    "facediff.export.arrays facediff.export.glb facediff.export.sequences facediff.export.usd facediff.export.video "
    "facediff.export.viewer.page",
    "a file format that animations are written in",
)
receiver = Kind(
    "receiver",
    "facediff.live.receivers",
    "where frames of a live performance go, by the scheme of an address",
)

KINDS: dict[str, Kind] = {name: kind for name, kind in vars().copy().items() if isinstance(kind, Kind)}
"""Everything that can be chosen by name."""

COMPONENTS: dict[str, Kind] = {name: kind for name, kind in KINDS.items() if kind.component}
"""The kinds of which models are made; a model's option of the kind's name chooses one."""


def alias_path(component: type) -> str:
    """Import path to store for a component class: its registered path if it has one, else its own."""
    for kind in COMPONENTS.values():
        for entry in kind._entries.values():  # noqa: SLF001 - same module; loading everything is not wanted here
            if component is entry.implementation:
                return f"{__name__}.{kind.kind}.{entry.name}"
    return f"{component.__module__}.{component.__qualname__}"


def name_of(component: type) -> str:
    """The registered name of a component class, such as ``ddim``; of any other class its own name."""
    return alias_path(component).rpartition(".")[2]


def with_paths(content: Any) -> Any:  # noqa: ANN401
    """A config's content with the registered paths in place of the names of components.

    Example:
        >>> with_paths({"class_path": "gru", "init_args": {"num_layers": 1}})
        {'class_path': 'facediff.registry.decoder.gru', 'init_args': {'num_layers': 1}}
    """

    def path(name: object, *kinds: Kind) -> object:
        paths = [f"{__name__}.{kind.kind}.{name}" for kind in kinds if isinstance(name, str) and name in kind.names()]
        return paths[0] if len(paths) == 1 else name

    if isinstance(content, list):
        return [with_paths(item) for item in content]
    if not isinstance(content, dict):
        return content
    changed = {}
    for key, value in content.items():
        if key == "trainer":  # callbacks take names
            changed[key] = value
        elif key == "class_path":
            changed[key] = path(value, *COMPONENTS.values())
        elif key in COMPONENTS and isinstance(value, dict) and "class_path" in value:
            changed[key] = with_paths({**value, "class_path": path(value["class_path"], COMPONENTS[key])})
        else:
            changed[key] = path(value, COMPONENTS[key]) if key in COMPONENTS else with_paths(value)
    return changed


def find_class(kind: Kind, path: object, base: type) -> Any:  # noqa: ANN401 - a class that is a subclass of ``base``
    """The class of an import path, if it is registered or its module is imported already; else None."""
    if not isinstance(path, str) or not hints.is_path(path):
        return None
    module, _, name = path.rpartition(".")
    if module == f"facediff.registry.{kind.kind}":
        return kind.get(name) if name in kind.names() else None
    kind.load()
    # The module must be imported already: importing a module that a file names would run code of the file's choice.
    # Not getattr, which may make a lazily loaded package import the module that the file asks for.
    imported = sys.modules.get(module)
    implementation = vars(imported).get(name) if isinstance(imported, types.ModuleType) else None
    if not isinstance(implementation, type):
        return None
    accepted = issubclass(implementation, base) or implementation in [entry.implementation for entry in kind]
    return implementation if accepted else None
