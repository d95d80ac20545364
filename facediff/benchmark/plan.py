"""The plan of a benchmark: which methods on which corpora, with which seeds and options. Checked before anything runs.

A plan is a YAML file of plain data; docs/benchmark.md lists its keys, which are the fields of :class:`BenchmarkPlan`.
It names experiment configs, checkpoints, and folders of predictions, none of which it holds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from facediff.errors import FaceDiffError, check_known, choices, located
from facediff.utils.files import config_dir
from facediff.utils.ranges import Range
from facediff.utils.records import DERIVED, Items, Text, read_record
from facediff.utils.yaml_files import load_yaml

COSTS = ("weights", "rtf", "training", "memory")
"""Columns of a table besides the scores."""

MEAN_SUFFIX = ".mean"
"""Suffix of a method's further row, the mean of ``model.test_samples`` samples."""

MOST_CELLS = 10_000
"""Cells that a plan may have; a few numbers and names of a small file multiply into millions."""

Name = Annotated[str, Text(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,60}", "a short name of letters and digits")]
Line = Annotated[str, Text(r"(?s).*\S.*", "a text")]
PATH = Text(r"(?=.)[^\0/]{0,180}(/[^\0/]{0,180}){0,99}", "the path of a file, with short names")
FilePath = Annotated[str, PATH]
Option = Annotated[
    str,
    Text(
        r"(?!seed_everything$)[a-z][\w-]*(\.\w+)*",
        "an option without dashes, such as trainer.max_epochs; the seeds of a plan are its key `seeds`",
    ),
]
Options = Mapping[Option, Any]
Lines = Annotated[tuple[Line, ...], Items()]
Seeds = Annotated[tuple[Annotated[int, Range(0, 2**32 - 1)], ...], Items(1)]
Reference = Literal["still", "mean_face", "shuffled"]
Count = Annotated[int, Range(1, 1024)]


@dataclass(frozen=True)
class CorpusEntry:
    """A corpus of the plan."""

    label: Line = ""  # by which tables call it
    data: Annotated[Path, PATH] | None = None  # config of its data module; None where experiment configs have their own
    root: Annotated[Path, PATH] | None = None  # its folder; None for the place that the data module knows
    options: Options = field(default_factory=dict)  # of every training on it
    name: str = field(default="", metadata=DERIVED)


@dataclass(frozen=True)
class Before:
    """A training that has to come first, such as a codebook's: its checkpoint is ``{name}`` in the options."""

    config: FilePath
    options: Options = field(default_factory=dict)


@dataclass(frozen=True)
class MethodEntry:
    """A row of the table, or one for each variant."""

    label: Line = ""
    config: FilePath | None = None  # experiment config that trains it; ``{corpus}`` stands for the corpus's name
    checkpoint: FilePath | None = None  # a trained model, one for each seed if it has ``{seed}``
    predictions: FilePath | None = None  # a folder of predicted motion, with the same fields in its path
    options: Options = field(default_factory=dict)  # of the training, or of ``facediff evaluate`` for predictions
    test_options: Options = field(default_factory=dict)  # of the test
    before: Mapping[Name, Before] = field(default_factory=dict)  # trainings that come first, by name
    published: Line = ""  # its name in tables of papers
    corpora: Lines | None = None  # those that it is run on; all if None
    seeds: Seeds | None = None  # instead of the plan's
    variants: Lines | None = None  # names of the plan's variants that it is run in; all if None
    name: str = field(default="", metadata=DERIVED)

    @property
    def per_seed(self) -> bool:
        """Whether each seed is a cell of its own: it is trained, or its files are of several trainings."""
        return self.config is not None or "{seed}" in f"{self.checkpoint} {self.predictions}"

    def count_cells(self, plan: BenchmarkPlan) -> int:
        """How many cells of a plan it makes, without making them."""
        variants = plan.variants if self.variants is None else self.variants
        corpora = plan.corpora if self.corpora is None else self.corpora
        trained = len(variants) if self.config is not None and variants else 1
        return trained * len(corpora) * (len(self.seeds or plan.seeds) if self.per_seed else 1)


@dataclass(frozen=True)
class Variant:
    """Options that make another row of every method, such as one of an ablation."""

    label: Line = ""
    options: Options = field(default_factory=dict)
    published: Line = ""
    name: str = field(default="", metadata=DERIVED)


@dataclass(frozen=True)
class BenchmarkPlan:
    """A benchmark.

    Attributes:
        corpora: by name.
        methods: by name.
        variants: by name.
        title: of the tables.
        description: a sentence about them.
        protocol: of all scores.
        metrics: further metrics by name.
        columns: scores and costs that tables show; all scores of the protocol and the metrics if none is named, and all
            costs.
        seeds: of the training runs.
        baseline: the row that all others are compared with, ``NAME.mean`` for a mean of samples; the first if empty.
        weights: the checkpoint of a training that is scored.
        threads: of each training and test; digits may depend on it, so that it is part of the plan.
        workers: cells that run at a time; as many as processors divided by threads if None.
        options: of every training.
        test_options: of every test.
        references: rows that need no training.
        published: tables of papers that are shown next to it, by their name in :mod:`facediff.benchmark.published`.
        name: the file's name without its suffix.
        file: the file.
    """

    corpora: Annotated[Mapping[Name, CorpusEntry], Items(1)]
    methods: Annotated[Mapping[Name, MethodEntry], Items(1)]
    variants: Mapping[Name, Variant] = field(default_factory=dict)
    title: Line = ""
    description: Line = ""
    protocol: Line = "paper"
    metrics: Lines = ()
    columns: Lines = ()
    seeds: Seeds = ()
    baseline: Line = ""
    weights: Literal["last", "best"] = "last"
    threads: Count = 1
    workers: Count | None = None
    options: Options = field(default_factory=dict)
    test_options: Options = field(default_factory=dict)
    references: Annotated[tuple[Reference, ...], Items()] = ("still", "mean_face", "shuffled")
    published: Lines = ()
    name: str = field(default="", metadata=DERIVED)
    file: Path = field(default=Path(), metadata=DERIVED)


def find_plan(path: Path) -> Path:
    """The file of a plan; bundled ones are found by ``configs/benchmark/NAME.yaml``, and by NAME alone."""
    if path.is_file():
        return path
    file = path if path.suffix == ".yaml" else Path(f"{path}.yaml")
    bundled = config_dir().parent / path if path.parts[:1] == ("configs",) else config_dir() / "benchmark" / file
    if bundled.is_file():
        return bundled
    raise FaceDiffError(f"{path}: no such plan; {choices(str(path), bundled_configs('benchmark'))}")


def read_plan(path: Path, roots: Mapping[str, Path] | None = None) -> BenchmarkPlan:
    """Read a plan and check all that can be checked without running anything."""
    plan = read_record(BenchmarkPlan, load_yaml(path, "expected a plan such as configs/benchmark/quick.yaml"), path)
    check_known("--root", "corpus", roots or {}, plan.corpora)
    return replace(
        plan,
        name=path.stem,
        file=path,
        title=plan.title or path.stem,
        corpora={name: _corpus(name, corpus, (roots or {}).get(name), path) for name, corpus in plan.corpora.items()},
        methods={name: _method(name, method, plan, path) for name, method in plan.methods.items()},
        variants={
            name: replace(variant, name=name, label=variant.label or name) for name, variant in plan.variants.items()
        },
    )


def _corpus(name: str, corpus: CorpusEntry, root: Path | None, path: Path) -> CorpusEntry:
    """The corpus with its paths resolved."""
    folder = root or (None if corpus.root is None else beside(path, str(corpus.root)))
    if folder is not None and not folder.is_dir():
        raise FaceDiffError(f"{folder}: no such folder; expected the corpus {name}, give it with --root {name}=FOLDER")
    return replace(
        corpus,
        name=name,
        label=corpus.label or name,
        data=None if corpus.data is None else find_config(str(corpus.data), f"corpora.{name}.data", path),
        root=folder,
    )


def _method(name: str, method: MethodEntry, plan: BenchmarkPlan, path: Path) -> MethodEntry:
    """The method, after a check of its files and names."""
    entry = f"{path}: methods.{name}"
    check_known(f"{entry}.corpora", "corpus", method.corpora or (), plan.corpora)
    check_known(f"{entry}.variants", "variant", method.variants or (), plan.variants)
    problem = ""
    if [method.config, method.checkpoint, method.predictions].count(None) != 2:
        problem = "expected one of config, checkpoint and predictions"
    elif method.checkpoint is not None and method.options:
        problem = "options are of training, and a checkpoint is trained; use test_options"
    elif method.per_seed and not (plan.seeds or method.seeds):
        problem = "is trained, and the plan has no seeds; add `seeds: [0, 1, 2]`, to see the chance between runs"
    elif (count := sum(each.count_cells(plan) for each in plan.methods.values())) > MOST_CELLS:
        problem = f"makes {count} cells with the other methods, of {MOST_CELLS} at most; name fewer seeds or variants"
    if problem:
        raise FaceDiffError(f"{entry}: {problem}")
    for config in [method.config, *(step.config for step in method.before.values())]:
        for corpus in (method.corpora or plan.corpora) if config else ():
            find_config(str(config).replace("{corpus}", corpus), f"methods.{name}.config", path)
    return replace(method, name=name, label=method.label or name)


def check_scores(plan: BenchmarkPlan) -> None:
    """Refuse unknown protocols, metrics, columns and published tables; imports PyTorch, unlike :func:`read_plan`."""
    from facediff.benchmark.published import published
    from facediff.evaluation.evaluator import find_protocols
    from facediff.metrics.by_name import parse_all
    from facediff.metrics.generation import SMOOTHNESS

    with located(plan.file):
        (protocol,) = find_protocols([plan.protocol])
        parse_all(plan.metrics)
    check_known(f"{plan.file}: published", "table", plan.published, published())
    scores = [*(["mve"] if protocol.mve else []), "lve", *protocol.deviations(), *plan.metrics, *SMOOTHNESS, *COSTS]
    # A metric of several scores gives each its own name behind.
    prefixes = tuple(f"{name}_" for name in plan.metrics)
    columns = [column for column in plan.columns if not column.startswith(prefixes)]
    check_known(f"{plan.file}: columns", "score", columns, scores)


def beside(plan: Path, text: str) -> Path:
    """A path of the plan: from the working folder, or else from the plan's own."""
    path = Path(text).expanduser()
    return path if path.is_absolute() or path.exists() or not (plan.parent / path).exists() else plan.parent / path


def bundled_configs(folder: str) -> list[str]:
    """Names of the configs of a folder that come with facediff."""
    return [f"configs/{folder}/{file.name}" for file in sorted((config_dir() / folder).glob("*.yaml"))]


def find_config(text: str, key: str, plan: Path) -> Path:
    """The file of a config: bundled ones begin with ``configs/``."""
    bundled, file = config_dir() / text.removeprefix("configs/"), beside(plan, text)
    if not file.is_file() and text.startswith("configs/") and bundled.is_file():
        file = bundled
    if not file.is_file():
        hint = choices(text, bundled_configs(Path(text).parent.name or "experiment"))
        raise FaceDiffError(f"{plan}: {key} {text}: no such config; {hint}")
    return file
