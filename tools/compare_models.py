"""Trains both models on the built-in corpus and prints what they can do, side by side.

    python tools/compare_models.py -o comparison

About 20 minutes on two CPU cores. Figures on the built-in corpus are synthetic: they say nothing about real people.
Checkpoints that exist already in the output folder are not trained again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from facediff.cli.adapt import adapt
from facediff.cli.lightning import run_cli
from facediff.data import Puppet, collate
from facediff.models import AnimationModel, StyleContentDisentanglement, load_model
from facediff.speech.audio import SAMPLE_RATE
from facediff.synthetic import SEEN_IDENTITIES, UNSEEN_IDENTITIES

SYSTEMS = {
    "dual-path diffusion": ("configs/experiment/puppet.yaml", 60),
    "style-content": ("configs/experiment/puppet_style_content.yaml", 40),
}
"""Config and epochs, so that all of it takes less than 20 minutes."""
PROBE_STEPS = 300
Row = dict[str, Any]


def main(words: Sequence[str] | None = None) -> int:
    """Train what is not there, measure, print and write ``comparison.json``."""
    made = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    made.add_argument("-o", "--output", type=Path, default=Path("comparison"), help="folder of checkpoints and results")
    made.add_argument("--epochs", type=int, help="training epochs (default: 60 and 40)")
    made.add_argument("--adapt-epochs", type=int, default=60, help="epochs of adapting (default: 60)")
    made.add_argument("--only", choices=list(SYSTEMS), help="one model")
    args = made.parse_args(words)
    args.output.mkdir(parents=True, exist_ok=True)
    started, rows = time.monotonic(), []
    for name, (config, epochs) in SYSTEMS.items():
        if args.only in (None, name):
            rows.append(measure(name, config, args.epochs or epochs, args))
    (args.output / "comparison.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    print(table(rows))
    print(f"in {time.monotonic() - started:.0f} s, synthetic corpus; written: {args.output / 'comparison.json'}")
    return 0


def measure(name: str, config: str, epochs: int, args: argparse.Namespace) -> Row:
    """All figures of one model."""
    path = args.output / f"{name.replace(' ', '_')}.ckpt"
    started = time.monotonic()
    if not path.is_file():
        options = [f"--trainer.max_epochs={epochs}", "--data.edition=1", "--data.drawn_speakers=0"]
        options += [f"--trainer.logger.save_dir={args.output}", "--trainer.logger.name=training"]
        run_cli("fit", ["--config", config, *options]).trainer.save_checkpoint(path)
    row: Row = {"model": name, "training seconds": round(time.monotonic() - started)}
    model, data = load_model(path), Puppet(edition=1)
    data.prepare_data()
    row["parameters"] = sum(p.numel() for p in model.parameters())
    row |= scores(path)
    row["real-time factor"] = real_time_factor(model, data)
    row["style: nearest speaker"] = style_accuracy(model, data)
    if isinstance(model, StyleContentDisentanglement):
        row["content: speaker by linear probe"] = content_probe(model, data)
        row |= swaps(model, data)
    for person in UNSEEN_IDENTITIES:
        adapted = path.with_name(f"{path.stem}_{person}.ckpt")
        if not adapted.is_file():
            adapt(
                checkpoint=path,
                person=person,
                output=adapted,
                epochs=args.adapt_epochs,
                accelerator="cpu",
                quiet=True,
            )
        before, after = (person_lve(load_model(each), data, person) for each in (path, adapted))
        row[f"{person} LVE before adapting"], row[f"{person} LVE after"] = before, after
        row[f"{person} LVE, after to before"] = after / before
    return row


def scores(path: Path) -> Row:
    """The test's scores, with the still face's LVE beside."""
    words = ["--ckpt_path", str(path), "--trainer.accelerator=cpu", "--trainer.logger=false"]
    words.append(f"--trainer.default_root_dir={path.parent}")
    metrics = run_cli("test", words).trainer.callback_metrics
    found: Row = {}
    for split in ("test_a", "test_b"):
        for metric in ("mve", "lve", "fdd"):
            found[f"{split} {metric.upper()}"] = float(metrics[f"{split}/{metric}"])
        found[f"{split} LVE to still face's"] = float(metrics[f"{split}/lve"] / metrics[f"{split}/still/lve"])
    return found


@torch.inference_mode()
def real_time_factor(model: AnimationModel, data: Puppet, seconds: int = 10) -> float:
    """Time for ten seconds of speech, by that time; the better of two."""
    clip = data.clips("test_a")[0]
    audio = data.corpus.read_audio(clip, 0, data.corpus.frames(clip))
    speech = audio.repeat(-(-seconds * SAMPLE_RATE // len(audio)))[: seconds * SAMPLE_RATE]
    taken = []
    for _ in range(2):
        started = time.monotonic()
        model.animate(speech, identity=SEEN_IDENTITIES[0])
        taken.append(time.monotonic() - started)
    return min(taken) / seconds


def held_out(data: Puppet) -> list[Any]:
    """The test clips of all eight speakers."""
    return [
        sample
        for split in ("test_a", "test_b")
        for sample in map(data.dataset(split).__getitem__, range(len(data.clips(split))))
    ]


def styles(model: AnimationModel, samples: Sequence[Any]) -> torch.Tensor:
    """A style vector for every clip, from its own motion."""
    return torch.stack(
        [model.encode_style(s.motion[None], torch.ones(1, len(s.motion), dtype=torch.bool))[0] for s in samples]
    )


@torch.inference_mode()
def style_accuracy(model: AnimationModel, data: Puppet) -> float:
    """Share of held-out clips whose nearest other held-out clip, by style vector, is of the same speaker."""
    samples = held_out(data)
    vectors = styles(model, samples)
    distances = torch.cdist(vectors, vectors).fill_diagonal_(torch.inf)
    nearest = distances.argmin(1).tolist()
    return sum(samples[i].identity_name == samples[n].identity_name for i, n in enumerate(nearest)) / len(samples)


def contents(model: StyleContentDisentanglement, samples: Sequence[Any]) -> list[torch.Tensor]:
    """Content of each clip's motion, (frames, content_dim)."""
    with torch.inference_mode():
        return [
            model.encode_content(s.motion[None], torch.ones(1, len(s.motion), dtype=torch.bool))[0] for s in samples
        ]


def content_probe(model: StyleContentDisentanglement, data: Puppet) -> float:
    """How often a linear classifier names the speaker from one frame's content; chance is 0.125.

    Fitted on three held-out sentences of each speaker, scored on the two others, every speaker counting alike.
    """
    samples = held_out(data)
    identities = sorted({s.identity_name for s in samples})
    features = contents(model, samples)
    fitted = [i for i, s in enumerate(samples) if s.sentence in ("e28", "e29", "e30")]
    scored = [i for i in range(len(samples)) if i not in fitted]
    x = torch.cat([features[i] for i in fitted]).clone()
    y = torch.cat([torch.full((len(features[i]),), identities.index(samples[i].identity_name)) for i in fitted])
    mean, spread = x.mean(0), x.std(0).clamp_min(1e-6)
    probe = torch.nn.Linear(x.shape[1], len(identities))
    optimiser = torch.optim.LBFGS(probe.parameters(), max_iter=PROBE_STEPS, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        loss = torch.nn.functional.cross_entropy(probe((x - mean) / spread), y)
        loss = loss + 1e-4 * probe.weight.square().sum()
        loss.backward()
        return loss

    optimiser.step(closure)
    hits: dict[str, list[float]] = {identity: [] for identity in identities}
    with torch.inference_mode():
        for i in scored:
            named = probe((features[i] - mean) / spread).argmax(1)
            hits[samples[i].identity_name] += (named == identities.index(samples[i].identity_name)).float().tolist()
    return sum(sum(each) / len(each) for each in hits.values()) / len(hits)


@torch.inference_mode()
def swaps(model: StyleContentDisentanglement, data: Puppet) -> Row:
    """Content of one speaker with the style of another who says the same held-out sentence.

    FDD as the released scripts have it: signed, and the mean over the sentences; of each ordered pair of speakers its
    absolute value, and the mean over these.
    """
    samples = {(s.identity_name, s.sentence): s for s in held_out(data)}
    upper = model.assets.regions["upper_face"]
    correlations: list[float] = []
    to_other: dict[tuple[str, str], list[float]] = {}
    to_source: dict[tuple[str, str], list[float]] = {}
    for (identity, sentence), source in samples.items():
        for other in (s for s in samples.values() if s.sentence == sentence and s.identity_name != identity):
            mask = torch.ones(1, len(source.motion), dtype=torch.bool)
            content = model.encode_content(source.motion[None], mask)
            style = model.encode_style(other.motion[None], torch.ones(1, len(other.motion), dtype=torch.bool))
            made = model.decode(content, style, mask)[0]
            openings = [opening(model, motion, source.template) for motion in (made, source.motion)]
            correlations.append(float(torch.corrcoef(torch.stack(openings))[0, 1]))
            pair = (identity, other.identity_name)
            to_other.setdefault(pair, []).append(deviation(made, other.motion, upper))
            to_source.setdefault(pair, []).append(deviation(made, source.motion, upper))
    other_fdd, source_fdd = (
        sum(abs(sum(each) / len(each)) for each in found.values()) / len(found) for found in (to_other, to_source)
    )
    return {
        "swap: lip-opening correlation with the source": sum(correlations) / len(correlations),
        "swap: FDD to the other's truth": other_fdd,
        "swap: FDD to the source's truth": source_fdd,
        "swap: FDD, other's to source's": other_fdd / source_fdd,
    }


def opening(model: AnimationModel, motion: torch.Tensor, template: torch.Tensor) -> torch.Tensor:
    """Mean distance between the inner lips, (frames,)."""
    pairs = model.assets.inner_lip_pairs
    assert pairs is not None
    face = motion + template
    return torch.linalg.vector_norm(face[:, pairs[:, 0]] - face[:, pairs[:, 1]], dim=-1).mean(1)


def deviation(motion: torch.Tensor, truth: torch.Tensor, upper: torch.Tensor) -> float:
    """Signed FDD of two motions that need not be equally long: spreads over time of the squared displacement.

    As :func:`facediff.metrics.face_dynamics_deviation` by default, which wants equal lengths.
    """
    spreads = [each[:, upper].double().square().sum(-1).std(0, correction=0) for each in (motion, truth)]
    return float((spreads[1] - spreads[0]).mean())


@torch.inference_mode()
def person_lve(model: AnimationModel, data: Puppet, person: str) -> float:
    """LVE (paper's protocol) of a person's test clips, each animated with the person's identity if it is known."""
    lips = model.assets.regions["lips"]
    total, frames = 0.0, 0
    dataset = data.dataset("test_b")
    for index, clip in enumerate(dataset.clips):
        if clip.identity != person:
            continue
        sample = dataset[index]
        sample.identity = model.assets.identity_index(person)
        motion = model.generate(collate([sample]))[0]
        error = (motion - sample.motion)[:, lips].double().square().sum(-1).amax(-1)
        total, frames = total + float(error.sum()), frames + len(error)
    return total / frames


def table(rows: Sequence[Row]) -> str:
    """Figures as lines, models as columns, in Markdown."""
    names = list(dict.fromkeys(itertools.chain.from_iterable(rows)))
    lines = ["| | " + " | ".join(str(row["model"]) for row in rows) + " |", "|---|" + "---|" * len(rows)]
    for name in names:
        if name != "model":
            lines.append(f"| {name} | " + " | ".join(shown(row.get(name)) for row in rows) + " |")
    return "\n".join(lines)


def shown(value: object) -> str:
    """A figure in three digits."""
    if isinstance(value, float):
        return f"{value:.3g}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


if __name__ == "__main__":
    warnings.filterwarnings("ignore", ".*isinstance.treespec, LeafSpec.*")
    raise SystemExit(main())
