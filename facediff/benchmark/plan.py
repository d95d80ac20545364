"""The plan of a benchmark: which methods on which corpora, with which seeds and options. Checked before anything runs.

A plan is a YAML file of plain data; docs/benchmark.md lists its keys. It names experiment configs, checkpoints, and
folders of predictions, none of which it holds.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from facediff.errors import FaceDiffError, choices
from facediff.utils.files import config_dir
from facediff.utils.limits import quoted
from facediff.utils.yaml_files import load_yaml

Weights = Literal["last", "best"]
Options = Mapping[str, Any]

KEYS = (
    *("title", "description", "protocol", "metrics", "seeds", "baseline", "weights", "threads", "workers"),
    *("options", "test_options", "references", "corpora", "methods", "variants", "published", "columns"),
)
METHOD_KEYS = (
    *("label", "config", "checkpoint", "predictions", "options", "test_options", "before", "published"),
    *("corpora", "seeds", "variants"),
)
SOURCES = ("config", "checkpoint", "predictions")
CORPUS_KEYS = ("data", "root", "options", "label")
BEFORE_KEYS = ("config", "options")
VARIANT_KEYS = ("label", "options", "published")
REFERENCES = ("still", "mean_face", "shuffled")
"""Rows that a test scores next to the model: see :data:`facediff.models.evaluation.METHODS`."""

COSTS = ("weights", "rtf", "training", "memory")
"""What a table can say of a method besides its scores."""

MEAN_SUFFIX = ".mean"
"""What follows a method's name in that of its further row, the mean of ``model.test_samples`` samples."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,60}")
OPTION = re.compile(r"(model|data|trainer)(\.\w+)*|(seed_everything|name)")
LARGEST_SEED = 2**32 - 1
MOST_CELLS = 10_000
LONGEST_NAME = 180
"""Bytes of a file's name, with room for a corpus's in it; file systems have 255."""


@dataclass(frozen=True)
class CorpusEntry:
    """A corpus of the plan.

    Attributes:
        name: by which the plan calls it.
        label: by which tables call it.
        data: config of its data module; None where experiment configs have their own.
        root: its folder; None for the place that the data module knows.
        options: of every training on it.
    """

    name: str
    label: str
    data: Path | None = None
    root: Path | None = None
    options: Options = field(default_factory=dict)


@dataclass(frozen=True)
class Before:
    """A training that has to come first, such as a codebook's: its checkpoint is ``{name}`` in the options."""

    name: str
    config: str
    options: Options = field(default_factory=dict)


@dataclass(frozen=True)
class MethodEntry:
    """A row of the table, or one for each variant.

    Attributes:
        name: by which the plan calls it.
        label: by which tables call it.
        config: experiment config that trains it; ``{corpus}`` stands for the corpus's name.
        checkpoint: a trained model, one for each seed if it has ``{seed}``.
        predictions: a folder of predicted motion, with the same fields in its path.
        options: of the training, or of ``facediff evaluate`` for predictions.
        test_options: of the test.
        before: trainings that come first.
        published: its name in tables of papers.
        corpora: those that it is run on; all if None.
        seeds: instead of the plan's.
        variants: names of the plan's variants that it is run in; all if None.
    """

    name: str
    label: str
    config: str | None = None
    checkpoint: str | None = None
    predictions: str | None = None
    options: Options = field(default_factory=dict)
    test_options: Options = field(default_factory=dict)
    before: tuple[Before, ...] = ()
    published: str = ""
    corpora: tuple[str, ...] | None = None
    seeds: tuple[int, ...] | None = None
    variants: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Variant:
    """Options that make another row of every method, such as one of an ablation."""

    name: str
    label: str
    options: Options = field(default_factory=dict)
    published: str = ""


@dataclass(frozen=True)
class BenchmarkPlan:
    """A benchmark.

    Attributes:
        name: the file's name without its suffix.
        file: the file.
        title: of the tables.
        description: what they are of.
        protocol: by which all is scored.
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
        corpora: by name.
        methods: by name.
        variants: by name.
        published: tables of papers that are shown next to it, by their name in :mod:`facediff.benchmark.published`.
    """

    name: str
    file: Path
    title: str
    description: str
    protocol: str
    metrics: tuple[str, ...]
    columns: tuple[str, ...]
    seeds: tuple[int, ...]
    baseline: str
    weights: Weights
    threads: int
    workers: int | None
    options: Options
    test_options: Options
    references: tuple[str, ...]
    corpora: Mapping[str, CorpusEntry]
    methods: Mapping[str, MethodEntry]
    variants: Mapping[str, Variant]
    published: tuple[str, ...]


class Section:
    """A mapping of the plan, whose values are read with what errors call them."""

    def __init__(self, content: object, place: str, keys: Sequence[str] | None) -> None:
        if not isinstance(content, dict):
            raise FaceDiffError(f"{place}: is {quoted(content)}; expected keys with values")
        for key in content:
            if not isinstance(key, str) or (keys is not None and key not in keys):
                raise FaceDiffError(f"{place}: there is no key {quoted(key)}: {choices(str(key), keys or ())}")
        self.content, self.place = content, place

    def text(self, key: str, default: str | None = None) -> str:
        """A text."""
        value = self.content.get(key, default)
        if not isinstance(value, str) or not value.strip():
            raise FaceDiffError(f"{self.place}: {key} is {quoted(value)}; expected a text")
        return value

    def optional(self, key: str) -> str | None:
        """A text that may be missing."""
        return None if self.content.get(key) is None else self.text(key)

    def file(self, key: str) -> str | None:
        """The path of a file or folder, which may be missing."""
        text = self.optional(key)
        names = [] if text is None else text.encode(errors="surrogatepass").split(b"/")
        if "\0" in (text or "") or any(len(name) > LONGEST_NAME for name in names) or len(names) > LONGEST_NAME:
            raise FaceDiffError(f"{self.place}: {key} is {quoted(text)}; expected the path of a file, with short names")
        return text

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of texts; empty if it is missing."""
        value = self.content.get(key) or []
        value = [value] if isinstance(value, str) else value
        if not isinstance(value, list) or not all(isinstance(entry, str) and entry.strip() for entry in value):
            raise FaceDiffError(f"{self.place}: {key} is {quoted(value)}; expected a list of texts")
        if len({*value}) < len(value):
            raise FaceDiffError(f"{self.place}: {key} names something twice; name each once")
        return tuple(value)

    def names(self, key: str, allowed: Sequence[str], what: str) -> tuple[str, ...] | None:
        """A list of names that are known; None if it is missing."""
        if self.content.get(key) is None:
            return None
        names = self.texts(key)
        for name in names:
            if name not in allowed:
                raise FaceDiffError(f"{self.place}: {key}: there is no {what} {quoted(name)}: {choices(name, allowed)}")
        return names

    def number(self, key: str, default: int | None, most: int) -> int | None:
        """A whole number from 1."""
        value = self.content.get(key, default)
        if value is not None and (not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most):
            raise FaceDiffError(f"{self.place}: {key} is {quoted(value)}; expected a whole number from 1 to {most}")
        return value

    def seeds(self, key: str) -> tuple[int, ...] | None:
        """Seeds of training runs; None if the key is missing."""
        value = self.content.get(key)
        if value is None:
            return None
        fits = isinstance(value, list) and all(
            isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed <= LARGEST_SEED for seed in value
        )
        if not fits or not value or len({*value}) < len(value):
            raise FaceDiffError(
                f"{self.place}: {key} is {quoted(value)}; expected a list of different whole numbers, such as [0, 1, 2]"
            )
        return tuple(value)

    def options(self, key: str, form: re.Pattern[str] = OPTION) -> dict[str, Any]:
        """Options of a command by name, without dashes."""
        content = self.content.get(key) or {}
        section = Section(content, f"{self.place}: {key}", None)
        for name in section.content:
            if not form.fullmatch(name):
                raise FaceDiffError(
                    f"{section.place}: {quoted(name)} is no option; expected such as trainer.max_epochs, without dashes"
                )
        if "seed_everything" in section.content:
            raise FaceDiffError(f"{section.place}: seed_everything; the seeds of a plan are its key `seeds`")
        return dict(section.content)

    def sections(self, key: str, keys: Sequence[str]) -> dict[str, Section]:
        """Named mappings, in the order of the file."""
        content = self.content.get(key) or {}
        sections = {}
        for name, value in Section(content, f"{self.place}: {key}", None).content.items():
            if not NAME.fullmatch(name):
                raise FaceDiffError(f"{self.place}: {key}: {quoted(name)}; expected a short name of letters and digits")
            sections[name] = Section({} if value is None else value, f"{self.place}: {key}: {name}", keys)
        return sections


def find_plan(path: Path) -> Path:
    """The file of a plan; those of the package are found by ``configs/benchmark/NAME.yaml``, and by NAME alone."""
    if path.is_file():
        return path
    named = path if path.suffix == ".yaml" else Path(f"{path}.yaml")
    bundled = config_dir().parent / path if path.parts[:1] == ("configs",) else config_dir() / "benchmark" / named
    if bundled.is_file():
        return bundled
    bundled_plans = [f"configs/benchmark/{file.name}" for file in sorted((config_dir() / "benchmark").glob("*.yaml"))]
    raise FaceDiffError(f"{path}: no such plan; {choices(str(path), bundled_plans)}")


def read_plan(path: Path, roots: Mapping[str, Path] | None = None) -> BenchmarkPlan:
    """Read a plan and check all that can be checked without running anything.

    Args:
        path: a YAML file.
        roots: folders of corpora by the plan's names, which override the plan's.
    """
    return plan_of(load_yaml(path, "expected a plan such as configs/benchmark/quick.yaml"), path, roots or {})


def plan_of(content: object, path: Path, roots: Mapping[str, Path]) -> BenchmarkPlan:
    """The plan in plain data; see :func:`read_plan`."""
    top = Section(content, str(path), KEYS)
    corpora = {
        name: _corpus(name, section, roots, path) for name, section in top.sections("corpora", CORPUS_KEYS).items()
    }
    if not corpora:
        raise FaceDiffError(f"{path}: names no corpus; expected `corpora:` with one at least, such as puppet: {{}}")
    for name in roots:
        if name not in corpora:
            raise FaceDiffError(f"--root {name}: the plan has no such corpus: {choices(name, corpora)}")
    variants = {
        name: Variant(
            name, section.text("label", name), section.options("options"), section.optional("published") or ""
        )
        for name, section in top.sections("variants", VARIANT_KEYS).items()
    }
    methods = {
        name: _method(name, section, corpora, variants, path)
        for name, section in top.sections("methods", METHOD_KEYS).items()
    }
    if not methods:
        raise FaceDiffError(f"{path}: names no method; expected `methods:` with one at least")
    seeds = top.seeds("seeds")
    for method in methods.values():
        if seeds is None and method.seeds is None and (method.config is not None or _per_seed(method)):
            raise FaceDiffError(
                f"{path}: methods: {method.name} is trained, and the plan has no seeds; add `seeds: [0, 1, 2]`, since "
                f"one training run says nothing of the chance between runs"
            )
    weights = top.content.get("weights", "last")
    if weights not in ("last", "best"):
        raise FaceDiffError(f"{path}: weights is {quoted(weights)}; expected last or best")
    references = top.names("references", REFERENCES, "reference")
    return BenchmarkPlan(
        name=path.stem,
        file=path,
        title=top.text("title", path.stem),
        description=top.optional("description") or "",
        protocol=top.text("protocol", "paper"),
        metrics=top.texts("metrics"),
        columns=top.texts("columns"),
        seeds=seeds or (),
        baseline=top.optional("baseline") or "",
        weights=weights,
        threads=top.number("threads", 1, 1024) or 1,
        workers=top.number("workers", None, 1024),
        options=top.options("options"),
        test_options=top.options("test_options"),
        references=REFERENCES if references is None else references,
        corpora=corpora,
        methods=methods,
        variants=variants,
        published=top.texts("published"),
    )


def check_scores(plan: BenchmarkPlan) -> None:
    """Refuse a protocol, a metric, a column or a published table of a plan that there is none of.

    Apart from :func:`read_plan`, since it imports PyTorch.
    """
    from facediff.benchmark.published import find_published
    from facediff.evaluation.evaluator import find_protocols
    from facediff.metrics.by_name import parse_all
    from facediff.metrics.generation import SMOOTHNESS

    try:
        (protocol,) = find_protocols([plan.protocol])
        parse_all(plan.metrics)
        find_published(plan.published)
    except FaceDiffError as error:
        raise FaceDiffError(f"{plan.file}: {error}") from error
    scores = [*(["mve"] if protocol.mve else []), "lve", *protocol.deviations(), *plan.metrics, *SMOOTHNESS, *COSTS]
    for column in plan.columns:
        # A metric of several scores gives each its own name behind.
        if column not in scores and not column.startswith(tuple(f"{name}_" for name in plan.metrics)):
            raise FaceDiffError(f"{plan.file}: columns: there is no score {column!r}: {choices(column, scores)}")


def _corpus(name: str, section: Section, roots: Mapping[str, Path], path: Path) -> CorpusEntry:
    data, root = section.optional("data"), section.file("root")
    folder = roots.get(name) or (None if root is None else _beside(path, root))
    if folder is not None and not folder.is_dir():
        raise FaceDiffError(f"{folder}: no such folder; expected the corpus {name}, give it with --root {name}=FOLDER")
    file = None if data is None else find_config(data, f"{section.place}: data", path)
    return CorpusEntry(name, section.text("label", name), file, folder, section.options("options"))


def _method(
    name: str,
    section: Section,
    corpora: Mapping[str, CorpusEntry],
    variants: Mapping[str, Variant],
    path: Path,
) -> MethodEntry:
    sources = [source for source in SOURCES if section.content.get(source) is not None]
    if len(sources) != 1:
        raise FaceDiffError(
            f"{section.place}: has {' and '.join(sources) or 'no source'}; expected one of config, checkpoint and "
            f"predictions"
        )
    chosen = section.names("corpora", list(corpora), "corpus")
    before = tuple(
        Before(step, options.file("config") or options.text("config"), options.options("options"))
        for step, options in section.sections("before", BEFORE_KEYS).items()
    )
    for config in [section.file("config"), *(step.config for step in before)]:
        for corpus in chosen or corpora if config else ():
            find_config(str(config).replace("{corpus}", corpus), f"{section.place}: config", path)
    form = OPTION if sources[0] == "config" else re.compile(r"[a-z][\w-]*")
    if sources[0] == "checkpoint" and section.content.get("options"):
        raise FaceDiffError(f"{section.place}: options are of training, and a checkpoint is trained; use test_options")
    return MethodEntry(
        name=name,
        label=section.text("label", name),
        config=section.file("config"),
        checkpoint=section.file("checkpoint"),
        predictions=section.file("predictions"),
        options=section.options("options", form),
        test_options=section.options("test_options"),
        before=before,
        published=section.optional("published") or "",
        corpora=chosen,
        seeds=section.seeds("seeds"),
        variants=section.names("variants", list(variants), "variant"),
    )


def _per_seed(method: MethodEntry) -> bool:
    return "{seed}" in f"{method.checkpoint} {method.predictions}"


def _beside(plan: Path, text: str) -> Path:
    """A path of the plan: from the working folder, or else from the plan's own."""
    path = Path(text).expanduser()
    return (
        path
        if path.is_absolute() or path.exists()
        else next((candidate for candidate in [plan.parent / path] if candidate.exists()), path)
    )


def find_config(text: str, place: str, plan: Path) -> Path:
    """The file of a config: bundled ones begin with ``configs/``."""
    bundled = config_dir() / text.removeprefix("configs/")
    own = _beside(plan, text)
    if own.is_file():
        return own
    if text.startswith("configs/") and bundled.is_file():
        return bundled
    folder = Path(text).parent.name
    configs = [f"configs/{folder}/{file.name}" for file in sorted((config_dir() / folder).glob("*.yaml"))]
    near = difflib.get_close_matches(text, configs, n=3, cutoff=0.3)
    hint = (
        f"the nearest are {', '.join(near)}" if near else "expected a YAML file such as configs/experiment/puppet.yaml"
    )
    raise FaceDiffError(f"{place} {text}: no such config; {hint}")
