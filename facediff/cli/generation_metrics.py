"""``facediff generation-metrics``: diversity, liveliness and calibration of a model's samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from facediff.animation.options import LicenceOptions
from facediff.cli.lightning import corpus_and_folder, prepared
from facediff.cli.options import Corpus, FileOrList, Folder, Seed
from facediff.cli.process import tell
from facediff.errors import check_known
from facediff.utils import ranges
from facediff.utils.hub import bundled_by_name, check_model_source, is_graphs
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule
    from facediff.models.generation_metrics import GenerationScores

SPLITS = ("val", "test_a", "test_b", "test_c")


@dataclass(frozen=True)
class SampleOptions:
    """Samples.

    Attributes:
        samples: samples of each clip, two at least
        references: samples of each clip with each of up to four references and labels
        sampler: sampler by name; see `facediff components sampler`
        steps: denoising steps of the sampler
        expressivity: 0 for the predicted mean, 1 for a sample (default: the checkpoint's)
        low_latency: frame by frame, as `facediff live` does
        seed: of the first sample; the others follow
    """

    samples: Annotated[ranges.Samples, Option(metavar="N")] = 10
    references: Annotated[ranges.Samples, Option(metavar="N")] = 2
    sampler: Annotated[str | None, Option(metavar="NAME")] = None
    steps: Annotated[ranges.Steps | None, Option(metavar="N")] = None
    expressivity: Annotated[str | None, Option(metavar="E")] = None
    low_latency: bool = False
    seed: Seed = 0


def generation_metrics(
    checkpoints: Annotated[list[Path], Option(metavar="CHECKPOINT", reads=True)],
    *,
    splits: Annotated[Sequence[str] | None, Option(metavar="NAME,…")] = None,
    max_clips: Annotated[ranges.Samples | None, Option(metavar="N")] = None,
    data_root: Folder = None,
    corpus: Corpus = None,
    eyelid_pairs: FileOrList = None,
    device: str = "cpu",
    json: Annotated[Path | None, Option(metavar="FILE", writes="file")] = None,
    csv: Annotated[Path | None, Option(metavar="FILE", writes="file")] = None,
    quiet: bool = False,
    samples: SampleOptions,
    licence: LicenceOptions,
) -> None:
    """Measure diversity, liveliness, calibration and errors of models' samples, on their corpus's test splits.

    Liveliness, spread over error, blinks, FDD, LVE of one sample, of the mean and of the best of several (as shares of
    a still face's and of the speaker's mean face's), energy scores, closures at p, b and m, whether the reference
    carries the speaker, and speed. Several checkpoints, such as three training seeds, give means and standard
    deviations.

    For example:
      facediff generation-metrics puppet --max-clips 10
      facediff generation-metrics a.ckpt b.ckpt c.ckpt --sampler ddpm --steps 1000 --samples 4 --json abc.json

    Args:
        checkpoints: trained models of one corpus: .ckpt files, or folders of `facediff export-model`
        splits: val, test_a, test_b, test_c (default: all test splits)
        max_clips: clips of a split at most, evenly spread, for a quick look (default: all)
        data_root: where the corpus is, if not where it was in training
        corpus: the corpus's class, if it is your own and no installed package registers it: package.module.Class
        eyelid_pairs: file with pairs of eyelid vertices (default: regions/eyelid_pairs.txt in the corpus's folder)
        device: cpu, cuda …
        json: write everything as JSON
        csv: write one row for each split and metric
        quiet: no progress bar
        samples: how many motions, and how they are sampled.
        licence: which models are refused.
    """
    checkpoints = [Path(bundled_by_name(path)) for path in checkpoints]
    for path in checkpoints:
        if not is_graphs(path):
            check_model_source(path)
    check_known("--splits", "split", splits or (), SPLITS)
    from facediff.models.base import load_model
    from facediff.models.generation_metrics import SamplingOptions, measure
    from facediff.pipelines.exported_model import ExportedModel
    from facediff.pipelines.trained import usable_device
    from facediff.utils.plain_files import write_json, write_rows
    from facediff.utils.progress import progress_bar

    word = samples.expressivity
    expressivity = None if word is None else ranges.EXPRESSIVITY.read("--expressivity", word)
    sampling = SamplingOptions(**{**vars(samples), "expressivity": expressivity})
    device = usable_device(device)
    data = corpus_of_checkpoint(checkpoints[0], data_root, corpus, eyelid_pairs)
    splits = list(dict.fromkeys(splits)) if splits else data.test_splits
    counts = [min(len(data.clips(name)), max_clips or 10**9) for name in splits]
    commercial_only = licence.commercial_only
    models = {
        str(path): partial(ExportedModel.open, path, data.assets(), commercial_only=commercial_only)
        if is_graphs(path)
        else partial(load_model, path, device, commercial_only=commercial_only)
        for path in checkpoints
    }
    with progress_bar("clips", sum(counts) * len(checkpoints), shown=not quiet) as step:
        scores = measure(models, data, splits=splits, sampling=sampling, most_clips=max_clips, step=step)
    if json is not None:
        write_json(json, scores.as_dict())
    if csv is not None:
        write_rows(csv, scores.rows())
    tell(*text(scores).split("\n"))


def corpus_of_checkpoint(
    checkpoint: Path, data_root: Path | None, corpus: str | None, eyelid_pairs: str | None
) -> SpeechMotionDataModule:
    """The corpus that a model was trained on; a folder of graphs has its name only."""
    from facediff.cli.data import find_own_module
    from facediff.data.check.layouts import by_name
    from facediff.models.checkpoint import read_checkpoint
    from facediff.runtime.folder import read_folder

    options: dict[str, Any]
    if is_graphs(checkpoint):
        find_own_module(corpus)
        module = by_name(corpus or read_folder(checkpoint)[0].corpus, None)
        options = {} if data_root is None else {"root": str(data_root)}
    else:
        module, options = corpus_and_folder(checkpoint, read_checkpoint(checkpoint), corpus, data_root)
    if eyelid_pairs is not None:
        options["eyelid_pairs"] = str(Path(eyelid_pairs).resolve())
    return prepared(module(**options))


def text(scores: GenerationScores) -> str:
    """The metrics as a table, one row each, under a line that names corpus, clips and sampler."""
    from facediff.models.generation_metrics import GENERATION_METRICS
    from facediff.utils.text_tables import format_table

    kind = "SYNTHETIC corpus" if scores.synthetic else "corpus"
    counts = ", ".join(f"{count} of {split}" for split, count in scores.clips.items())
    sampled = (
        f"{scores.samples} samples each" if scores.samples > 1 else "one motion each, since it has no noise: spread 0"
    )
    lines = [f"{kind} {scores.corpus}; clips: {counts}; {sampled}; {scores.sampler}"]
    if len(scores.checkpoints) > 1:
        lines.append(f"mean ± standard deviation over {len(scores.checkpoints)} checkpoints")
    rows = []
    for name in GENERATION_METRICS:
        cells: list[str | None] = []
        for split in scores.values:
            mean, deviation = scores.mean(split, name), scores.deviation(split, name)
            cell = None if mean is None else number(mean)
            if cell is not None and deviation is not None:
                cell += f" ± {number(deviation)}"
            cells.append(cell)
        if any(cell is not None for cell in cells):
            rows.append([scores.title(name), *cells])
    lines.append(format_table(["", *scores.values], rows))
    lines += [f"no value: {scores.title(name)}: {reason}" for name, reason in scores.missing.items()]
    return "\n".join(lines)


def number(value: float) -> str:
    """A number with three digits after the point, or in powers of ten where that would show nothing."""
    return f"{value:.3f}" if value == 0 or 0.01 <= abs(value) < 1000 else f"{value:.3e}"
