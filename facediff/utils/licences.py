"""Licence labels: the terms of the data and networks that a model was made from, and whether they allow commercial use.

A label repeats the public terms of the owner of a data set, with the place where they stand; it is no legal advice.
A model made from several things may be used only as far as all of them allow, so the strictest label decides
(:func:`commercial_use`). Unknown terms count as not cleared.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, astuple, dataclass
from typing import Any, Literal, get_args

from facediff.errors import OptionError, damaged
from facediff.utils.hints import is_plain_text
from facediff.utils.limits import quoted

Commercial = Literal["allowed", "unknown", "forbidden"]
"""Whether terms allow commercial use, from the mildest to the strictest."""

LICENCES_KEY = "facediff_licences"
"""Where checkpoints and model folders keep their labels, as a list of :meth:`Licence.state`."""

MOST = 1000
"""Labels that a file may hold."""

KNOWN: dict[str, Commercial] = {
    **dict.fromkeys(
        ("apache-2.0", "mpl-2.0", "mit", "bsd-2-clause", "bsd-3-clause", "cc0-1.0", "unlicense", "isc"), "allowed"
    ),
    **dict.fromkeys(("cc-by-4.0", "cc-by-3.0", "cc-by-sa-4.0", "cc-by-sa-3.0", "cdla-permissive-2.0"), "allowed"),
    **dict.fromkeys(("cc-by-nc-4.0", "cc-by-nc-3.0", "cc-by-nc-sa-4.0", "cc-by-nc-nd-4.0"), "forbidden"),
}
"""Licences by the identifier that the Hugging Face hub and SPDX give them, in small letters."""

SPEECH_NETWORKS = {
    **dict.fromkeys(
        ("facebook/hubert-base-ls960", "facebook/hubert-large-ls960-ft", "facebook/hubert-xlarge-ls960-ft"),
        "Apache-2.0",
    ),
    **dict.fromkeys(("facebook/wav2vec2-base-960h", "facebook/wav2vec2-base"), "Apache-2.0"),
    "mozilla/DeepSpeech": "MPL-2.0",
}
"""Licences of pretrained audio encoders, as their model cards on the hub or their projects state them."""


@dataclass(frozen=True)
class Licence:
    """The terms (``name``) of one thing that a model was made ``of``, such as ``weights``, and where they stand."""

    of: str
    name: str = "unknown"
    commercial: Commercial = "unknown"
    source: str = ""

    def state(self) -> dict[str, str]:
        """Plain data for a checkpoint or a JSON file."""
        return asdict(self)

    def __str__(self) -> str:
        return f"{self.of}: {self.name} (commercial use {self.commercial})"


def commercial_use(licences: Iterable[Licence]) -> Commercial:
    """Commercial use by the strictest of several licences; unknown if there are none."""
    order = get_args(Commercial)
    return max((licence.commercial for licence in licences), key=order.index, default="unknown")


def merged(*groups: Iterable[Licence]) -> tuple[Licence, ...]:
    """The labels of a model's ancestors, each once."""
    return tuple(dict.fromkeys(licence for group in groups for licence in group))


def in_words(licences: Iterable[Licence]) -> str:
    """All licences in one line, for messages and the metadata of files."""
    labels = list(licences)
    names = "; ".join(f"{label.of}: {label.name}" for label in labels) or "unknown"
    return f"{names}; commercial use {commercial_use(labels)}"


def licence_metadata(licences: Iterable[Licence]) -> dict[str, str]:
    """The entries of an animation's metadata."""
    labels = list(licences)
    return {"licence": in_words(labels), "commercial_use": commercial_use(labels)}


def known_licence(name: str) -> Commercial:
    """Commercial use under a licence, by its usual identifier; unknown for any other."""
    return KNOWN.get(name.lower(), "unknown")


def require_cleared(source: object, licences: Iterable[Licence]) -> None:
    """Refuse a model with data or weights that are not cleared for commercial use."""
    labels = list(licences)
    if commercial_use(labels) == "allowed":
        return
    reasons = "; ".join(str(label) for label in labels if label.commercial != "allowed") or "it states no licence"
    raise OptionError.naming(
        f"{source}: not cleared for commercial use ({reasons}), and only cleared models were asked for. Choose a model "
        f"whose data allow it, or omit {{commercial_only}} where its terms fit your use"
    )


def read_licences(source: object, state: Any) -> tuple[Licence, ...]:  # noqa: ANN401 - whatever a file holds
    """The labels that a file holds."""
    with damaged(f"{source}: its licences", f"expected texts {', '.join(Licence.__dataclass_fields__)}"):
        labels = tuple(Licence(**entry) for entry in state)
        plain = all(is_plain_text(text) for label in labels for text in astuple(label))
        if not plain or any(label.commercial not in get_args(Commercial) for label in labels):
            raise ValueError(f"are {quoted(state)}")
    return labels


def network_licences(options: Any) -> tuple[Licence, ...]:  # noqa: ANN401 - plain data of any form
    """Labels of the pretrained networks that a model's options name, wherever they do.

    A network that was read from a folder is not known by its path; its licence is unknown.
    """
    if isinstance(options, Mapping):
        network = options.get("_name_or_path")
        inner = merged(*(network_licences(value) for value in options.values()))
        if not isinstance(network, str) or not network:  # no network, or one that was trained here from nothing
            return inner
        name = SPEECH_NETWORKS.get(network)
        on_hub = name is not None or re.fullmatch(r"[\w.-]+/[\w.-]+", network)
        site = "github.com" if name == "MPL-2.0" else "model card huggingface.co"
        label = Licence(
            f"audio encoder {network if on_hub else 'from a folder'}",
            name or "unknown",
            known_licence(name or ""),
            f"{site}/{network}" if name else "",
        )
        return merged([label], inner)
    if isinstance(options, list | tuple):
        return merged(*map(network_licences, options))
    return ()
