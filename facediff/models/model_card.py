"""Model cards: the ``README.md`` of a model folder, with the metadata that the Hugging Face hub reads.

A card states the known facts of a model and says where one is unknown. Scores come with their protocol, the hashes
of the regions that they were taken over, and the frames and sequences that went into them, as the test wrote them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError
from facediff.models.checkpoint_content import IMPORTED, CheckpointContent
from facediff.models.evaluation import METHODS
from facediff.registry import COMPONENTS, corpus
from facediff.utils.hub import ASSETS, CONFIG, WEIGHTS
from facediff.utils.licences import KNOWN, Licence, commercial_use
from facediff.utils.limits import quoted
from facediff.utils.plain_files import read_rows

SCORES = "test_scores.csv"
"""What ``facediff test`` calls its table of scores."""

SPLITS = {
    "test_a": "test A, seen speakers",
    "test_b": "test B, unseen speakers",
    "test_c": "test C, unseen voices",
    "val": "validation",
}
ABOUT = {
    *("split", "method", "unseen_identity", "protocol", "frames", "sequences", "cut_prediction", "cut_truth"),
    *("seed", "checkpoint", "components"),
}
"""Columns of a table of scores that are no scores; columns of regions end in ``_vertices`` and ``_hash``."""

LONGEST_NAME = 96


@dataclass(frozen=True)
class CardFacts:
    """Contents of a card that the model does not hold.

    Attributes:
        name: the model's name.
        scores: rows of a table that ``facediff test`` wrote for this very model; none if it was not tested.
        languages: codes of the languages that it was trained on, such as ``en``; the corpus's if None.
        half: whether its parameters are stored in 16 bits.
        sizes: bytes of the folder's files by name.
    """

    name: str
    scores: Sequence[Mapping[str, str]] = ()
    languages: Sequence[str] | None = None
    half: bool = False
    sizes: Mapping[str, int] = field(default_factory=dict)


def read_scores(path: Path) -> list[dict[str, str]]:
    """The rows of a table of scores."""
    remedy = f"expected {SCORES} as `facediff test` writes it"
    rows = list(read_rows(path, remedy=remedy))
    if not rows or not {"split", "method", "protocol", "frames"} <= rows[0].keys():
        raise FaceDiffError(f"{path}: is no table of test scores; {remedy}")
    number = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d{1,2})?|nan|", re.IGNORECASE)
    for row in rows:
        row |= {column: row[column].strip() for column in scored(rows)}
        about = all(row[column].strip() for column in ("split", "method", "protocol", "frames"))
        if not about or not all(number.fullmatch(row[column]) for column in scored(rows)):
            raise FaceDiffError(f"{path}: has the row {quoted(row)}, with an empty cell or no number; {remedy}")
    return rows


def scored(rows: Sequence[Mapping[str, str]]) -> list[str]:
    """The columns that are scores."""
    return list(filter(is_score, rows[0])) if rows else []


def is_score(column: str) -> bool:
    """Whether a column holds scores."""
    return column not in ABOUT and not column.endswith(("_vertices", "_hash"))


def check_languages(languages: Iterable[str]) -> None:
    """Refuse a text that is no code of a language."""
    for code in languages:
        if not re.fullmatch(r"[a-z]{2,3}(-[A-Za-z0-9]{2,8})*", code):
            raise FaceDiffError(f"--languages {quoted(code)}: expected codes such as en or zh-CN, separated by commas")


def card(model: CheckpointContent, licences: Sequence[Licence], facts: CardFacts) -> str:
    """The text of a model card: metadata in YAML, then Markdown."""
    import yaml

    assets, provenance, data, options = model.assets, model.provenance, model.data_options, dict(model.hparams)
    about = [
        ("vertices", f"{model.n_vertices}, in {text(assets.unit)}"),
        ("frames a second", f"{model.frame_rate:g}"),
        ("identities", ", ".join(text(name) for name in model.identities)),
        (
            "weights",
            f"{sum(weight.numel() for weight in model.parameters()) / 1e6:.2f} million, stored in "
            f"{'16' if facts.half else '32'} bits",
        ),
        *((kind.replace("_", " "), f"`{name}`") for kind, name in components(model).items()),
    ]
    corpus_rows = [
        ("corpus", text(assets.corpus)),
        ("kind", "synthetic, made by a program" if assets.synthetic else "captured from real people"),
        ("speakers trained on", str(len(model.identities))),
        ("faces known", str(len(assets.templates))),
        ("languages", ", ".join(languages_of(model, facts)) or "not stated"),
    ]
    origin = "the authors' checkpoint, imported" if IMPORTED in provenance else "nothing; trained from its first step"
    training = [
        ("adapted from", text(provenance.get("parent") or origin)),
        ("epochs", provenance.get("epochs", "not known")),
        ("optimiser steps", provenance.get("steps", "not known")),
        ("seed", provenance.get("seed", "not known")),
        ("learning rate", f"{options.get('learning_rate', 'not known')}, {options.get('lr_schedule', '')}"),
        ("weight decay", str(options.get("weight_decay", "not known"))),
        ("clips a batch", str(data.get("batch_size", "not known"))),
        ("training window", "whole clips" if data.get("window") is None else f"{data['window']} frames"),
        ("weights stored", "the averaged ones, where training averaged them"),
    ]
    labels = [
        (text(label.of), text(label.name), label.commercial, text(label.source) or "not stated") for label in licences
    ]
    files = [(f"`{name}`", f"{facts.sizes.get(name, 0) / 1e6:.2f} MB", what) for name, what in FILES.items()]
    body = BODY.format(
        title=text(facts.name),
        name=facts.name,
        method=type(model).__name__,
        corpus=text(assets.corpus),
        identity=model.identities[0],
        vertices=model.n_vertices,
        config=CONFIG,
        synthetic=SYNTHETIC if assets.synthetic else "",
        people=OF_PROGRAMS if assets.synthetic else OF_PEOPLE,
        verdict=VERDICTS[commercial_use(licences)],
        about=table(("", ""), about),
        labels=table(("of", "licence", "commercial use", "where it stands"), labels) if labels else "",
        data=table(("", ""), corpus_rows),
        training=table(("", ""), training),
        scores=score_section(model, facts),
        files=table(("file", "size", "content"), files),
    )
    head = yaml.safe_dump(metadata(model, licences, facts), sort_keys=False, allow_unicode=True, width=100)
    return f"---\n{head}---\n\n{body}"


BODY = """# {title}

Speech in, a talking 3D face out: a model of the method `{method}` of facediff, trained on the corpus **{corpus}**.
{synthetic}
{about}

## How to use it

```bash
pip install "facediff[all]"
facediff animate speech.wav --checkpoint {name} --identity {identity} -o speech.mp4
```

```python
import facediff

model = facediff.load("{name}")
model.animate("speech.wav", identity="{identity}").save("speech.glb")
```

In place of the name, give this folder's path, or `user/name` (or `user/name@revision`) of the hub. The folder holds
numbers and plain text only; nothing in it is run.

## Licences

{verdict} The strictest decides; read the terms themselves, this is no legal advice.

{labels}

## Data

{data}

## Training

{training}

Every option is in `{config}`.

## Scores

{scores}

## Intended use

Research and production of facial animation from recorded or synthesised speech: games, avatars, studies of methods.
Do not use it to imitate a person without their consent, or to deceive.

## Limits

- {people}
- It animates faces of its own topology ({vertices} vertices); other meshes need `--target-mesh`.
- It moves the face alone: blinks, gaze and head motion are as far learnt as the corpus has them.
- Speech in other languages, singing, noise and children's voices were not tested.
- Unseen speakers get the style of a reference clip; their likeness is below that of trained identities.

## Files

{files}
"""
SYNTHETIC = """
> **Synthetic data.** A program made the faces and their motion. Scores on this corpus compare models; they say nothing
> about real people.
"""
OF_PROGRAMS = "It has learnt from a program's motion: it shows how such a model works, not how people move."
OF_PEOPLE = "Its identities are real people: do not make them say what they have not agreed to say."
VERDICTS = {
    "allowed": "Commercial use is **allowed** by every licence that this model inherits.",
    "forbidden": "Commercial use is **forbidden** by at least one licence that this model inherits.",
    "unknown": "Whether commercial use is allowed is **unknown**; treat it as not allowed until you know.",
}
FILES = {
    WEIGHTS: "weights, without anything that only training needs",
    CONFIG: "the model's class and options, licence labels; plain values",
    ASSETS: "templates, triangles, regions and reference motions that animation needs",
}
UNTESTED = (
    "None are known. `facediff test --ckpt_path FOLDER` measures them where the corpus is, and `facediff publish "
    "--scores test_scores.csv` puts them here."
)


def metadata(model: CheckpointContent, licences: Sequence[Licence], facts: CardFacts) -> dict[str, Any]:
    """The metadata of the card, by the hub's names; ``commercial_use`` and ``corpus`` are ours."""
    weights = next((label for label in licences if label.of == "weights"), Licence("weights"))
    identifier = weights.name.lower()
    parent = model.provenance.get("parent", "")
    fields: dict[str, Any] = {
        "license": identifier if identifier in KNOWN else "unknown" if identifier == "unknown" else "other"
    }
    if fields["license"] == "other":
        fields["license_name"] = re.sub(r"[^a-z0-9.]+", "-", identifier).strip("-")[:LONGEST_NAME]
    fields["library_name"] = "facediff"
    if languages := languages_of(model, facts):
        fields["language"] = list(languages)
    fields["tags"] = [
        *("speech-driven-3d-facial-animation", "3d-face", "talking-head", "audio-to-motion"),
        type(model).__name__.lower(),
        f"corpus-{model.assets.corpus}",
        *(["synthetic-data"] if model.assets.synthetic else []),
    ]
    if re.fullmatch(r"[\w.-]+/[\w.-]+(@.*)?", parent):
        fields["base_model"] = parent.partition("@")[0]
    fields["corpus"] = {"name": model.assets.corpus, "synthetic": model.assets.synthetic}
    fields["commercial_use"] = commercial_use(licences)
    if results := model_index(model, facts):
        fields["model-index"] = [{"name": facts.name, "results": results}]
    return fields


def model_index(model: CheckpointContent, facts: CardFacts) -> list[dict[str, Any]]:
    """The model's own scores in the form in which the hub shows them."""
    results = []
    for row in facts.scores:
        if row["method"] != "model":
            continue
        values = {name: float(row[name]) for name in scored(facts.scores) if row[name] and row[name].lower() != "nan"}
        label = f"{model.assets.corpus} ({SPLITS.get(row['split'], row['split'])})"
        results.append(
            {
                "task": {"type": "speech-driven-3d-facial-animation", "name": "Speech-driven 3D facial animation"},
                "dataset": {"type": model.assets.corpus, "name": label, "split": row["split"], "args": conditions(row)},
                "metrics": [
                    {"type": name, "value": value, "name": f"{name.upper()}, protocol {row['protocol']}"}
                    for name, value in values.items()
                ],
            }
        )
    return results


def conditions(row: Mapping[str, str]) -> dict[str, str]:
    """What decides a row's scores: protocol, regions, frames and sequences."""
    return {name: value for name, value in row.items() if name not in ("split", "method") and not is_score(name)}


def components(model: CheckpointContent) -> dict[str, str]:
    """The names of the model's components by kind."""
    options = {kind: model.hparams.get(kind) for kind in COMPONENTS}
    return {
        kind: str(option["class_path"]).rpartition(".")[2]
        for kind, option in options.items()
        if isinstance(option, Mapping) and "class_path" in option
    }


def score_section(model: CheckpointContent, facts: CardFacts) -> str:
    """The scores with everything that decides them."""
    if not facts.scores:
        return UNTESTED
    first, names = facts.scores[0], scored(facts.scores)
    called = {name: label.format(model="this model") for name, label in METHODS.items()}
    header = ["split", "method", *(name.upper() for name in names), "frames", "sequences"]
    rows = [
        [
            SPLITS.get(row["split"], text(row["split"])),
            called.get(row["method"], text(row["method"])),
            *(f"{float(row[name]):.4g}" if row[name] else "" for name in names),
            text(row["frames"]),
            text(row.get("sequences", "")),
        ]
        for row in facts.scores
    ]
    regions = [column.removesuffix("_hash") for column in first if column.endswith("_hash")]
    score_rows = [
        f"{text(region)}: {text(first.get(f'{region}_vertices', ''))} vertices, hash `{text(first[f'{region}_hash'])}`"
        for region in regions
    ]
    policy = text(first.get("unseen_identity", ""))
    notes = [
        f"Protocol `{text(first['protocol'])}`; lower is better; unit of length {text(model.assets.unit)}.",
        f"Regions: {'; '.join(score_rows)}." if score_rows else "",
        f"Unseen speakers were tested with the identity policy `{policy}`." if policy else "",
        "The other rows are baselines: a face that never moves, the speaker's mean face, and this model with the "
        "speech of another clip. docs/metrics.md of facediff defines every score.",
    ]
    return table(header, rows) + "\n\n" + "\n".join(note for note in notes if note)


# Helpers.


def languages_of(model: CheckpointContent, facts: CardFacts) -> Sequence[str]:
    """The languages that were stated, else the corpus's."""
    if facts.languages is not None:
        return facts.languages
    corpora: list[type[Any]] = [entry.implementation for entry in corpus]
    return next(
        (module.languages for module in corpora if getattr(module, "corpus_name", None) == model.assets.corpus), ()
    )


def text(value: str) -> str:
    """A text that Markdown shows as it is, in a table too."""
    return re.sub(r"([\\`*_{}\[\]<>|])", r"\\\1", " ".join(str(value).split()))


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; its cells are Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
