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
import sys
import threading
import types
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass
from enum import Enum
from functools import cache, partial, wraps
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from facediff.errors import ArgumentError, FaceDiffError, choices
from facediff.utils.ranges import mismatch

T = TypeVar("T", bound=type)
_loading = threading.RLock()  # one for all kinds: what one of them loads may ask for another


class RegistrationError(FaceDiffError):
    """A name that is malformed or taken was to be registered."""


class UnknownComponentError(FaceDiffError, AttributeError):
    """Nothing of a kind has the name that was asked for."""


@dataclass(frozen=True)
class Entry:
    """One registered class.

    Attributes:
        name: what chooses it.
        implementation: the class.
    """

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
    """The components of one kind, by name.

    Args:
        name: what the kind is called.
        modules: import paths of the modules that register the built-in ones, separated by spaces.
        title: what an entry of this kind does, in a few words.
        component: whether models are made of it; its options are then checked as those of the model.
    """

    def __init__(self, name: str, modules: str, title: str, *, component: bool = False) -> None:
        self.kind = name
        self.title = title
        self._component = component
        self._modules = modules.split()
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
        malformed = not name.isidentifier() or keyword.iskeyword(name) or name.startswith("_")
        malformed = malformed or (self._component and name != name.lower())
        if malformed or name in dir(self):
            raise RegistrationError(
                f'{self.kind} name "{name}" cannot be registered: use a lower snake case identifier that is none '
                f"of the registry's own words"
            )
        if not isinstance(implementation, type):
            raise RegistrationError(f'{self.kind} "{name}" is {implementation!r:.80}, which is no class')
        owner = f"{implementation.__module__}.{implementation.__qualname__}"
        taken = self._entries.get(name)
        if taken is not None and taken.owner != owner:
            raise RegistrationError(
                f'{self.kind} name "{name}" is wanted by {owner} but belongs to {taken.owner}: rename one of them'
            )
        if self._component and "__init__" in vars(implementation) and taken is None:
            own: Any = implementation
            own.__init__ = checks_arguments(own.__init__, f"model.{self.kind}", sizes="model")
        self._entries[name] = Entry(name, implementation)

    def load(self) -> None:
        """Import the built-in components and the installed plug-ins, once; another thread waits for them."""
        with _loading:
            if self._loaded:
                return
            self._loaded = True
            for module in self._modules:
                importlib.import_module(module)
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
        """The class registered under ``name``, which may be the registered path.

        Raises:
            UnknownComponentError: naming the nearest and all known names.
        """
        self.load()
        name = name.removeprefix(f"{__name__}.{self.kind}.")
        if name not in self._entries:
            raise UnknownComponentError(self.unknown(name))
        return self._entries[name].implementation

    def read(self, text: str, hidden: Set[str] = frozenset()) -> tuple[str, dict[str, Any]]:
        """The name and the options of ``NAME:option=value,option=value``; a value is of the kind of its default.

        Args:
            text: as typed.
            hidden: options that cannot be chosen this way.

        Raises:
            UnknownComponentError: if nothing has the name; the message names the nearest.
            FaceDiffError: if there is no such option, or its value is of another kind.
        """
        text = text.replace(" ", "")
        name, _, rest = text.partition(":")
        parts = (word.partition("=") for word in filter(None, rest.split(",")))
        pairs = [(option, value) for option, _, value in parts]
        return name, self.options(name, pairs, f"{self.kind} {text}", hidden)

    def options(
        self, name: str, pairs: Sequence[tuple[str, str]], shown: str, hidden: Set[str] = frozenset()
    ) -> dict[str, Any]:
        """The options of a component as its constructor takes them; a value is of the kind of its default.

        Args:
            name: of the component.
            pairs: options and their values, as typed.
            shown: what errors call the whole.
            hidden: options that cannot be chosen this way.

        Raises:
            UnknownComponentError: if nothing has the name; the message names the nearest.
            FaceDiffError: if there is no such option, or its value is of another kind.
        """
        defaults_by_name = {
            option: parameter.default
            for option, parameter in inspect.signature(self.get(name)).parameters.items()
            if parameter.default is not inspect.Parameter.empty and option not in hidden
        }
        options = {}
        for option, value in pairs:
            if option not in defaults_by_name:
                offered = choices(option, defaults_by_name) if defaults_by_name else "it has none"
                raise FaceDiffError(f"{shown}: {name} has no option {option!r}: {offered}")
            if not value:
                raise FaceDiffError(f"{shown}: option {option} has no value; write {option}=VALUE")
            try:
                options[option] = _value(value, defaults_by_name[option])
            except ValueError as error:
                raise FaceDiffError(f"{shown}: option {option} is {value!r}; expected {error}") from error
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


def _value(text: str, default: object) -> object:
    """A word as a value of the kind of the option's default; a ValueError says what kind was expected."""
    if isinstance(default, bool):
        if text.lower() not in ("true", "false"):
            raise ValueError("true or false")
        return text.lower() == "true"
    if isinstance(default, str):
        return text
    kind = int if isinstance(default, int) else float
    try:
        value = kind(text)
        if not -1e12 < value < 1e12:  # not NaN either
            raise ValueError
        return value
    except ValueError:
        if default is None:
            return None if text.lower() == "none" else text
        raise ValueError("a whole number" if kind is int else "a number") from None


audio_encoder = Kind(
    "audio_encoder",
    "facediff.models.audio_encoders facediff.models.speech_networks facediff.models.deepspeech",
    "speech to one feature per frame",
)
identity_encoder = Kind("identity_encoder", "facediff.models.speaker_encoders", "a speaker's label to a vector")
motion_space = Kind("motion_space", "facediff.models.motion_space", "the numbers of a frame that are noised")
mesh_encoder = Kind("mesh_encoder", "facediff.models.mesh_encoders", "a mesh's motion to one feature per frame")
style_encoder = Kind("style_encoder", "facediff.models.speaker_encoders", "a reference motion to its speaking style")
fusion = Kind("fusion", "facediff.models.fusions", "speech features meet the noisy motion")
decoder = Kind("decoder", "facediff.models.decoders", "fused features and style to clean motion")
sampler = Kind("sampler", "facediff.models.samplers", "runs the reverse diffusion process")
model = Kind(
    "model",
    "facediff.models.dual_path "
    "facediff.models.style_content "
    "facediff.models.published.artalk "
    "facediff.models.published.codetalker facediff.models.published.codetalker_checkpoints "
    "facediff.models.published.diffposetalk facediff.models.published.diffposetalk_checkpoints "
    "facediff.models.published.diffspeaker "
    "facediff.models.published.emotalk "
    "facediff.models.published.facediffuser "
    "facediff.models.published.faceformer "
    "facediff.models.published.lam "
    "facediff.models.published.selftalk "
    "facediff.models.published.talkingstyle "
    "facediff.models.published.unitalker facediff.models.published.unitalker_checkpoints "
    "facediff.models.published.voca",
    "a method, as a LightningModule",
)
corpus = Kind(
    "corpus",
    "facediff.data.puppet facediff.data.biwi facediff.data.vocaset facediff.data.mead3d facediff.data.parametric",
    "a data set, as a LightningDataModule",
)
metric = Kind("metric", "facediff.metrics", "a score of predicted motion, as a torchmetrics class")
render_metric = Kind(
    "render_metric",
    "facediff.evaluation.renders",
    "a score of rendered frames and speech by networks of one's own",
)
augmentation = Kind("augmentation", "facediff.data.augmentation", "a change of training speech")
voice_gate = Kind("voice_gate", "facediff.speech.voice_activity", "finds the pauses of speech")
acting = Kind("acting", "facediff.editing.acting", "moves brows, head and lids with the speech")
export_format = Kind(
    "export_format",
    "facediff.export.arrays facediff.export.glb facediff.export.sequences facediff.export.usd facediff.export.video "
    "facediff.export.viewer.page",
    "a file format that animations are written in",
)
puppet_voice = Kind(
    "puppet_voice",
    "facediff.synthetic.recordings facediff.synthetic.voices",
    "speaks the sentences of the built-in corpus",
)
receiver = Kind(
    "receiver",
    "facediff.live.receivers",
    "where frames of a live performance go, by the scheme of an address",
)

COMPONENTS: dict[str, Kind] = {
    kind.kind: kind
    for kind in (
        motion_space,
        audio_encoder,
        identity_encoder,
        mesh_encoder,
        style_encoder,
        fusion,
        decoder,
        sampler,
    )
}
"""The kinds of which models are made; a model's option of the kind's name chooses one."""

KINDS: dict[str, Kind] = {
    **COMPONENTS,
    **{
        kind.kind: kind
        for kind in (
            model,
            corpus,
            metric,
            render_metric,
            augmentation,
            voice_gate,
            acting,
            puppet_voice,
            export_format,
            receiver,
        )
    },
}
"""Everything that can be chosen by name."""


def alias_path(component: type) -> str:
    """Import path to store for a component class: its registered path if it has one, else its own.

    Args:
        component: a class.
    """
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

    Args:
        content: of a config, or of a file of one component alone; a name that stands for components of two kinds is
            replaced only where the key says which.

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
    """The class of an import path, if it is registered or its module is imported already; else None.

    Args:
        kind: where it may be registered; its entries are imported first, so that a plug-in is found.
        path: the import path.
        base: what the class must be a subclass of.
    """
    from facediff.utils.plain_options import is_path  # the metrics alone need the registry, and no more of utils

    if not isinstance(path, str) or not is_path(path):
        return None
    module, _, name = path.rpartition(".")
    if module == f"facediff.registry.{kind.kind}":
        return kind.get(name) if name in kind.names() else None
    kind.load()
    # The module must be imported already: importing what a file names would run code that the file chose.
    # Not getattr, which may make a lazily loaded package import the module that the file asks for.
    place = sys.modules.get(module)
    implementation = vars(place).get(name) if isinstance(place, types.ModuleType) else None
    if not isinstance(implementation, type):
        return None
    return (
        implementation
        if issubclass(implementation, base) or implementation in [entry.implementation for entry in kind]
        else None
    )


# Constructor arguments are checked where they enter: against their type, and against the range that it states.


def checks_arguments(init: Callable[..., None], path: str = "", *, sizes: str = "") -> Callable[..., None]:
    """Let a constructor refuse values that do not fit the types and ranges of its signature.

    Whatever else it raises because of a value is reported in the same way: as one sentence that names the arguments
    as the user wrote them.

    Args:
        init: the constructor; its numbers state their ranges as ``Annotated[int, Range(...)]``.
        path: what comes before the argument's name in an option; the object's ``options_path``, or else its class's
            name, if empty.
        sizes: the same for arguments without a default, which are options of the owner.
    """

    @cache
    def hints() -> dict[str, Any]:
        try:
            return typing.get_type_hints(init, include_extras=True)
        except (NameError, TypeError):  # a third party's, with names that only a type checker sees
            return {}

    @cache
    def parameters() -> Mapping[str, inspect.Parameter]:
        return inspect.signature(init).parameters

    @wraps(init)
    def wrapped(self: Any, *values: Any, **options: Any) -> None:  # noqa: ANN401
        own = path or getattr(self, "options_path", "") or type(self).__name__

        def located(name: str) -> str:
            given_by_owner = name not in parameters() or parameters()[name].default is inspect.Parameter.empty
            return f"{sizes if sizes and given_by_owner else own}.{name}"

        arguments = inspect.signature(init).bind_partial(self, *values, **options).arguments
        arguments = {name: value for name, value in arguments.items() if name in hints()}
        for name, value in arguments.items():
            expected = mismatch(hints()[name], value)
            if expected is not None:
                raise ArgumentError({located(name): value}, f"expected {expected}", located=True)
        try:
            init(self, *values, **options)
        except ArgumentError as error:
            raise error if error.located else error.at(located) from error.__cause__
        except (ValueError, RuntimeError, ArithmeticError, MemoryError) as error:
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            named = {located(name): value for name, value in arguments.items() if isinstance(value, int | float | str)}
            raise ArgumentError(
                named or {own: type(self).__name__}, f"{type(self).__name__} cannot be made ({reason})", located=True
            ) from error

    return wrapped


# Constructor arguments as plain data, so that a checkpoint loads with ``weights_only=True`` however it was made.


def plain(value: Any) -> Any:  # noqa: ANN401
    """Describe a constructor argument by numbers, strings, lists and dicts.

    A component class, or a ``functools.partial`` of one (which is also what the command line hands over), becomes
    Lightning's form ``{"class_path": …, "init_args": {…}}``.

    Raises:
        TypeError: if the value has no plain description; the message says which forms have one.
    """
    if isinstance(value, Enum):  # before the numbers and strings, which members of some enumerations are too
        return plain(value.value)
    if value is None:
        return None
    for kind in (bool, int, float, str):
        if isinstance(value, kind):  # a subclass such as numpy.float64 would not load again with weights_only=True
            return kind(value)
    if isinstance(value, type):
        return {"class_path": alias_path(value), "init_args": {}}
    if isinstance(value, partial):
        return {"class_path": alias_path(component_class(value)), "init_args": plain(value.keywords)}
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "items"):  # mappings, and OmegaConf's and jsonargparse's own
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Sequence | Set) and not isinstance(value, bytes | bytearray | memoryview):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    raise TypeError(
        f"a {type(value).__name__} cannot be kept in a checkpoint; give a component as its class or as "
        f"functools.partial(class, option=value), and everything else as numbers, strings, lists and dicts"
    )


def component_class(factory: Any) -> type:  # noqa: ANN401
    """The class that a factory makes an instance of.

    Args:
        factory: a class, a ``functools.partial`` of one, or jsonargparse's partial, which holds the class among its
            arguments.
    """
    if isinstance(factory, type):
        return factory
    if isinstance(factory, partial):
        for candidate in (factory.func, *factory.args):
            if isinstance(candidate, type):
                return candidate
    raise TypeError(f"{factory!r} is no component; give its class or functools.partial(class, option=value)")


def defaults(component: type) -> dict[str, Any]:
    """A class's options with their defaults; sizes that a model gives it have none and are left out.

    A constructor that takes ``**options`` hands them to its base class, whose options count too.
    """
    options: dict[str, Any] = {}
    for cls in component.__mro__:
        if "__init__" in vars(cls):
            parameters = inspect.signature(vars(cls)["__init__"]).parameters.values()
            options = {p.name: p.default for p in parameters if p.default is not p.empty} | options
            if all(p.kind is not p.VAR_KEYWORD for p in parameters):
                break
    return options


def keeps_arguments(init: Callable[..., None]) -> Callable[..., None]:
    """Let a constructor pass its arguments to the object's ``keep_hyperparameters`` once it has run.

    Of the constructors that run on the way, only that of the object's own class does so: a base class's constructor
    sees only some of the arguments. Each of them checks those that it names.
    """
    checked = checks_arguments(init)

    @wraps(init)
    def wrapped(self: Any, *values: Any, **options: Any) -> None:  # noqa: ANN401
        checked(self, *values, **options)
        if type(self).__init__ is wrapped:
            bound = inspect.signature(init).bind_partial(self, *values).arguments
            bound.pop("self", None)
            self.keep_hyperparameters({**bound, **options})

    return wrapped


def describe(factory: Any, component: object) -> dict[str, Any]:  # noqa: ANN401
    """A component's plain description for the checkpoint, with every option that it was made with.

    Options left at their defaults are included: whoever rebuilds the component may fill what is missing from the
    component that usually stands in its place.

    Args:
        factory: the component's class, or a ``functools.partial`` of it.
        component: what the factory made. It may have a method ``checkpoint_init_args`` that returns constructor
            arguments with which it can be built without the files that it was first built from (a pretrained network).
    """
    description: dict[str, Any] = plain(factory)
    portable: dict[str, Any] = getattr(component, "checkpoint_init_args", dict)()
    description["init_args"] = plain({**defaults(component_class(factory)), **description["init_args"], **portable})
    return description
