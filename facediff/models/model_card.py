"""Model cards: the ``README.md`` of a model folder, with the metadata that the Hugging Face hub reads.

A card states the known facts of a model and says where one is unknown.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from facediff.models.checkpoint_content import IMPORTED, CheckpointContent
from facediff.registry import corpus
from facediff.utils.hub import CONFIG
from facediff.utils.licences import KNOWN, Licence, commercial_use

LONGEST_NAME = 96


def card(model: CheckpointContent, name: str) -> str:
    """The text of a model card: metadata in YAML, then Markdown."""
    import yaml

    assets, provenance = model.assets, model.provenance
    about = [
        ("vertices", f"{model.n_vertices}, in {text(assets.unit)}"),
        ("frames a second", f"{model.frame_rate:g}"),
        ("identities", ", ".join(text(name) for name in model.identities)),
        ("weights", f"{sum(weight.numel() for weight in model.parameters()) / 1e6:.2f} million"),
    ]
    corpus_rows = [
        ("corpus", text(assets.corpus)),
        ("kind", "synthetic, made by a program" if assets.synthetic else "captured from real people"),
        ("speakers trained on", str(len(model.identities))),
        ("faces known", str(len(assets.templates))),
        ("languages", ", ".join(languages_of(model)) or "not stated"),
    ]
    origin = "the authors' checkpoint, imported" if IMPORTED in provenance else "nothing; trained from its first step"
    training = [
        ("adapted from", text(provenance.get("parent") or origin)),
        ("epochs", provenance.get("epochs", "not known")),
        ("optimiser steps", provenance.get("steps", "not known")),
        ("seed", provenance.get("seed", "not known")),
    ]
    labels = [
        (text(label.of), text(label.name), label.commercial, text(label.source) or "not stated")
        for label in model.licences
    ]
    body = BODY.format(
        title=text(name),
        name=name,
        method=type(model).__name__,
        corpus=text(assets.corpus),
        identity=model.identities[0],
        vertices=model.n_vertices,
        config=CONFIG,
        synthetic=SYNTHETIC if assets.synthetic else "",
        people=OF_PROGRAMS if assets.synthetic else OF_PEOPLE,
        verdict=VERDICTS[commercial_use(model.licences)],
        about=table(("", ""), about),
        labels=table(("of", "licence", "commercial use", "where it stands"), labels) if labels else "",
        data=table(("", ""), corpus_rows),
        training=table(("", ""), training),
    )
    head = yaml.safe_dump(metadata(model), sort_keys=False, allow_unicode=True, width=100)
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

`facediff test --ckpt_path FOLDER` measures them where the corpus is; write them here with their protocol and regions.

## Intended use

Research and production of facial animation from recorded or synthesised speech: games, avatars, studies of methods.
Do not use it to imitate a person without their consent, or to deceive.

## Limits

- {people}
- It animates faces of its own topology ({vertices} vertices); other meshes need `--target-mesh`.
- It moves the face alone: blinks, gaze and head motion are as far learnt as the corpus has them.
- Speech in other languages, singing, noise and children's voices were not tested.
- Unseen speakers get the style of a reference clip; their likeness is below that of trained identities.
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


def metadata(model: CheckpointContent) -> dict[str, Any]:
    """The metadata of the card, by the hub's names; ``commercial_use`` and ``corpus`` are ours."""
    weights = next((label for label in model.licences if label.of == "weights"), Licence("weights"))
    identifier = weights.name.lower()
    parent = model.provenance.get("parent", "")
    fields: dict[str, Any] = {
        "license": identifier if identifier in KNOWN else "unknown" if identifier == "unknown" else "other"
    }
    if fields["license"] == "other":
        fields["license_name"] = re.sub(r"[^a-z0-9.]+", "-", identifier).strip("-")[:LONGEST_NAME]
    fields["library_name"] = "facediff"
    if languages := languages_of(model):
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
    fields["commercial_use"] = commercial_use(model.licences)
    return fields


# Helpers.


def languages_of(model: CheckpointContent) -> Sequence[str]:
    """The languages of the corpus."""
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
