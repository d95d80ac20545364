"""What the API reference reads from the code, where griffe alone reads less than is there."""

from __future__ import annotations

import builtins
import importlib
import importlib.util
import inspect
import re
import sys
from typing import Any

import griffe
from mkdocs.plugins import get_plugin_logger

log = get_plugin_logger("facediff")

ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc|obj):`~?([^`]+)`")
NAME = re.compile(r"(?<![`\w:.])`([A-Za-z_]\w*(?:\.\w+)*)`(?!`)")
EXAMPLE = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)


class Docstrings(griffe.Extension):
    """Cross-references, examples, and functions that exist only when the code runs.

    Docstrings name other objects as ``:func:`align```, which becomes a link where the reference has the object, and as
    code otherwise. ``Example:`` is the section that griffe calls ``Examples:``. The functional form of a metric is made
    from its class by `facediff.metrics.functional`, with a signature and a docstring that no source text shows.
    """

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:  # noqa: ANN401
        """A metric's function is shown as a function."""
        if not str(attr.value or "").startswith("functional("):
            return
        made = getattr(importlib.import_module(attr.module.path), attr.name)
        function = griffe.Function(
            attr.name,
            lineno=attr.lineno,
            endlineno=attr.endlineno,
            parameters=griffe.Parameters(*map(parameter, inspect.signature(made).parameters.values())),
            returns="Tensor",
            docstring=griffe.Docstring(inspect.getdoc(made) or "", lineno=attr.lineno),
            parent=attr.parent,
        )
        function.docstring.parent = function
        attr.parent.set_member(attr.name, function)

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:  # noqa: ANN401
        """Docstrings as griffe and Markdown understand them, once all names are known."""
        waiting: list[griffe.Object] = [pkg]
        while waiting:
            obj = waiting.pop()
            waiting += [member for member in obj.members.values() if isinstance(member, griffe.Object)]
            if isinstance(obj, griffe.Function):
                unpack(obj)
            if obj.docstring:
                obj.docstring.value = plain(obj)


def parameter(given: inspect.Parameter) -> griffe.Parameter:
    """A parameter of a function that was imported, as griffe keeps one of a function that was read."""
    annotation = given.annotation if isinstance(given.annotation, str) else inspect.formatannotation(given.annotation)
    return griffe.Parameter(
        given.name,
        annotation=None if given.annotation is given.empty else annotation,
        kind=griffe.ParameterKind(given.kind.description),
        default=None if given.default is given.empty else repr(given.default),
    )


def unpack(function: griffe.Function) -> None:
    """Writes ``**options: Unpack[Options]`` out, unless the docstring describes the options under that name."""
    owner = function.parent if function.name == "__init__" else function
    described = owner.docstring.value if owner is not None and owner.docstring else ""
    for packed in list(function.parameters):
        name = re.fullmatch(r"Unpack\[(\w+)\]", str(packed.annotation))
        path = named(function, name[1]) if name and f"**{packed.name}:" not in described else None
        if path is None:
            continue
        options = function.package[path.removeprefix("facediff.")]
        del function.parameters[packed.name]
        if function.docstring:  # what it says of the parameter as a whole describes none that is shown
            line = re.compile(rf"^ +{packed.name}: .*(?:\n|\Z)(?: {{8,}}.*(?:\n|\Z))*", re.MULTILINE)
            function.docstring.value = line.sub("", function.docstring.value)
        for option in options.all_members.values():
            if option.is_attribute and option.name not in function.parameters:
                function.parameters.add(
                    griffe.Parameter(
                        option.name,
                        annotation=option.annotation,
                        kind=griffe.ParameterKind.keyword_only,
                        default="...",  # it may be omitted; the docstring says what holds then
                    )
                )


def plain(obj: griffe.Object) -> str:
    """An object's docstring with links instead of roles, and its example as a section."""
    text = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
    text = EXAMPLE.sub(r"```pycon\n\g<0>\n```", text)  # outside sections, where griffe takes it for a quotation
    text = re.sub(r"::(\n\n    )", r":\1", text)

    def link(role: re.Match[str]) -> str:
        target = named(obj, role[1])
        if target is None and (hasattr(builtins, role[1]) or is_elsewhere(obj, role[1])):
            return f"`{role[1]}`"
        if target is None:
            log.warning("%s: its docstring refers to %s, which does not exist", obj.path, role[1])
            return f"`{role[1]}`"
        # Not everything has a page: only what has one becomes a link.
        return f'<autoref identifier="{target}" optional>`{role[1]}`</autoref>'

    def link_if_there(name: re.Match[str]) -> str:
        target = named(obj, name[1])
        return f'<autoref identifier="{target}" optional>`{name[1]}`</autoref>' if target else name[0]

    return ROLE.sub(link, NAME.sub(link_if_there, text))


def is_elsewhere(obj: griffe.Object, name: str) -> bool:
    """Whether a name is of another package, or inherited from one, which griffe does not read."""
    first = name.split(".")[0]
    if first in sys.stdlib_module_names or ("." in name and importlib.util.find_spec(first) is not None):
        return True
    try:
        module = importlib.import_module(obj.module.path)
    except ImportError:  # of an extra that is not installed: what cannot be imported cannot be checked
        return True
    return any(hasattr(member, name) for member in vars(module).values() if inspect.isclass(member))


def named(obj: griffe.Object, name: str) -> str | None:
    """The full path of what a docstring refers to, seen from the object, what it belongs to, or the package."""
    owner: griffe.Object | None = obj
    while owner is not None:
        found: griffe.Object | griffe.Alias | None = owner
        try:
            for part in name.removeprefix("facediff.").split(".") if owner is obj.package else name.split("."):
                found = found.all_members.get(part) if found is not None else None
        except griffe.AliasResolutionError:  # a module of another package that is imported there
            found = None
        if found is not None:
            try:
                return found.canonical_path
            except griffe.AliasResolutionError:  # in a module that griffe has not read yet
                return found.target_path if isinstance(found, griffe.Alias) else None
        owner = owner.parent
    return None
