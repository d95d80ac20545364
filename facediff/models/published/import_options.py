"""What a user says of a checkpoint of a published method; the command line and Python take it from here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from facediff.errors import OptionError
from facediff.utils.option import Option


@dataclass(frozen=True)
class ImportOptions:
    """What no checkpoint of a published method holds.

    Attributes:
        dataset: what it was trained on, where the number of vertices does not say it
        identities: training identities in the order of the training command; by default the data set's usual ones
        templates: neutral faces by speaker (templates.pkl); in Python also arrays (V, 3) or (3V,) by name
        regions: folder with lve.txt and fdd.txt, the vertices of lips and upper face
        mesh: the data set's mesh, for triangles, so that faces can be drawn
        audio_config: config.json of an audio encoder of unusual size; in Python also its content
        option: an option of the model or its audio encoder that no file holds, such as num_heads=4; may be repeated;
            ignore=PREFIX leaves out the tensors whose names begin so
        model_options: the same options by name, in Python
    """

    dataset: Literal["vocaset", "biwi", "multiface"] | None = None
    identities: Annotated[Sequence[str] | None, Option(metavar="A,B,…")] = None
    templates: Annotated[Path | Mapping[str, Any] | None, Option(metavar="FILE", reads=True)] = None
    regions: Annotated[Path | None, Option(metavar="FOLDER", reads=True)] = None
    mesh: Annotated[Path | None, Option(metavar="FILE", reads=True)] = None
    audio_config: Annotated[Path | Mapping[str, Any] | None, Option(metavar="FILE", reads=True)] = None
    option: Annotated[list[str] | None, Option(metavar="NAME=VALUE")] = None
    model_options: Annotated[Mapping[str, Any], Option(hidden=True)] = field(default_factory=dict)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> ImportOptions:
        """Keyword arguments of a Python function; those that are no field are options of the model."""
        own = {name for name in cls.__dataclass_fields__ if name not in ("option", "model_options")}
        chosen = {name: value for name, value in options.items() if name in own}
        return cls(**chosen, model_options={name: value for name, value in options.items() if name not in own})

    def all_model_options(self) -> dict[str, Any]:
        """Options of the model and its audio encoder by name; ``ignore`` is a list where it is repeated.

        Raises:
            FaceDiffError: if an option has no name or no value.
        """
        options = dict(self.model_options)
        for text in self.option or []:
            name, equals, value = text.partition("=")
            if not equals or not name:
                raise OptionError.naming(f"{{option}} {text}: expected a name and a value, such as num_heads=4")
            options[name] = [*options.get(name, []), value] if name == "ignore" else value
        return options
