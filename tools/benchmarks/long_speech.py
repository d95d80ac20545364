"""Speech of ten minutes by windows: lip error over time, speed and memory.

    python tools/benchmarks/long_speech.py --checkpoint demo/puppet.ckpt

strings the test sentences of one person together until they last as long as wanted, animates them, and prints the lip
error of every minute, the real-time factor and the peak memory of this one run.

    python tools/benchmarks/long_speech.py --size

does it with random weights at the size of BIWI (23 370 vertices, HuBERT base) for speed and memory alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from machine import machine, peak_memory
from sampling import build

from facediff.data import Batch, collate
from facediff.models import AnimationModel, load_model
from facediff.models.checkpoint import corpus_class
from facediff.models.inference import SpeechStream
from facediff.speech.audio import SAMPLE_RATE, samples_for


@dataclass(frozen=True)
class Material:
    """Long speech with its truth.

    Attributes:
        clip: one clip of all the speech; its motion is the truth.
        lips: the region that lip errors are taken over.
        joints: frames at which one sentence ends and the next begins.
    """

    clip: Batch
    lips: torch.Tensor
    joints: list[int]


def material(model: AnimationModel, identity: str, seconds: float) -> Material:
    """A person's test sentences, one after the other and again from the start, until they last long enough."""
    source = model.data_source
    data = corpus_class("--checkpoint", source)(root=source["root"])
    samples = [s for split in data.test_splits for s in data.dataset(split) if s.identity_name == identity]
    audio, motion, joints, frames = [], [], [], 0
    while frames < seconds * model.frame_rate:
        sample = samples[len(joints) % len(samples)]
        # Frames of a rate that does not divide 16 kHz do not last whole samples: each starts where it should.
        start, end = (samples_for(n, model.frame_rate) for n in (frames, frames + len(sample.motion)))
        audio.append(torch.nn.functional.pad(sample.audio, (0, 9))[: end - start])
        motion.append(sample.motion)
        frames += len(sample.motion)
        joints.append(frames)
    clip = replace(samples[0], audio=torch.cat(audio), motion=torch.cat(motion), name="long", decoy_audio=None)
    style = model.default_style(identity)
    index = model.assets.identity_index(identity)
    clip = replace(clip, reference=style.motion.float(), features=None, identity=index)
    return Material(collate([clip]), model.assets.regions["lips"], joints[:-1])


def lip_error(motion: torch.Tensor, truth: torch.Tensor, lips: torch.Tensor) -> torch.Tensor:
    """Largest Euclidean error of the lips in each frame (T,)."""
    return torch.linalg.vector_norm(motion[:, lips] - truth[:, lips], dim=-1).amax(-1)


def score(model: AnimationModel, identity: str, seconds: float) -> None:
    """Print speed, memory and the lip error of every minute."""
    speech = material(model, identity, seconds)
    truth, plan = speech.clip.motion[0], model.windows
    duration = len(truth) / model.frame_rate
    print(f"speech: test sentences of {identity}, {len(speech.joints) + 1} in {duration:.0f} s; {len(truth)} frames")
    print(f"windows of {plan.seconds:g} s, {plan.overlap:g} s shared\n")
    started = time.perf_counter()
    stream = SpeechStream(model, speech.clip, plan=plan)
    motion = torch.cat([part[0] for part in stream.parts(speech.clip.audio[0], frames=len(truth))])
    seconds = time.perf_counter() - started
    print(f"{seconds:.1f} s, real-time factor {seconds / duration:.3f}; peak memory {peak_memory()}")
    error = lip_error(motion, truth, speech.lips)
    still = lip_error(torch.zeros_like(truth), truth, speech.lips)
    minute = round(60 * model.frame_rate)
    print("\nlip error by minute, against a still face's (mean over frames of the worst lip vertex)")
    for i in range(0, len(truth) - minute // 2, minute):
        part = slice(i, i + minute)
        print(f"  {i // minute + 1:3d}  {error[part].mean() / still[part].mean():.4f}")


def time_at_size(seconds: float, vertices: int) -> None:
    """Print speed and memory at the size of BIWI; the motion is dropped window by window, as a writer drops it."""
    sizes = argparse.Namespace(dim=512, heads=8, layers=6, seconds=1.0, device="cpu", repeats=1)
    bench = build(sizes, vertices, tiny_encoder=False)
    clip = replace(bench.batch, audio=bench.batch.audio[:, :1000], audio_lengths=torch.tensor([1000]))
    speech = torch.randn(round(seconds * SAMPLE_RATE), generator=torch.Generator().manual_seed(0)) * 0.1
    print(f"model: {vertices} vertices, HuBERT base, random weights; {seconds:.0f} s of noise")
    started = time.perf_counter()
    frames = sum(part.shape[1] for part in SpeechStream(bench.model, clip).parts(speech))
    taken = time.perf_counter() - started
    print(f"{frames} frames in {taken:.1f} s, real-time factor {taken / seconds:.3f}; peak memory {peak_memory()}")


@torch.inference_mode()
def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--checkpoint", type=Path, help="a trained model whose corpus is on this machine")
    source.add_argument("--size", action="store_true", help="random weights at the size of BIWI; speed and memory only")
    parser.add_argument("--identity", help="whose test sentences; the first identity if absent")
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the speech (default: 600)")
    parser.add_argument("--vertices", type=int, default=23370, help="vertices with --size")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(arguments)
    torch.set_num_threads(args.threads)
    print(machine())
    if args.size:
        time_at_size(args.seconds, args.vertices)
    else:
        model = load_model(args.checkpoint)
        score(model, args.identity or model.identities[0], args.seconds)


if __name__ == "__main__":
    main()
