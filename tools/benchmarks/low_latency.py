"""Low latency: what it waits, what it costs, and what it takes from the motion, in one table.

    python tools/benchmarks/low_latency.py demo/puppet.ckpt

animates the test recordings of the model's corpus as a whole, by windows, and at low latency with other steps and
looking further or less far ahead; each animation is compared with the truth. Further checkpoints are rows of their own,
such as one of ``facediff adapt --low-latency``.

    python tools/benchmarks/low_latency.py --size

measures the cost of a frame at the size of VOCASET (5 023 vertices, 30 frames a second) with random weights, for two
widths of the network and two audio encoders.

All speech comes in pieces of 10 ms, as from a microphone. "Waits" is the speech between the start of a frame and the
sample that makes it certain; "computes" is the time from that sample to the finished vertices, median and 95 %.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from sampling_tables import processor

from facediff import registry
from facediff.data import Assets
from facediff.metrics import LipVertexError, MotionLiveliness
from facediff.models import AnimationModel, DualPathDiffusion, load_model
from facediff.models.audio_encoders import HubertEncoder
from facediff.models.checkpoint import corpus_class
from facediff.models.inference import Style
from facediff.pipelines.export_model import export_model
from facediff.reporting.documents import markdown_table
from facediff.runtime import RuntimeModel
from facediff.speech.audio import SAMPLE_RATE
from facediff.speech.windows import LOW_LATENCY, LOW_LATENCY_AHEAD, WindowPlan

Array = npt.NDArray[np.float32]
PIECE = SAMPLE_RATE // 100
GOAL = 0.2


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", type=Path, nargs="*")
    parser.add_argument("--clips", type=int, default=24, help="test recordings of each split (default: 24)")
    parser.add_argument("--size", action="store_true", help="cost at the size of VOCASET with random weights")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(arguments)
    torch.set_num_threads(args.threads)
    print(f"{processor('cpu')}; load {os.getloadavg()[0]:.1f}; {args.threads} threads\n")
    if args.size:
        print(sizes(args.threads))
    elif args.checkpoints:
        print(qualities(args.checkpoints, args.clips))
    else:
        parser.error("give a checkpoint, or --size")


@dataclass(frozen=True)
class Way:
    """A way to animate.

    Attributes:
        name: in the table.
        plan: the windows; None for the whole recording in one pass.
        steps: denoising steps; the model's own if None.
    """

    name: str
    plan: WindowPlan | None
    steps: int | None


def ways(rate: float) -> list[Way]:
    """The rows of the table for a first checkpoint."""
    frame = 1 / rate
    overlapping = replace(LOW_LATENCY_AHEAD, seconds=2 * frame, overlap=frame, after=LOW_LATENCY_AHEAD.after - frame)
    return [
        Way("whole recording", None, None),
        Way("whole recording, 2 steps", None, 2),
        Way("windows of 4 s", WindowPlan(above=0), None),
        Way("windows of 1 s", WindowPlan(1.0, 0.4, above=0), None),
        Way("low latency", LOW_LATENCY_AHEAD, 2),
        Way("low latency, 1 step", LOW_LATENCY_AHEAD, 1),
        Way("low latency, 10 steps", LOW_LATENCY_AHEAD, 10),
        Way("… hears 0.12 s ahead", replace(LOW_LATENCY_AHEAD, after=0.12), 2),
        Way("… hears 0.16 s ahead", replace(LOW_LATENCY_AHEAD, after=0.16), 2),
        Way("… hears 0.04 s ahead, shares 1 frame", overlapping, 2),
        Way("… a second of past", replace(LOW_LATENCY_AHEAD, past=1.0), 2),
        Way("… no noise ahead", LOW_LATENCY, 2),
    ]


def qualities(checkpoints: Sequence[Path], clips: int) -> str:
    """Latency, quality and cost as Markdown."""
    rows, base = [], dict[tuple[str, int], float]()
    for number, path in enumerate(checkpoints):
        model = load_model(path)
        source = model.data_source
        if not Path(source["root"]).is_dir():
            raise SystemExit(f"the corpus of the checkpoint ({source}) is not on this machine")
        data = corpus_class("--checkpoint", source)(root=source["root"])
        found = ways(model.frame_rate)
        for way in found if not number else [each for each in found if each.name in ("whole recording", "low latency")]:
            cells = [way.name if not number else f"{path.stem}: {way.name}"]
            waits, computing = 0.0, list[float]()
            scores = []
            for split in data.test_splits:
                lips, upper = (model.assets.regions[name] for name in ("lips", "upper_face"))
                error, lively = LipVertexError(lips), MotionLiveliness(upper)
                for sample in islice(data.dataset(split), clips):
                    motion = animated(model, way, sample.audio, sample.identity_name, len(sample.motion), computing)
                    error.update(motion, sample.motion)
                    lively.update(motion, sample.motion)
                scores.append((error.compute().item(), lively.compute().item()))
                base.setdefault((split, 0), scores[-1][0])
            if way.plan is not None:
                plan = way.plan.in_frames(model.frame_rate)
                waits = plan.look_ahead / model.frame_rate
            cells += [f"{waits * 1000:.0f}" if waits else "-", *times(computing)]
            for split, (error_of, liveliness) in zip(data.test_splits, scores, strict=True):
                cells += [f"{error_of / base[split, 0]:.2f}", f"{liveliness:.2f}"]
            rows.append(cells)
            print(" | ".join(cells), file=sys.stderr, flush=True)
    names = [name for split in data.test_splits for name in (f"LVE, {split}", f"liveliness, {split}")]
    return markdown_table(["way", "waits (ms)", "computes (ms)", "95 % (ms)", *names], rows)


@torch.inference_mode()
def animated(
    model: AnimationModel, way: Way, speech: torch.Tensor, identity: str, frames: int, computing: list[float]
) -> torch.Tensor:
    """Offsets (T, V, 3) of a recording; the seconds that each window took are added to ``computing``."""
    with model.choosing():
        if way.steps is not None:
            model.choose_sampler(steps=way.steps)
        if way.plan is None:
            made = model.animate(speech, identity=identity).vertices - model.assets.template(identity)
        else:
            stream = model.stream(identity=identity, plan=way.plan)
            made = torch.cat([*fed(stream.feed, speech, computing), stream.finish()], 1)[0]
    return made[:frames]


def fed(feed: Callable[[torch.Tensor], torch.Tensor], speech: torch.Tensor, spent: list[float]) -> list[torch.Tensor]:
    """What a stream gives for pieces of 10 ms, and the seconds that each part with frames took."""
    parts = []
    for piece in speech.split(PIECE):
        began = time.perf_counter()
        part = feed(piece)
        if part.shape[1]:
            spent.append(time.perf_counter() - began)
            parts.append(part)
    return parts


def times(seconds: Sequence[float]) -> list[str]:
    """Median and 95 % in milliseconds."""
    if not seconds:
        return ["-", "-"]
    return [f"{1000 * float(np.quantile(seconds, share)):.1f}" for share in (0.5, 0.95)]


def sizes(threads: int) -> str:
    """The cost of a frame at the size of VOCASET as Markdown."""
    rows = []
    for encoder in ("mel", "hubert base"):
        for dim, layers, steps in ((128, 4, 2), (256, 4, 2), (512, 6, 2), (512, 6, 1))[:: 1 if encoder == "mel" else 2]:
            model = random_model(encoder, dim, layers)
            model.low_latency_steps = steps
            model.choose_low_latency()
            plan = model.windows.in_frames(model.frame_rate)
            waits = plan.look_ahead / model.frame_rate
            with tempfile.TemporaryDirectory() as name:
                export_model(model, Path(name) / "model")
                runtime = RuntimeModel.open(Path(name) / "model", threads=threads)
            runtime.choose_low_latency()
            speech = 0.2 * torch.randn(2 * SAMPLE_RATE, generator=torch.Generator().manual_seed(0))
            row = [encoder, str(dim), str(layers), str(steps), f"{waits * 1000:.0f}"]
            for stream in (model.stream(identity="A"), runtime.stream(identity="A")):
                spent: list[float] = []
                with torch.inference_mode():
                    fed(lambda piece, stream=stream: stream.feed(piece.numpy()), speech, spent)  # type: ignore[misc]
                row += times(spent[31:])  # once the past is as long as it will be
                total = waits + float(np.quantile(spent[31:], 0.95))
            row += [f"{total * 1000:.0f}", "yes" if np.median(spent[31:]) < 1 / model.frame_rate else "no"]
            rows.append(row)
            print(" | ".join(row), file=sys.stderr, flush=True)
    network = ["audio encoder", "width", "blocks", "steps"]
    computing = ["PyTorch (ms)", "95 % (ms)", "runtime (ms)", "95 % (ms)"]
    return markdown_table([*network, "waits (ms)", *computing, "sound to frame (ms)", "keeps up"], rows)


def random_model(encoder: str, dim: int, layers: int) -> DualPathDiffusion:
    """A dual-path model of VOCASET's size with random weights."""
    from transformers import HubertConfig

    torch.manual_seed(0)
    made = DualPathDiffusion(
        n_vertices=5023,
        identities=["A", "B"],
        frame_rate=30.0,
        dim=dim,
        audio_encoder=registry.audio_encoder.mel
        if encoder == "mel"
        else partial(HubertEncoder, config=HubertConfig().to_dict()),
        decoder=partial(registry.decoder.style_transformer, num_layers=layers),
        sampler=partial(registry.sampler.dpm_solver, steps=10),
    )
    made.adopt(
        Assets(
            corpus="random weights",
            synthetic=True,
            unit="m",
            frame_rate=30.0,
            identities=["A", "B"],
            templates={name: torch.zeros(5023, 3) for name in "AB"},
            faces=None,
            regions={name: torch.arange(3) for name in ("lips", "upper_face")},
            references={name: reference(made) for name in "AB"},
            motion_scale=100.0,
        )
    )
    return made.eval()


def reference(model: DualPathDiffusion) -> Style:
    """A motion that styles are taken from."""
    from facediff.data import Reference

    return Reference("random", 1e-3 * torch.randn(60, model.n_vertices, 3))  # type: ignore[return-value]


if __name__ == "__main__":
    main()
