"""What differs between a checkpoint and what its importer expects: for files that cannot be imported.

The importers are written by the authors' code; a file may have been trained with another version of it. The report has
all that is needed to say where the two part, and reads as far as it can.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from facediff import registry
from facediff.errors import FaceDiffError
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.importing import (
    convert,
    facts_and_faces,
    is_graph,
    read_weights,
    refuse_idle,
    with_options,
)
from facediff.models.published.recognition import RECOGNISERS, AuthorsWeights, Recogniser

MOST = 40
"""Tensors of one kind that are listed one by one."""


def examine(files: Sequence[Path], options: ImportOptions) -> Iterator[str]:
    """Lines of the report; what cannot be read ends it with the reason.

    Args:
        files: as :func:`facediff.models.published.importing.import_checkpoint` takes them.
        options: the user's, by which the import would be tried.
    """
    for path in files:
        if path.is_file():
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            yield f"{path}: {path.stat().st_size} bytes, sha256 {digest}"
    try:
        graphs = [path for path in files if is_graph(path)]
        weights = read_weights([path for path in files if path not in graphs])
    except FaceDiffError as error:
        yield f"cannot be read: {error}"
        return
    numbers = sum(value.numel() for value in weights.tensors.values())
    yield f"{len(weights.tensors)} tensors, {numbers / 1e6:.2f} M numbers"
    registry.model.load()
    fitting = [entry for entry in RECOGNISERS if entry.knows(weights)]
    if len(fitting) != 1:
        yield from unrecognised(weights, fitting)
        return
    yield f"method: {fitting[0].method}"
    yield from compared(weights, fitting[0], files, options)


def unrecognised(weights: AuthorsWeights, fitting: Sequence[Recogniser]) -> Iterator[str]:
    """Of which methods it is, or which come nearest and what they lack; and the tensors."""
    if fitting:
        yield f"method: one of {', '.join(entry.method for entry in fitting)}; expected one alone"
    else:
        near = sorted(RECOGNISERS, key=lambda entry: -sum(name in weights for name in entry.marks) / len(entry.marks))
        for entry in near[:3]:
            lacking = [name for name in entry.marks if name not in weights]
            others = [name for prefix in entry.unless for name in weights.names(prefix)]
            reasons = [f"lacks {', '.join(lacking)}"] * bool(lacking) + [f"has {', '.join(others[:3])}"] * bool(others)
            yield f"method: not {entry.method}, since it {' and '.join(reasons)}"
    yield from listing("tensor", [(name, str(tuple(value.shape))) for name, value in weights.tensors.items()])


def compared(
    weights: AuthorsWeights, method: Recogniser, files: Sequence[Path], options: ImportOptions
) -> Iterator[str]:
    """What is missing, too much, or of another shape than the model that the import would make."""
    try:
        refuse_idle(options, method)
        options, _ = options.with_hparams()
        facts, _ = facts_and_faces(weights, method, options, [path for path in files if is_graph(path)])
        converted = convert(weights, method, facts, options)
        arguments = with_options(method.method, converted, facts.model_options)
        model = registry.model.get(method.method)(**facts.sizes(), **arguments)
    except FaceDiffError as error:
        yield f"stops at: {error}"
        left = weights.left()
        yield from listing("not looked at so far", [(name, str(tuple(weights.tensors[name].shape))) for name in left])
        return
    own = {name: tuple(value.shape) for name, value in model.state_dict().items() if name != "geometry"}
    shapes = {name: tuple(value.shape) for name, value in weights.renamed.items()}
    yield from listing("missing", [(weights.authors_name(name), str(own[name])) for name in own if name not in shapes])
    differing = [name for name in own if shapes.get(name, own[name]) != own[name]]
    pairs = [(weights.authors_name(name), f"{shapes[name]}, expected {own[name]}") for name in differing]
    yield from listing("other shape", pairs)
    extra = [(weights.authors_name(name), str(shapes[name])) for name in shapes if name not in own]
    idle = [(name, str(tuple(weights.tensors[name].shape))) for name in weights.left()]
    yield from listing("of no use", [*extra, *idle])
    floats = {name: value for name, value in weights.tensors.items() if value.is_floating_point()}
    unsound = [name for name, value in floats.items() if not value.isfinite().all()]
    yield from listing("not finite", [(name, "") for name in unsound])
    yield from listing("not needed", list(weights.ignored.items()))
    fits = not (pairs or extra or idle or unsound or own.keys() - shapes.keys())
    yield f"{len(own)} tensors are expected: {'all fit' if fits else 'they do not fit, see above'}"


def listing(kind: str, tensors: Sequence[tuple[str, str]]) -> Iterator[str]:
    """Tensors of one kind, of many the first ones."""
    for name, about in tensors[:MOST]:
        yield f"{kind}: {name} {about}".rstrip()
    if len(tensors) > MOST:
        yield f"{kind}: {len(tensors) - MOST} more"
