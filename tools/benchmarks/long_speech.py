"""Speech of ten minutes by windows: quality over time, joints, speed and memory.

    python tools/benchmarks/long_speech.py --checkpoint demo/puppet.ckpt

strings the test sentences of one person together until they last as long as wanted, animates them, and prints from this
one run: the lip error of every minute, how the motion accelerates at the joints of windows and elsewhere (and what hard
cuts between windows would do), what other lengths of windows cost and give, and the peak memory.

    python tools/benchmarks/long_speech.py --size

does it with random weights at the size of BIWI (23 370 vertices, HuBERT base) for speed and memory alone.
"""

from __future__ import annotations

import argparse
import os
import platform
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from sampling_parts import build
from sampling_tables import processor

from facediff.data import Batch, collate
from facediff.models import AnimationModel, load_model
from facediff.models.checkpoint import corpus_class
from facediff.models.inference import SpeechStream
from facediff.speech.audio import SAMPLE_RATE, samples_for
from facediff.speech.windows import MotionWindow, WindowPlan

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Material:
    """Long speech with its truth.

    Attributes:
        clip: one clip of all the speech; its motion is the truth.
        lips: the region that lip errors are taken over.
        joints: frames at which one sentence ends and the next begins, where the truth itself jumps.
    """

    clip: Batch
    lips: torch.Tensor
    joints: list[int]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, help="a trained model whose corpus is on this machine")
    parser.add_argument("--identity", help="whose test sentences; the first identity if absent")
    parser.add_argument("--seconds", type=float, default=600.0, help="length of the speech (default: 600)")
    parser.add_argument("--size", action="store_true", help="random weights at the size of BIWI; speed and memory only")
    parser.add_argument("--vertices", type=int, default=23370, help="vertices with --size")
    parser.add_argument("--plans", action="store_true", help="compare lengths of windows on the first two minutes")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(arguments)
    torch.set_num_threads(args.threads)
    print(
        f"machine: {processor('cpu')}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start; "
        f"{args.threads} threads; Python {platform.python_version()}, torch {torch.__version__}"
    )
    if args.size:
        sized(args.seconds, args.vertices)
    elif args.checkpoint is None:
        parser.error("give --checkpoint, or --size")
    else:
        judged(load_model(args.checkpoint), args.identity, args.seconds, plans=args.plans)


def material(model: AnimationModel, identity: str, seconds: float) -> Material:
    """A person's test sentences, one after the other and again from the start, until they last long enough."""
    source = model.data_source
    if not Path(source["root"]).is_dir():
        raise SystemExit(f"the corpus of the checkpoint ({source}) is not on this machine")
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
    whole = replace(samples[0], audio=torch.cat(audio), motion=torch.cat(motion), name="long", decoy_audio=None)
    style = model.default_style(identity)
    index = model.assets.identity_index(identity)
    whole = replace(whole, reference=style.motion.float(), features=None, identity=index)
    return Material(collate([whole]), model.assets.regions["lips"], joints[:-1])


def by_windows(model: AnimationModel, clip: Batch, plan: WindowPlan) -> torch.Tensor:
    """Motion (T, V, 3)."""
    stream = SpeechStream(model, clip, plan=plan)
    return torch.cat([part[0] for part in stream.parts(clip.audio[0], frames=clip.motion.shape[1])])


@dataclass(frozen=True)
class Alone(MotionWindow):
    """A window that shares neither frames nor noise with its neighbours.

    Attributes:
        context: frames before the window whose speech the model hears.
    """

    context: int = 0
    shared: int = 0


def alone(window: MotionWindow) -> MotionWindow:
    """A window like another one, but alone."""
    return Alone(replace(window.plan, overlap=0), window.index * 1000, window.frames, window.context)


def hard_cut(model: AnimationModel, clip: Batch, plan: WindowPlan) -> torch.Tensor:
    """The same windows, each generated alone and cut where the next begins, as if nothing were done at boundaries."""
    generate_window = model.generate_window
    model.generate_window = lambda clip, window, seeds, before: generate_window(  # type: ignore[method-assign]
        clip, alone(window), seeds, None
    )
    try:
        return by_windows(model, clip, plan)
    finally:
        model.generate_window = generate_window  # type: ignore[method-assign]


def lip_error(motion: torch.Tensor, truth: torch.Tensor, lips: torch.Tensor) -> Array:
    """Largest Euclidean error of the lips in each frame (T,)."""
    error = torch.linalg.vector_norm(motion[:, lips] - truth[:, lips], dim=-1).amax(-1)
    return error.double().numpy()


def acceleration(motion: torch.Tensor) -> Array:
    """Root mean square over vertices of the second difference in each frame (T,); the ends are 0."""
    second = motion.diff(n=2, dim=0).square().sum(-1).mean(-1).sqrt()
    return np.pad(second.double().numpy(), 1)


def joints_of(frames: int, plan: WindowPlan, frame_rate: float) -> npt.NDArray[np.bool_]:
    """Frames at which a window begins to be heard, or the one before it ends, and their neighbours."""
    lengths = plan.in_frames(frame_rate)
    marked = np.zeros(frames, bool)
    for start in range(lengths.hop, frames, lengths.hop):
        for place in (start, start + lengths.overlap):
            marked[max(0, place - 2) : place + 2] = True
    return marked


def judged(model: AnimationModel, identity: str | None, seconds: float, *, plans: bool) -> None:
    """Quality over time, at joints, and for other plans."""
    identity = identity or model.identities[0]
    made = material(model, identity, seconds)
    truth, plan = made.clip.motion[0], model.windows
    lasts = len(truth) / model.frame_rate
    print(f"speech: test sentences of {identity}, {len(made.joints) + 1} in {lasts:.0f} s; {len(truth)} frames")
    print(f"windows of {plan.seconds:g} s, {plan.overlap:g} s shared\n")
    start = time.perf_counter()
    motion = by_windows(model, made.clip, plan)
    took = time.perf_counter() - start
    print(f"made in {took:.1f} s, real-time factor {took / lasts:.3f}; peak memory {peak():.2f} GiB resident")
    error = lip_error(motion, truth, made.lips)
    still = lip_error(torch.zeros_like(truth), truth, made.lips)
    minute = round(60 * model.frame_rate)
    print("\nlip error by minute, against a still face's (mean over frames of the worst lip vertex)")
    for i in range(0, len(truth) - minute // 2, minute):
        part = slice(i, i + minute)
        print(f"  {i // minute + 1:3d}  {error[part].mean() / still[part].mean():.4f}")
    print("\nacceleration, root mean square over vertices, at the joints of windows and elsewhere")
    for name, candidate in (("joined", motion), ("hard cuts", hard_cut(model, made.clip, plan))):
        tell_joints(name, acceleration(candidate), joints_of(len(truth), plan, model.frame_rate), made.joints)
    if plans:
        compare_plans(model, made)


def tell_joints(name: str, size: Array, marked: npt.NDArray[np.bool_], sentences: Sequence[int]) -> None:
    """Compare joints with the rest; frames at which sentences meet are left out of both."""
    usable = np.ones(len(size), bool)
    usable[[0, -1]] = False
    for frame in sentences:
        usable[max(0, frame - 3) : frame + 3] = False
    joints, rest = size[marked & usable], size[~marked & usable]
    rng = np.random.default_rng(0)
    draws = np.array([rng.choice(rest, len(joints)).mean() for _ in range(10_000)])
    share = (draws >= joints.mean()).mean()
    print(
        f"  {name:10s} joints {joints.mean():.3e}, largest {joints.max():.3e}; elsewhere {rest.mean():.3e}, largest "
        f"{rest.max():.3e}; ratio {joints.mean() / rest.mean():.3f}"
    )
    print(f"  {'':10s} {share:.1%} of draws of as many frames elsewhere have as large a mean")


def compare_plans(model: AnimationModel, made: Material) -> None:
    """Windows of other lengths, and everything at once, on the first two minutes."""
    frames = min(made.clip.motion.shape[1], round(120 * model.frame_rate))
    clip = replace(
        made.clip,
        audio=made.clip.audio[:, : samples_for(frames, model.frame_rate)],
        motion=made.clip.motion[:, :frames],
        audio_lengths=torch.tensor([samples_for(frames, model.frame_rate)]),
        frame_lengths=torch.tensor([frames]),
    )
    truth = clip.motion[0]
    still = lip_error(torch.zeros_like(truth), truth, made.lips).mean()
    print("\nlengths of windows, on two minutes: lip error against a still face's, real-time factor, look-ahead in s")
    whole = partial(model.generate_clips, clip)
    ways = [("at once", None), ("sentence by sentence", None)]
    for name, _ in ways:
        start = time.perf_counter()
        motion = whole()[0] if name == "at once" else sentence_by_sentence(model, clip, made.joints)
        tell_plan(name, lip_error(motion, truth, made.lips).mean() / still, time.perf_counter() - start, frames, model)
    for seconds, overlap, before, after in (
        (16, 1, 2, 0.5), (8, 1, 2, 0.5), (4, 1, 2, 0.5), (2, 0.5, 2, 0.5), (1, 0.4, 2, 0.3), (0.6, 0.28, 2, 0.2),
    ):  # fmt: skip
        plan = WindowPlan(seconds, overlap, before, after)
        start = time.perf_counter()
        error = lip_error(by_windows(model, clip, plan), truth, made.lips).mean() / still
        name = f"{seconds:g} s, {overlap:g} s shared"
        tell_plan(name, error, time.perf_counter() - start, frames, model, plan.look_ahead)


def sentence_by_sentence(model: AnimationModel, clip: Batch, joints: Sequence[int]) -> torch.Tensor:
    """Each sentence alone: what the windows, which know no sentences, are measured against."""
    frames = clip.motion.shape[1]
    bounds = [0, *(joint for joint in joints if joint < frames), frames]
    made = []
    for start, end in zip(bounds, bounds[1:], strict=False):
        first, last = (samples_for(frame, model.frame_rate) for frame in (start, end))
        alone = replace(
            clip,
            audio=clip.audio[:, first:last],
            motion=clip.motion[:, start:end],
            audio_lengths=torch.tensor([last - first]),
            frame_lengths=torch.tensor([end - start]),
        )
        made.append(model.generate_clips(alone)[0])
    return torch.cat(made)


def tell_plan(
    name: str, error: float, took: float, frames: int, model: AnimationModel, ahead: float | None = None
) -> None:
    """A line of the table."""
    factor = took * model.frame_rate / frames
    print(f"  {name:22s} {error:.4f}  {factor:.3f}  {'' if ahead is None else f'{ahead:.2f}'}")


def sized(seconds: float, vertices: int) -> None:
    """Speed and memory at the size of BIWI; the motion is dropped window by window, as a writer drops it."""
    sizes = argparse.Namespace(dim=512, heads=8, layers=6, seconds=1.0, device="cpu", repeats=1)
    bench = build(sizes, vertices, tiny_encoder=False)
    model = bench.model
    clip = replace(bench.batch, audio=bench.batch.audio[:, :1000], audio_lengths=torch.tensor([1000]))
    speech = torch.randn(round(seconds * SAMPLE_RATE), generator=torch.Generator().manual_seed(0)) * 0.1
    stream = SpeechStream(model, clip)
    print(f"model: {vertices} vertices, HuBERT base, random weights; {seconds:.0f} s of noise")
    start = time.perf_counter()
    frames = sum(part.shape[1] for part in stream.parts(speech))
    took = time.perf_counter() - start
    print(f"{frames} frames in {took:.1f} s, real-time factor {took / seconds:.3f}; peak {peak():.2f} GiB resident")


def peak() -> float:
    """Peak resident memory of this process in GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    with torch.inference_mode():
        main()
