"""``facediff benchmark`` and ``facediff benchmark report``: tables of methods, corpora and seeds from one command."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from facediff.cli.options import OutputFolder, Scheduler, Seed, Workers
from facediff.cli.process import tell
from facediff.errors import FaceDiffError, check_known, counted, number
from facediff.registry import COMPONENTS, alias_path, find_class
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.benchmark import BenchmarkPlan, BenchmarkReport, Cell
    from facediff.benchmark.running import Setting
    from facediff.cli.lightning_cli import Parsed
    from facediff.data import SpeechMotionDataModule

RESAMPLES = 2000


def benchmark(
    plan: Annotated[Path, Option(metavar="PLAN", reads=True)],
    *,
    output: OutputFolder = Path("benchmarks"),
    root: Annotated[list[str] | None, Option(metavar="CORPUS=FOLDER", reads=True)] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    retry_failed: bool = False,
    dry_run: bool = False,
) -> int:
    """Train and score the methods of a plan on its corpora with its seeds, and write the tables.

    PLAN is a YAML file; those that come with facediff are configs/benchmark/quick.yaml and others. Each cell, a method
    on a corpus with a seed, is trained and tested in processes of its own, several cells at a time. Nothing is
    done twice: after any interruption, the same command continues. A cell that fails stops no other.
    Exit status: 0 all done, 1 some cells failed, 2 something to put right.

    For example:
      facediff benchmark configs/benchmark/quick.yaml
      facediff benchmark configs/benchmark/table1_biwi.yaml --root biwi=BIWI --dry-run

    Args:
        plan: the plan, see docs/benchmark.md
        output: folder for benchmarks; each plan gets one of its name below it
        root: folder of one of the plan's corpora; repeatable
        workers: cells at a time (default: the plan's, or as many as processors allow)
        scheduler: where tasks run: processes, threads, or tcp://HOST:PORT of a Dask cluster (docs/cluster.md)
        retry_failed: try cells again that failed
        dry_run: list the cells that would run
    """
    from facediff.benchmark.plan import check_scores, find_plan, read_plan
    from facediff.utils.jobs import is_cluster
    from facediff.utils.workers import processors

    definition = read_plan(find_plan(plan), corpus_folders(root or []))
    from facediff.benchmark.cells import cells_of
    from facediff.benchmark.outline import outline_of, read_results, write_outline
    from facediff.benchmark.running import pending, run_cells
    from facediff.utils.files import locked

    check_scores(definition)
    cells = cells_of(definition)
    folder = output / definition.name
    left = pending(cells, folder, retry_failed=retry_failed)
    count = (
        workers or definition.workers or (None if is_cluster(scheduler) else max(1, processors() // definition.threads))
    )
    setting, tests = check_cells(definition, left, folder, dry_run=dry_run)
    announce(definition, cells, left, tests, count)
    if dry_run:
        return 0
    roots = [word for folder_of_corpus in root or [] for word in ("--root", folder_of_corpus)]
    command = shlex.join(["facediff", "benchmark", str(plan), *roots])
    failed = 0
    with locked(folder / "benchmark.lock", "facediff benchmark"):
        outline = outline_of(definition, cells, command)
        write_outline(folder, outline)
        with closing(run_cells(left, setting, workers=count, scheduler=scheduler)) as outcomes:
            for number, (cell, outcome) in enumerate(outcomes, 1):
                failed += bool(outcome.problem)
                outcome_text = outcome.problem or f"{cell}: {outcome.seconds:.0f} s"
                tell(f"[{number}/{len(left)}] {outcome_text}")
        results, _ = read_results(folder, outline)
        old = sum(1 for result in results if result.problem) - failed
        if old:
            tell(f"{counted(old, 'cell')} had failed before; --retry-failed runs them again")
        if all(result.problem for result in results):
            raise FaceDiffError(f"every cell failed, the first: {next(result.problem for result in results)}")
        write_and_tell(folder, None, RESAMPLES, 0.95, 0, None)
    return 1 if failed or old else 0


def report(
    folders: Annotated[list[Path], Option(metavar="FOLDER", reads=True)],
    *,
    output: Annotated[Path | None, Option(also="-o", metavar="OUT", writes="folder")] = None,
    baseline: Annotated[str | None, Option(metavar="ROW")] = None,
    bootstrap: Annotated[ranges.Resamples, Option(metavar="N")] = RESAMPLES,
    level: Annotated[ranges.Level, Option(metavar="P")] = 0.95,
    seed: Seed = 0,
    page: Annotated[Path | None, Option(metavar="FILE", writes="file")] = None,
) -> None:
    """Write the tables of benchmarks again: Markdown, LaTeX, CSV, and a page for the browser.

    They are in report/ of each folder, unless --output says otherwise. Nothing is trained or tested; cells that are not
    done yet are named.

    For example:
      facediff benchmark report benchmarks/quick
      facediff benchmark report benchmarks/convergence benchmarks/puppet_table3 --page tables.md

    Args:
        folders: folders of benchmarks, such as benchmarks/quick
        output: folder for the files, with names that begin with the plan's (default: report/ of each folder)
        baseline: the row that all others are compared with (default: the plan's)
        bootstrap: resamples of the sentences for intervals; 0: none
        level: of the intervals; a corrected p below 1 - level is significant
        seed: of resamples and permutations
        page: a Markdown page with marked blocks for the tables of named plans
    """
    from facediff.benchmark.outline import read_outline
    from facediff.benchmark.plan import MEAN_SUFFIX

    for folder in folders:
        rows = [row + suffix for row in read_outline(folder).rows for suffix in ("", MEAN_SUFFIX)]
        check_known(f"--baseline: {folder}", "row", [baseline] if baseline else [], rows)
    for folder in folders:
        written = write_and_tell(folder, baseline, bootstrap, level, seed, output)
        if page is not None:
            from facediff.benchmark.writing import replace_block

            replace_block(page, written)
            tell(f"written: {page}")


def corpus_folders(arguments: Sequence[str]) -> dict[str, Path]:
    """Folders of corpora, from words CORPUS=FOLDER."""
    folders: dict[str, Path] = {}
    for word in arguments:
        name, _, folder = word.partition("=")
        if not name or not folder or name in folders:
            raise FaceDiffError(f"--root {word}: expected CORPUS=FOLDER, such as biwi=BIWI, once for each corpus")
        folders[name] = Path(folder)
    return folders


def announce(
    plan: BenchmarkPlan,
    cells: Sequence[Cell],
    left: Sequence[Cell],
    tests: Mapping[tuple[str, str], str],
    workers: int | None,
) -> None:
    """List the cells that will run, with the size of their tests."""
    from facediff.utils.text_tables import format_table

    at_a_time = f"{workers} at a time" if workers else "one on each worker at a time"
    tell(f"{plan.title}: {counted(len(cells), 'cell')}, {len(cells) - len(left)} done, {len(left)} to run, {at_a_time}")
    if not left:
        return
    rows = [[str(cell), cell.kind, tests.get((cell.row, cell.corpus))] for cell in left]
    tell(*format_table(["to run", "", "test generates"], rows, left=2).split("\n"))


def write_and_tell(
    folder: Path, baseline: str | None, resamples: int, level: float, seed: int, output: Path | None
) -> BenchmarkReport:
    """Make a report from the results on the disk, write it and print it."""
    from facediff.benchmark.outline import read_outline, read_results
    from facediff.benchmark.tables import report_of
    from facediff.benchmark.writing import text, write_report

    outline = read_outline(folder)
    results, pending_cells = read_results(folder, outline)
    report = report_of(outline, results, pending_cells, baseline=baseline, resamples=resamples, level=level, seed=seed)
    files = write_report(report, output or folder / "report")
    tell(*text(report).split("\n"), *(f"written: {path}" for path in files))
    return report


# Checks before anything runs.


def check_cells(
    plan: BenchmarkPlan, left: Sequence[Cell], folder: Path, *, dry_run: bool
) -> tuple[Setting, dict[tuple[str, str], str]]:
    """Parse every command to be run, find every corpus, and make the built-in one."""
    from facediff.benchmark.running import Setting, fit_options, option_words
    from facediff.cli.lightning import parse_fit

    setting = Setting(folder, plan.protocol, plan.metrics, plan.weights, plan.threads)
    parsed: dict[str, tuple[Parsed, Parsed]] = {}
    prepared: dict[str, SpeechMotionDataModule] = {}
    clips: dict[str, dict[str, str]] = {}
    truths: dict[str, tuple[str, ...]] = {}
    classes: dict[str, str] = {}
    models: dict[str, dict[str, str]] = {}
    roots: dict[str, str] = {}
    tests: dict[tuple[str, str], str] = {}
    kinds: dict[str, type[SpeechMotionDataModule]] = {}
    for cell in left:
        for training in cell.trainings:
            # A checkpoint of an earlier training does not exist yet: options that name it are left out.
            earlier = {f"{{{step.name}}}" for step in cell.trainings}
            options = {
                name: value for name, value in fit_options(training, {}, cell).items() if str(value) not in earlier
            }
            command_line = ["--config", str(training.config), *option_words({**options, "seed_everything": 0})]
            mark = " ".join(command_line)
            with naming(plan, cell):
                if mark not in parsed:
                    parsed[mark] = parse_fit(command_line)
                (model_class, model_options), (class_path, arguments) = parsed[mark]
                models[cell.row] = own_classes(model_class, model_options)
                if not class_path.startswith("facediff."):
                    classes[cell.corpus] = class_path
                data = data_of(prepared, class_path, arguments, make=not dry_run)
                kinds[cell.corpus] = type(data)
                if (cell.row, cell.corpus) not in tests and data.root.is_dir():
                    tests[cell.row, cell.corpus] = cost_of_test(cell, model_options, data)
        if cell.kind == "checkpoint" and cell.data is not None:
            class_path, arguments = read_data(cell.data)
            kinds[cell.corpus] = data_class(class_path)
            if not class_path.startswith("facediff.") and "." in class_path:
                classes[cell.corpus] = class_path
            # A published model names no folder, and one of another machine names a folder that is not here.
            if arguments.get("root") is not None:
                roots[cell.corpus] = str(arguments["root"])
        if cell.kind == "predictions" and cell.corpus not in truths and cell.data is not None:
            with naming(plan, cell):
                class_path, arguments = read_data(cell.data)
                arguments |= {} if cell.root is None else {"root": str(cell.root)}
                data = data_of(prepared, class_path, arguments, make=not dry_run)
                if not (dry_run and not data.root.is_dir()):
                    truths[cell.corpus] = truth_words(data)
                    clips[cell.corpus] = {clip.name: split for split in data.test_splits for clip in data.clips(split)}
    for cell in left:
        if cell.kind == "checkpoint":
            with naming(plan, cell):
                check_checkpoint(cell, kinds.get(cell.corpus), classes.get(cell.corpus), roots.get(cell.corpus))
    return replace(setting, clips=clips, truths=truths, classes=classes, models=models, roots=roots), tests


def own_classes(model: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Options that name the classes of a model that are neither part of facediff nor registered."""
    paths = {kind.kind: str(options.get(f"{kind.kind}.class_path")) for kind in COMPONENTS.values()}
    classes = {name: find_class(COMPONENTS[name], path, object) for name, path in paths.items()}
    own = {f"model.{name}": path for name, path in paths.items() if classes[name] and alias_path(classes[name]) == path}
    return {option: path for option, path in {"model": model, **own}.items() if not path.startswith("facediff.")}


def cost_of_test(cell: Cell, model: Mapping[str, Any], data: SpeechMotionDataModule) -> str:
    """How many animations of how many sampling steps a trained cell's test generates, in words."""
    from facediff.models.evaluation import count_generations

    tested = cell.test_options
    data = type(data)(**{name: tested.get(f"data.{name}", value) for name, value in data.hparams.items()})
    policy = tested.get("model.unseen_identity", model.get("unseen_identity", ""))
    samples = tested.get("model.test_samples", model.get("test_samples", 1))
    steps = tested.get("model.sampler.steps", model.get("sampler.init_args.steps"))
    return number(count_generations(data, policy, samples)) + (f" × {counted(steps, 'step')}" if steps else "")


@contextmanager
def naming(plan: BenchmarkPlan, cell: Cell) -> Iterator[None]:
    """Errors inside it name the plan, the row and the corpus, and how its folder is given if they are about that."""
    try:
        yield
    except FaceDiffError as error:
        remedy = f"; give the corpus's folder with --root {cell.corpus}=FOLDER" if "root" in str(error) else ""
        raise FaceDiffError(f"{plan.file}: {cell.row} on {cell.corpus}: {error}{remedy}") from error


def check_checkpoint(
    cell: Cell, kind: type[SpeechMotionDataModule] | None, class_path: str | None, root: str | None
) -> None:
    """Refuse a checkpoint of another corpus than the plan's, or without its corpus on this machine."""
    from facediff.cli.lightning import corpus_and_folder
    from facediff.models.checkpoint import read_checkpoint

    path = Path(str(cell.source))
    module_name = cell.test_options.get("data") or class_path
    folder = cell.root or (None if root is None else Path(root))
    corpus = None if module_name is None else str(module_name)
    module, options = corpus_and_folder(path, read_checkpoint(path), corpus, folder)
    if kind is not None and module.corpus_name != kind.corpus_name:
        raise FaceDiffError(
            f"{path}: is a model of {module.corpus_name}, and the plan's corpus is {kind.corpus_name}; list the "
            f"model's corpora under the method's key `corpora`"
        )
    require_folder(module, options.get("root"))


def require_folder(module: type[SpeechMotionDataModule], root: object) -> None:
    """Refuse a corpus that is not here, unless it is the built-in one or at an address."""
    if not module.makes_itself and (
        root is None or ("://" not in str(root) and not Path(str(root)).expanduser().is_dir())
    ):
        raise module.missing(Path(str(root or f"{module.corpus_name} without data.root")))


def read_data(path: Path) -> tuple[str, dict[str, Any]]:
    """Class and options of a data module's config."""
    from facediff.utils.yaml_files import load_yaml

    content = load_yaml(path, "expected a config such as configs/data/biwi.yaml")
    return str(content.get("class_path")), dict(content.get("init_args") or {})


def data_class(class_path: str) -> type[SpeechMotionDataModule]:
    """The data module that a config names."""
    from facediff.cli.data import find_own_module
    from facediff.data.check.layouts import by_name

    if "." in class_path and not class_path.startswith("facediff."):
        find_own_module(class_path)
    name = class_path.rpartition(".")[2] if class_path.startswith("facediff.data.") else class_path
    return by_name(name, None, "class_path")


def data_of(
    modules: dict[str, SpeechMotionDataModule], class_path: str, arguments: Mapping[str, Any], *, make: bool
) -> SpeechMotionDataModule:
    """The data module of a config, each once; a built-in corpus is made, any other must be there."""
    mark = f"{class_path} {sorted((key, str(value)) for key, value in arguments.items())}"
    if mark not in modules:
        module = data_class(class_path)
        require_folder(module, arguments.get("root"))
        modules[mark] = module(**dict(arguments))
        if make:
            modules[mark].prepare_data()
    return modules[mark]


def truth_words(data: SpeechMotionDataModule) -> tuple[str, ...]:
    """How `facediff evaluate` is told of a corpus's truth."""
    stride = data.corpus.stride
    return (str(data.root), *(["--truth-stride", str(stride)] if stride > 1 else []))
