"""The cells of a plan: every row on every corpus with every seed, and the recipe of each.

Two cells with equal recipes have equal results, so the recipe's hash is the cell's name on the disk. A changed
plan, a changed config that it names, a changed checkpoint or a changed corpus thus makes new cells of those that it
concerns, and finds the results of all others.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

from facediff.benchmark.plan import (
    MEAN_SUFFIX,
    Before,
    BenchmarkPlan,
    CorpusEntry,
    MethodEntry,
    Options,
    Variant,
    beside,
    find_config,
)
from facediff.errors import FaceDiffError, check_known
from facediff.utils.checksums import describe_files, file_stamps, hash_of, sha256
from facediff.utils.files import short_name
from facediff.utils.hub import check_model_source, model_hash
from facediff.utils.yaml_files import load_yaml

Kind = Literal["fit", "checkpoint", "predictions"]


@dataclass(frozen=True)
class Training:
    """A run of ``facediff fit``."""

    name: str  # of the step, ``fit`` for the last one
    config: Path  # the experiment config
    options: Options  # of the command line, by name without dashes


@dataclass(frozen=True, eq=False)
class Cell:
    """One training run of one row on one corpus, or one set of predictions."""

    row: str
    corpus: str  # the plan's name of the corpus
    seed: int | None  # of the training; None where the plan does not train
    kind: Kind  # whether it is trained, or a checkpoint, or predictions
    trainings: tuple[Training, ...] = ()  # in this order
    source: Path | None = None  # the checkpoint, or the folder of predictions
    options: Options = field(default_factory=dict)  # of ``facediff evaluate``, for predictions
    test_options: Options = field(default_factory=dict)  # of ``facediff test``
    root: Path | None = None  # the corpus's folder where the plan names it
    data: Path | None = None  # config of the data module where the plan names it
    recipe: Mapping[str, Any] = field(default_factory=dict)  # everything that the result depends on, as plain data
    # The part of the recipe that the trained weights depend on
    trained: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.row} on {self.corpus}" + ("" if self.seed is None else f", seed {self.seed}")

    @property
    def key(self) -> str:
        """Hash of the recipe."""
        return hash_of(self.recipe)

    @property
    def file_name(self) -> str:
        """Name of the cell's results, without a suffix."""
        return f"{self._stem}-{self.key[:12]}"

    @property
    def folder_name(self) -> str:
        """Name of the folder of its training run: cells that differ in the test alone share it."""
        return f"{self._stem}-{hash_of(self.trained)[:12]}"

    @property
    def _stem(self) -> str:
        parts = [self.row, self.corpus, *([] if self.seed is None else [f"seed{self.seed}"])]
        return short_name("-".join(re.sub(r"[^\w.+]+", "_", word) for word in parts), 100)


def with_code(content: Mapping[str, Any]) -> dict[str, Any]:
    """Plain data, with the files that it names, and the SHA-256 of the researcher's own code in its class paths."""
    content, code = _with_files(content, Path()), dict[str, str]()
    names = re.findall(r'"([A-Za-z_]\w*)\.[\w.]+\\?"(?!:)', json.dumps(content, default=str))
    for name in {*names} - {"facediff", "__main__"}:
        if (folder := own_code(name)) is not None:
            files = [folder / f"{name}.py", *(folder / name).rglob("*.py")]
            code |= {file.relative_to(folder).as_posix(): sha256(file) for file in files if file.is_file()}
    return {**content, **({"code": code} if code else {})}


def own_code(module: str) -> Path | None:
    """Where a module lies that is edited in place: the working folder, or that of an editable installation."""
    if Path(f"{module}.py").is_file() or Path(module).is_dir():
        return Path()
    spec = None if module in sys.stdlib_module_names else importlib.util.find_spec(module)
    if spec is None or spec.origin is None or "-packages" in spec.origin:
        return None
    return Path(spec.origin).parents[spec.submodule_search_locations is not None]


@dataclass(frozen=True)
class Row:
    """A row of the tables: a method, or a method in a variant."""

    name: str
    label: str
    method: MethodEntry
    variant: Variant | None = None

    @property
    def published(self) -> str:
        """Its name in tables of papers."""
        return self.variant.published if self.variant is not None and self.variant.published else self.method.published


def rows_of(plan: BenchmarkPlan) -> list[Row]:
    """The rows of a plan, in its order; where there are variants, each method once for each of them."""
    rows: list[Row] = []
    # The variants of the only method that is trained are rows under their own names.
    single = sum(method.config is not None for method in plan.methods.values()) == 1
    for method in plan.methods.values():
        names = list(plan.variants) if method.variants is None else list(method.variants)
        if method.config is None or not names:  # a trained model has no variants
            rows.append(Row(method.name, method.label, method))
            continue
        for name in names:
            variant = plan.variants[name]
            label = variant.label if single else f"{method.label}, {variant.label}"
            rows.append(Row(name if single else f"{method.name}/{name}", label, method, variant))
    names = [row.name for row in rows]
    repeated = next((name for name, count in Counter(names).items() if count > 1), None)
    if repeated is not None:
        raise FaceDiffError(f"{plan.file}: {repeated} names two rows; rename the method or the variant")
    check_known(f"{plan.file}: baseline", "row", filter(None, [plan.baseline.removesuffix(MEAN_SUFFIX)]), names)
    return rows


def cells_of(plan: BenchmarkPlan) -> list[Cell]:
    """All cells, seed by seed, so that a plan that is stopped early has complete columns of few seeds."""
    manifests = {name: _manifest(corpus.root) for name, corpus in plan.corpora.items()}
    columns = [
        list(_cells(plan, row, corpus, manifests[name]))
        for row in rows_of(plan)
        for name, corpus in plan.corpora.items()
        if row.method.corpora is None or name in row.method.corpora
    ]
    return [cell for turn in zip_longest(*columns) for cell in turn if cell is not None]


def _cells(plan: BenchmarkPlan, row: Row, corpus: CorpusEntry, manifest: str) -> Iterator[Cell]:
    method = row.method
    seeds: tuple[int | None, ...] = method.seeds or plan.seeds
    test_options = {**plan.test_options, **method.test_options}
    scoring = {"protocol": plan.protocol, "metrics": list(plan.metrics), "options": test_options}
    data = None if corpus.data is None else config_content(corpus.data)
    shared = {"corpus": {"data": data, "manifest": manifest}}
    facts: dict[str, Any] = {"test_options": test_options, "root": corpus.root, "data": corpus.data}
    if method.config is not None:
        trainings = tuple(_trainings(plan, row, corpus))
        steps = [training_content(step) for step in trainings]
        for seed in seeds:
            trained = with_code({**shared, "seed": seed, "threads": plan.threads, "trainings": steps})
            recipe = with_code({"kind": "fit", "trained": trained, "weights": plan.weights, "test": scoring})
            yield Cell(row.name, corpus.name, seed, "fit", trainings, recipe=recipe, trained=trained, **facts)
        return
    kind: Kind = "checkpoint" if method.checkpoint is not None else "predictions"
    text = method.checkpoint or method.predictions or ""
    if kind == "predictions" and corpus.data is None:
        raise FaceDiffError(
            f"{plan.file}: methods: {row.name} has predictions, and the corpus {corpus.name} has no `data`; name its "
            f"config, such as configs/data/biwi.yaml"
        )
    for seed in seeds if "{seed}" in text else (None,):
        source = _source(plan, kind, text.replace("{corpus}", corpus.name).replace("{seed}", str(seed)))
        recipe = with_code({**shared, "kind": kind, "source": _content(kind, source), "test": scoring})
        recipe["options"] = dict(method.options)
        facts |= {"source": source, "options": method.options}
        yield Cell(row.name, corpus.name, seed, kind, recipe=recipe, trained=recipe, **facts)


def _trainings(plan: BenchmarkPlan, row: Row, corpus: CorpusEntry) -> Iterator[Training]:
    method = row.method
    variant = {} if row.variant is None else row.variant.options
    last = Before(str(method.config), {**plan.options, **method.options, **variant})
    for name, step in {**method.before, "fit": last}.items():
        text = step.config.replace("{corpus}", corpus.name)
        config = find_config(text, f"methods.{method.name}.config", plan.file)
        yield Training(name, config, {**corpus.options, **step.options})


def _source(plan: BenchmarkPlan, kind: Kind, text: str) -> Path:
    path = beside(plan.file, text)
    expected = "a folder of predictions, .npy files of vertices"
    if kind == "checkpoint":
        expected = "a file of `facediff fit` or import-checkpoint, or a model folder"
    # Not a name of the hub: its content may change.
    if not path.exists() or (kind == "predictions" and not any(path.rglob("*.npy"))):
        raise FaceDiffError(f"{text}: not there, or empty; expected {expected}")
    if kind == "checkpoint":
        check_model_source(path)
    return path.resolve()


def _content(kind: Kind, path: Path) -> dict[str, Any]:
    """Hashes of a checkpoint, a model folder or a folder of predictions."""
    if kind == "checkpoint":
        return {"sha256": model_hash(path)}
    return describe_files(path, [file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file()])


def _manifest(root: Path | None) -> str:
    if root is None or not root.is_dir():
        return "none"
    if (manifest := root / "manifest.json").is_file():
        return sha256(manifest)
    return hash_of(file_stamps(root))


def training_content(training: Training) -> dict[str, Any]:
    """All that a training's config and options say, with the content of the files that they name."""
    config, options = config_content(training.config), dict(training.options)
    return dict(_with_files({"name": training.name, "config": config, "options": options}, Path()))


def config_content(path: Path) -> Any:  # noqa: ANN401
    """The plain data of a config, with the content of the configs that it names: comments do not count."""
    return _with_files(load_yaml(path, "expected a config such as configs/experiment/puppet.yaml"), path.parent)


def _with_files(value: Any, folder: Path) -> Any:  # noqa: ANN401
    """Plain data, with the content of the configs that it names, and the SHA-256 of other files."""
    if isinstance(value, dict):
        return {str(key): _with_files(entry, folder) for key, entry in value.items()}
    if isinstance(value, list):
        return [_with_files(entry, folder) for entry in value]
    if not isinstance(value, str) or not Path(value).suffix or not os.path.isfile(folder / value):  # noqa: PTH113
        return value  # which may be too long for a path: pathlib raises then
    file = (folder / value).resolve()
    return config_content(file) if file.suffix in (".yaml", ".yml") else sha256(file)
