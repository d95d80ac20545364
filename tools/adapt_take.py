"""Adapt a model in weights to a minute of an unseen speaker, and print what that brings on clips that were held out.

    python tools/adapt_take.py CHECKPOINT --speaker F4 --folder take [--adapt "--train person --epochs 20"]

The speaker is one of the built-in corpus who was not trained on. Their clips that belong to no split become a take of
Live Link Face, 30 frames a second, whose sound begins 0.2 s late; `facediff data import-take` and `facediff adapt` do
the rest. Errors are those of the lips' vertices by the speaker's own rig, as shares of a still face's, on the ten
clips of test B: of the checkpoint that animates the speaker's face in its usual style, and of the adapted one that
animates the new person in theirs. Without a voice gate; a sample for each clip, with seeds 0 to 9.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import soundfile
import torch

from facediff.cli.app import main as facediff
from facediff.data import Puppet, SpeechMotionDataModule
from facediff.metrics import lip_vertex_error
from facediff.models import load_model
from facediff.spaces.files import ParameterClip, write_parameters
from facediff.spaces.operations import resampled
from facediff.utils import SAMPLE_RATE

RATE = 30.0
LATE = 0.2
NAME = "Ann"


def main() -> None:
    """Print the errors before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--speaker", default="F4", help="who was not trained on")
    parser.add_argument("--folder", type=Path, default=Path("take"), help="for the take, the person and the checkpoint")
    parser.add_argument("--adapt", default="", help="options of `facediff adapt`")
    options = parser.parse_args()
    data = Puppet(drawn_speakers=42, motion="arkit", batch_size=8)
    data.prepare_data()
    folder, adapted = options.folder, options.folder / "adapted.ckpt"
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "person").exists():
        write_take(data, options.speaker, folder)
        take = [str(folder / "take.csv"), str(folder / "take.wav")]
        facediff(["data", "import-take", *take, "--name", NAME, "-o", str(folder / "person")])
    start = time.process_time()
    files = ["--checkpoint", str(options.checkpoint), "--person", str(folder / "person"), "-o", str(adapted)]
    facediff(["adapt", *files, "--quiet", "--yes", *options.adapt.split()])
    print(f"adapting took {time.process_time() - start:.0f} s of a processor")
    before = share_of_still(options.checkpoint, data, options.speaker, options.speaker)
    after = share_of_still(adapted, data, options.speaker, NAME)
    print(f"{options.speaker}: LVE / still face's {before:.3f} before, {after:.3f} after ({after / before - 1:+.0%})")


def write_take(data: SpeechMotionDataModule, speaker: str, folder: Path) -> None:
    """Write ``take.csv`` and ``take.wav`` of the speaker's clips that belong to no split."""
    split = {clip.name for name in ("train", "val", *data.test_splits) for clip in data.clips(name)}
    clips = [clip for clip in data.corpus.clips.values() if clip.identity == speaker and clip.name not in split]
    motion, speech = [], []
    for clip in clips:
        values = data.corpus.read_motion(clip)[:, :, 0].numpy()
        samples, _ = soundfile.read(data.root / "wav" / f"{clip.name}.wav", dtype="float32")
        count = round(len(values) * SAMPLE_RATE / data.frame_rate)
        motion.append(values)
        speech.append(np.pad(samples[:count], (0, max(0, count - len(samples)))))
    values = resampled(np.concatenate(motion), data.space, data.frame_rate, RATE).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 1e-3, round(LATE * SAMPLE_RATE)).astype(np.float32)
    soundfile.write(folder / "take.wav", np.concatenate([noise, *speech]), SAMPLE_RATE)
    write_parameters(folder / "take.csv", ParameterClip("take", values, data.space, RATE))


def share_of_still(checkpoint: Path, data: SpeechMotionDataModule, speaker: str, identity: str) -> float:
    """LVE of a checkpoint that animates an identity with the speaker's held-out speech, over a still face's."""
    model, assets = load_model(checkpoint), data.assets()
    lips, errors = assets.scored.regions["lips"], []
    dataset = data.dataset("test_b")
    for index in range(len(dataset)):
        sample = dataset[index]
        if sample.identity_name != speaker:
            continue
        absolute = model.animate(sample.audio, identity=identity, seed=len(errors)).vertices
        moved = absolute[: len(sample.motion)] - model.assets.template(identity)
        truth, motion = (assets.to_scored(offsets, speaker) for offsets in (sample.motion[: len(moved)], moved))
        errors.append([lip_vertex_error(one, truth, lips).item() for one in (motion, torch.zeros_like(truth))])
    own, still = np.sum(errors, axis=0)
    return float(own / still)


if __name__ == "__main__":
    main()
