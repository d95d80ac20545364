"""Constructor arguments as plain data and back, so that every checkpoint loads with ``weights_only=True``.

:func:`describe` and :func:`plain` write the arguments of a model, a component or a data module; :func:`read_options`
reads the options in a file, and lets nothing through but the plain values that the constructor's signature asks for.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import fields, replace
from enum import Enum
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from facediff.errors import FaceDiffError
from facediff.registry import COMPONENTS, alias_path
from facediff.utils import hints
from facediff.utils.hints import checks_arguments, defaults, is_path, options_of
from facediff.utils.limits import quoted

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options", bound="DataclassInstance")

Components = Mapping[str, Callable[[str], type | None]]
"""For each kind of component, what finds a class by its import path; None if it is not known."""


def plain(value: Any) -> Any:  # noqa: ANN401
    """Describe a constructor argument by numbers, strings, lists and dicts.

    A component class, or a ``functools.partial`` of one (the command line hands over such a partial too), becomes
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
    """The class that a factory makes an instance of."""
    if isinstance(factory, type):
        return factory
    if isinstance(factory, partial):
        for candidate in (factory.func, *factory.args):
            if isinstance(candidate, type):
                return candidate
    raise TypeError(f"{factory!r} is no component; give its class or functools.partial(class, option=value)")


def keeps_arguments(init: Callable[..., None]) -> Callable[..., None]:
    """Let a constructor pass its arguments to the object's ``keep_hyperparameters`` once it has run.

    Of the constructors that run on the way, only the one of the object's own class does so: a base class's constructor
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

    Options left at their defaults are included: code that rebuilds the component may fill missing options from the
    component that usually stands in its place.
    """
    description: dict[str, Any] = plain(factory)
    # Arguments that need no files such as those of a pretrained network.
    portable: dict[str, Any] = getattr(component, "checkpoint_init_args", dict)()
    description["init_args"] = plain({**defaults(component_class(factory)), **description["init_args"], **portable})
    return description


def read_options(source: str, owner: type, options: Mapping[str, Any], components: Components) -> dict[str, Any]:
    """The arguments of a constructor from the plain options in a file; a component as ``partial`` of its class."""
    parameters = options_of(owner)
    arguments: dict[str, Any] = {}
    for name, value in options.items():
        if name not in parameters:
            raise FaceDiffError(
                f"{source}: its {owner.__name__} has an option {quoted(name)} that this version does not know; it was "
                f"not loaded. Use the version of the package that wrote it"
            )
        if name in components:
            arguments[name] = read_component(source, name, value, components)
        elif hints.fits(hint := parameters[name].annotation, value, stored=True):
            arguments[name] = hints.convert(hint, value)
        else:
            raise FaceDiffError(
                f"{source}: its option {name} is {quoted(value)}; expected {hints.describe(hint)}; it was not loaded"
            )
    for name in getattr(owner, "checkpoint_options", ()):
        if options.get(name) is None:
            raise FaceDiffError(
                f"{source}: its {owner.__name__} does not state {name}, and would read other files instead; it was not "
                f"loaded. Expected a checkpoint that `facediff fit` has written"
            )
    return arguments


def read_component(source: str, name: str, value: object, components: Components) -> partial[Any] | None:
    """A component that a file states, of a known class with plain options; None where a model leaves it out."""
    if value is None:
        return None
    content = value if isinstance(value, dict) else {}
    options = content.get("init_args", {})
    if not isinstance(options, dict) or not {"class_path"} <= content.keys() <= {"class_path", "init_args"}:
        raise FaceDiffError(
            f"{source}: its {name} is {quoted(value)}; expected a component with its class and options; it was not "
            f"loaded"
        )
    component = components[name](content["class_path"]) if is_path(content["class_path"]) else None
    if component is None:
        raise unknown_class(source, name, content["class_path"])
    return partial(component, **read_options(source, component, options, components))


def unknown_class(source: object, role: str, path: object) -> FaceDiffError:
    """The error for a class that is neither registered nor imported."""
    text = quoted(path).strip("'\"")
    option = "--model" if role == "model" else f"--model.{role}" if role in COMPONENTS else ""
    advice = f", or add {option}={text} to `facediff test`, `validate` or `predict`" if option else ""
    return FaceDiffError(
        f'{source}: its {role} is "{text}", which is not known; it was not loaded. If you trust the file, install or '
        f"import the package that the {role} comes from{advice}"
    )


def takes_options(group: type) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a constructor take the fields of a dataclass as keyword arguments of its own.

    The constructor itself receives them as an instance of the dataclass, in front of its other options. Its signature
    and its docstring come from the fields, so that the command line, checkpoints and documentation show each option.

    """
    hints_by_name = hints.hints_of(group)

    def decorate(init: Callable[..., None]) -> Callable[..., None]:
        @wraps(init)
        def wrapped(self: Any, **arguments: Any) -> None:  # noqa: ANN401
            options = {name: arguments.pop(name) for name in hints_by_name.keys() & arguments.keys()}
            init(self, group(**options), **arguments)

        first, *_, common = inspect.signature(init).parameters.values()
        keyword = inspect.Parameter.KEYWORD_ONLY
        options = [
            inspect.Parameter(field.name, keyword, default=field.default, annotation=hints_by_name[field.name])
            for field in fields(group)
        ]
        wrapped.__signature__ = inspect.Signature([first, *options, common])  # type: ignore[attr-defined]
        wrapped.__annotations__ = dict(hints_by_name)
        wrapped.__doc__ = group.__doc__
        return wrapped

    return decorate


def with_classes(options: Options) -> Options:
    """A model's options with each component's class in place of its factory, for a model to keep.

    Factories of the command line hold the parser, and with it the trainer and its processes, which
    weight averaging would copy together with the model.
    """
    components = {field.name for field in fields(options)} & COMPONENTS.keys()
    return replace(options, **{name: component_class(getattr(options, name)) for name in components})
