"""The options of an import of a published method's checkpoint; the command line and Python take them from here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from facediff.errors import OptionError
from facediff.utils.option import Option
from facediff.utils.plain_files import load_json
from facediff.utils.ranges import Range

ALIASES = {"encoder_config": "audio_config", "num_attention_heads": "num_heads", "heads": "num_heads"}
"""Names of a file of hyper-parameters that stand for an option of another name."""

HPARAMS: dict[str, type] = {
    "dataset": str,
    "identities": list,
    "audio_config": dict,
    "data_root": str,
    "template_row": int,
}
"""Options that such a file may hold, and their types; others are left to the checkpoint."""

MODEL_HPARAMS = ("do_normalize", "epsilon", "num_heads", "codec_heads", "style_heads")
"""Options of models and audio encoders that such a file may hold."""


@dataclass(frozen=True)
class ImportOptions:
    """Facts that no checkpoint of a published method holds.

    Attributes:
        dataset: the data set, where the number of vertices does not tell it; of UniTalker the data set whose
            faces are animated, D3 (ARKit's weights) by default
        identities: training identities in the order of the training command; by default the data set's usual ones
        templates: neutral faces by speaker (templates.pkl), of DiffPoseTalk a speaker's shape (.npy, or an .npz with
            shape); in Python also arrays by name, (V, 3) or (3V,), or (S,) of shapes
        regions: folder with lve.txt and fdd.txt, the vertices of lips and upper face
        mesh: the data set's mesh, for triangles, so that faces can be drawn; of a method in FLAME's parameters the
            FLAME model, generic_model.pkl or ARTalk's FLAME_with_eye.pt
        audio_config: config.json of an audio encoder of unusual size; in Python also its content
        statistics: means and deviations of DiffPoseTalk's training motion (stats_train.npz), without which nothing has
            a scale; in Python also the arrays by name
        data_root: folder of UniTalker's data release, with principal components and neutral faces
        template_row: neutral face of that release, by default the published demo's
        hparams: JSON file with facts that the checkpoint lacks: any of these options by name, audio_config (or
            encoder_config) as an object, options of the model; in Python also its content
        option: an option of the model or its audio encoder that no file holds, such as num_heads=4; may be repeated;
            ignore=PREFIX leaves out the tensors with this prefix
        model_options: the same options by name, in Python
    """

    dataset: Literal["vocaset", "biwi", "multiface", "D0", "D1", "D2", "D3", "D4", "D5", "D6", "D7"] | None = None
    identities: Annotated[Sequence[str] | None, Option(metavar="A,B,…")] = None
    templates: Annotated[Path | Mapping[str, Any] | None, Option(metavar="FILE", reads=True)] = None
    regions: Annotated[Path | None, Option(metavar="FOLDER", reads=True)] = None
    mesh: Annotated[Path | None, Option(metavar="FILE", reads=True)] = None
    audio_config: Annotated[Path | Mapping[str, Any] | None, Option(metavar="FILE", reads=True)] = None
    statistics: Annotated[Path | Mapping[str, Any] | None, Option(metavar="FILE", reads=True)] = None
    data_root: Annotated[Path | None, Option(metavar="FOLDER", reads=True)] = None
    template_row: Annotated[int | None, Option(metavar="N"), Range(0, 100_000)] = None
    hparams: Annotated[Path | Mapping[str, Any] | None, Option(metavar="FILE", reads=True)] = None
    option: Annotated[list[str] | None, Option(metavar="NAME=VALUE")] = None
    model_options: Annotated[Mapping[str, Any], Option(hidden=True)] = field(default_factory=dict)

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> ImportOptions:
        """Keyword arguments of a Python function; those that are no field are options of the model."""
        fields = {name for name in cls.__dataclass_fields__ if name not in ("option", "model_options")}
        import_options = {name: value for name, value in options.items() if name in fields}
        return cls(
            **import_options, model_options={name: value for name, value in options.items() if name not in fields}
        )

    def with_hparams(self) -> tuple[ImportOptions, list[str]]:
        """These options, with the file's where they are not given, and the names that are no option here."""
        content = read_object("hparams", self.hparams)
        if content is None:
            return self, []
        if not isinstance(self.hparams, Mapping) and isinstance(content.get("data_root"), str):
            content = {**content, "data_root": str(Path(self.hparams or "").parent / content["data_root"])}
        stated = {ALIASES.get(name, name): value for name, value in content.items()}
        accepted: dict[str, Any] = {}
        for name, kind in HPARAMS.items():
            if getattr(self, name) is None and isinstance(stated.get(name), kind):
                accepted[name] = Path(stated[name]) if name == "data_root" else stated[name]
        flags = {name: stated[name] for name in MODEL_HPARAMS if name in stated}
        left = sorted(stated.keys() - HPARAMS.keys() - set(MODEL_HPARAMS))
        return replace(self, **accepted, model_options={**flags, **self.model_options}), left

    def all_model_options(self) -> dict[str, Any]:
        """Options of the model and its audio encoder by name; ``ignore`` is a list, since it may be repeated."""
        options = dict(self.model_options)
        ignored = options.pop("ignore", [])
        options["ignore"] = [ignored] if isinstance(ignored, str) else list(ignored)
        for text in self.option or []:
            name, _, value = text.partition("=")
            if name == "ignore":
                options["ignore"].append(value)
            else:
                options[name] = value
        return options


def read_object(option: str, source: str | Path | Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The values by name of an option that is a JSON file or, in Python, its content."""
    if source is None or isinstance(source, Mapping):
        return source
    remedy = "expected a JSON object of values by name"
    content: Any = load_json(Path(source), name=f"--{option.replace('_', '-')} {source}", remedy=remedy)
    if not isinstance(content, dict):
        raise OptionError(option, remedy, source)
    return content
