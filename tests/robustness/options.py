"""Wild values for every option of every command, and the law that all commands obey.

The law: a command ends with status 0, or with one sentence on standard error and status 2 (1 where some recordings of a
batch failed). No exception leaves it, no file that it was not told to write changes, nothing half-written is left
behind, and it takes at most :data:`SECONDS` of processor time, or :data:`RECORDING`.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import random
import shutil
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Literal, get_args, get_origin
from unittest import mock

import numpy as np

from facediff.cli.app import load, main
from facediff.cli.data import CORPORA, options_of
from facediff.cli.parsing import Parameter, arguments_of, flat, parameters_of

SECONDS = 20.0  # of processor time for one command line
RECORDING = 60.0  # of one that records graphs: PyTorch takes 5 to 7 s for each of four, whatever their size
LONGEST = 1000  # characters of an error

NUMBERS = (
    "nan", "inf", "-inf", "1e-300", "1e300", "-1", "0", "1", "2", "3.5", "-0.0", "0.5", "+3", "1e3", "1.5e-7",
    "9223372036854775808", "18446744073709551616", "9" * 400, "1_000", "\u0663", "0x10", "1,2", "1,", "1 2", "1e400",
    "100000", "1000000000",
)  # fmt: skip
TEXTS = (
    "", " ", "a\nb", "\x1b[31m", "=cmd()", "%s%d{0}", "null", "[1, 2]", "{a: b}", "x" * 5000, "ü😀", "a,b,,", "a,a",
    "name=", "=folder", ":", "~", "$HOME", "${oc.env:HOME}", "\udcff", "nul\0", "*", "(", "[", "\\", "{subject}", "all",
    "lips", "none", "A", "../..", "a.npy:nan,b.npy:0.5", "lips=nan", "lips=1e-300,all=2", "1e400", "package.Class",
)  # fmt: skip
FILES = (
    "missing.npz", "missing/deep/x.png", "missing.wav", "é.npz", "x" * 300 + ".npz", "WORLD", "WORLD/empty.npz",
    "WORLD/empty.png", "WORLD/corpus", "WORLD/corpus/templates.pkl", "WORLD/speech.wav", "WORLD/model.ckpt",
    "WORLD/clicks.npz", "WORLD/face.obj", "WORLD/text.txt", "WORLD/speech.wav/x.npz", "/dev/null", ".", "..",
    "new.npy", "new.png", "new.csv", "new.json", "new.xyz", "new",
)  # fmt: skip

DRAWN = "WORLD/ours WORLD/corpus --topology tests.fakes.tiny.Tiny -o out.png --dpi 80 --width 85"
BASES: dict[str, str] = {
    "animate": "WORLD/speech.wav --checkpoint WORLD/model.ckpt -o out.npy --quiet",
    "live": "WORLD/model.ckpt WORLD/speech.wav --to jsonl:out.jsonl?weights=false --seconds 0.3 --quiet",
    "adapt": "--checkpoint WORLD/model.ckpt --person C -o out.ckpt --epochs 1 --accelerator cpu --quiet",
    "import-checkpoint": "WORLD/author.pth --dataset vocaset --identities A,B,C --templates WORLD/faces.pkl "
    "--audio-config WORLD/audio.json -o out.ckpt",
    "export-model": "WORLD/model.ckpt -o exported",
    "serve": "WORLD/exported -o site",
    "publish": "WORLD/model.ckpt published --license mit --languages en",
    "style extract": "B_e02 --checkpoint WORLD/model.ckpt -o style.npy",
    "view": "WORLD/clicks.npz -o page.html",
    "export": "WORLD/clicks.npz -o out.glb --quiet",
    "blendshapes": "WORLD/clicks.npz -o weights.csv --shapes WORLD/shapes",
    "retarget": "WORLD/clicks.npz --target-mesh WORLD/face.obj -o out.npz",
    "generation-metrics": "WORLD/model.ckpt --corpus tests.fakes.tiny.Tiny --samples 2 --references 1 --max-clips 1 "
    "--quiet",
    "evaluate": "WORLD/ours WORLD/corpus --bootstrap 10 --workers 1 --quiet",
    "benchmark": "WORLD/plan.yaml -o benchmarks --dry-run",
    "benchmark referee": "--languages en --voices 1 --sentences 1 -o referee",
    "benchmark report": "WORLD/benchmark --bootstrap 20 -o reports",
    "figure frames": f"{DRAWN} --times 0.1",
    "figure heatmap": DRAWN,
    "figure error": DRAWN,
    "figure lips": DRAWN,
    "figure training": "WORLD/run -o out.png --dpi 80 --width 85",
    "study make": "ours=WORLD/ours --truth WORLD/corpus --mesh WORLD/corpus/tiny.ply --frame-rate 25 --max-clips 1 "
    "--still-controls 1 --same-controls 0 --repeats 0 --languages en --size 32 -o study --workers 1 --quiet",
    "study serve": "WORLD/study --port 0",
    "study report": "WORLD/study --answers WORLD/answers.json --bootstrap 10 -o out",
    "data check": "WORLD/corpus --corpus tests.fakes.tiny.Tiny --workers 1 --quiet",
    "data pack": "WORLD/corpus out.zarr --corpus tests.fakes.tiny.Tiny --workers 1 --quiet",
    "data unpack": "WORLD/packed.zarr back --workers 1 --quiet",
    "data regions": "WORLD/corpus --corpus tests.fakes.tiny.Tiny --size 64 -o out.png",
    "data import-person": "WORLD/motion.npy --audio WORLD/person.wav --name P --corpus WORLD/people --frame-rate 30 "
    "-o person --quiet",
    "data import-take": "WORLD/take.csv WORLD/person.wav --name P --offset 0 -o take",
    "components": "",
    "check-install": "",
    "demo": "-o demo",
    **{f"data prepare {corpus}": "WORLD/empty raw_out --workers 1 --quiet" for corpus in CORPORA},
}
"""A valid command line of every command that is not Lightning's; ``data prepare`` has no raw data, and says so."""

TRAINING = ("demo", "adapt")
"""Commands that train: what follows the check of their options is left out."""


def build_world(folder: Path) -> Path:
    """Write everything that :data:`BASES` names."""
    import soundfile
    import trimesh

    from facediff.animation import write_archive
    from facediff.data.packed.packing import pack
    from facediff.study import simulate
    from tests.fakes.benchmark import write_benchmark
    from tests.fakes.clicks import clicks
    from tests.fakes.exported import write_exported
    from tests.fakes.person import person, write_auxiliary, write_speech, write_take
    from tests.fakes.published import write_author_files
    from tests.fakes.study import SCORES, as_file, small_study, write_study
    from tests.fakes.tiny import write_tiny

    folder.mkdir(parents=True, exist_ok=True)
    corpus = write_tiny(folder / "corpus")
    pack(corpus, folder / "packed.zarr", corpus="tests.fakes.tiny.Tiny", workers=1)
    time_ = np.arange(8000) / 16_000
    soundfile.write(folder / "speech.wav", 0.3 * np.sin(2 * np.pi * 200 * time_), 16_000)
    animation = clicks()
    write_archive(folder / "clicks.npz", animation)
    for name, lower in (("neutral", 0.0), ("jawOpen", 20.0)):
        moved = animation.template.copy()
        moved[8:, 1] -= lower
        (folder / "shapes").mkdir(exist_ok=True)
        trimesh.Trimesh(moved, animation.faces, process=False).export(folder / "shapes" / f"{name}.obj")
    shutil.copy(folder / "shapes" / "neutral.obj", folder / "face.obj")
    (folder / "ours").mkdir()
    for clip in ("A_e06", "A_e07"):
        truth = np.load(corpus / "vertices_npy" / f"{clip}.npy")
        np.save(folder / "ours" / f"{clip}_condition_A.npy", truth + np.float32(0.001))
    write_auxiliary(folder / "people")
    np.save(folder / "motion.npy", person().seen[:90].astype(np.float32))
    write_speech(folder / "person.wav", 3)
    write_take(folder / "take.csv", 3)
    (folder / "run").mkdir()
    (folder / "run" / "metrics.csv").write_text("epoch,step,train/loss\n0,0,1.0\n1,1,0.5\n2,2,0.3\n")
    study = small_study(clips=3)
    write_study(folder / "study", study)
    (folder / "answers.json").write_text(json.dumps(as_file(simulate(study, SCORES, 1)[0], study)))
    (folder / "empty").mkdir()
    for name in ("empty.npz", "empty.png"):
        (folder / name).touch()
    (folder / "text.txt").write_text("no file of any format\n")
    write_checkpoint(folder / "model.ckpt", corpus)
    write_exported(folder / "exported")
    write_author_files(folder)
    write_benchmark(folder)
    return folder


def write_checkpoint(path: Path, corpus: Path) -> None:
    """A dual-path checkpoint of the miniature corpus after one step."""
    from functools import partial

    import lightning.pytorch as pl
    import torch

    from facediff import registry
    from facediff.models import DualPathDiffusion
    from tests.fakes.tiny import SEEN, VERTICES, Tiny

    torch.manual_seed(0)
    model = DualPathDiffusion(
        n_vertices=VERTICES,
        identities=SEEN,
        frame_rate=25.0,
        dim=16,
        diffusion_steps=20,
        audio_encoder=partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1),
        style_encoder=partial(registry.style_encoder.tcn_gru_transformer, num_layers=1),
        decoder=partial(registry.decoder.style_transformer, num_layers=1),
        sampler=partial(registry.sampler.ddim, steps=2),
    )
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    trainer = pl.Trainer(
        accelerator="cpu", max_steps=1, limit_val_batches=0, enable_checkpointing=False, log_every_n_steps=1, **quiet
    )
    trainer.fit(model, Tiny(root=str(corpus)))
    trainer.save_checkpoint(path)


# Command lines.


def parameters(name: str) -> list[Parameter]:
    """The options of a command, positional arguments included."""
    if name.startswith("data prepare "):
        return flat(options_of(importlib.import_module(f"facediff.data.prepare.{name.split()[-1]}").plan))
    return flat(parameters_of(load(name)))


def values_of(parameter: Parameter, rng: random.Random) -> list[str]:
    """Wild words for one option."""
    if parameter.is_switch:
        return []
    if parameter.option.bare is not None and rng.random() < 0.2:
        return []
    kinds: list[Sequence[str]] = [NUMBERS, TEXTS, FILES]
    likely = NUMBERS if parameter.is_number else FILES if parameter.value_type is Path else TEXTS
    count = parameter.length or (rng.randint(1, 3) if parameter.is_list and parameter.option.many else 1)
    words = [rng.choice(likely if rng.random() < 0.7 else rng.choice(kinds)) for _ in range(count)]
    if get_origin(parameter.value_type) is Literal and rng.random() < 0.5:
        words = [str(rng.choice(get_args(parameter.value_type))) for _ in words]
    return words


def draw(name: str, rng: random.Random) -> list[str]:
    """A valid command line with one to three options replaced or added."""
    words = BASES[name].split()
    known = parameters(name)
    for parameter in rng.sample(known, min(len(known), rng.choice([1, 1, 1, 2, 3]))):
        wild = values_of(parameter, rng)
        if parameter.positional:
            places = [i for i, word in enumerate(words) if not word.startswith("-")]
            place = next(iter(places), None)
            words = [*wild, *words] if place != 0 else [*wild, *words[1:]]
            continue
        words = without(words, parameter)
        if len(wild) == 1 and (wild[0].startswith("-") or rng.random() < 0.5):
            words.append(f"{parameter.flag}={wild[0]}")
        else:
            words += [parameter.flag, *wild]
        if rng.random() < 0.02:
            words += [parameter.flag, *wild]  # an option given twice
    return words


def without(words: list[str], parameter: Parameter) -> list[str]:
    """A command line without an option and its values."""
    for flag in parameter.flags:
        if flag in words:
            start = words.index(flag)
            end = next((i for i in range(start + 1, len(words)) if words[i].startswith("-")), len(words))
            return words[:start] + words[end:]
    return words


# The law.


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of change of every file, but for those that may be named as outputs."""
    files = [path for path in folder.rglob("*") if not path.is_dir() and path.stem != "empty"]
    files = [path for path in files if not path.name.startswith("answers.sqlite")]  # `study serve` is told to
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in files}


@contextmanager
def nothing_leaves() -> Iterator[None]:
    """No browser, no server, no download, no training."""
    with ExitStack() as stack:
        stack.enter_context(mock.patch("webbrowser.open"))
        stack.enter_context(mock.patch("uvicorn.Server.run"))
        stack.enter_context(mock.patch("facediff.runtime.onnxruntime_web.FILES", {}))  # nothing to be fetched
        yield


def obey(world: Path, name: str, words: Sequence[str], folder: Path) -> tuple[int, str]:
    """Run a command line in an empty folder.

    Returns:
        its status, and what it did against the law; empty if nothing.
    """
    line = [word.replace("WORLD", str(world)) for word in words]
    before, left = snapshot(world), Path.cwd()
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", errors="strict", write_through=True) for _ in "oe")
    started, problem, status = time.process_time(), "", 0
    folder.mkdir()
    os.chdir(folder)
    try:
        with redirect_stdout(out), redirect_stderr(err), nothing_leaves():
            status = run(name, line)
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else 1
        problem = "" if status in (0, 2) else f"exit {stop.code}"
    except BaseException as error:  # noqa: BLE001 - that is the question
        last = traceback.extract_tb(error.__traceback__)[-1]
        problem = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {str(error)[:200]!r}"
    finally:
        os.chdir(left)
    seconds = time.process_time() - started
    said = err.buffer.getvalue().decode()  # type: ignore[attr-defined]
    errors = [line for line in said.split("\n") if line]
    if not problem and status == 2 and (len(errors) != 1 or not errors[0].startswith("facediff: error: ")):
        problem = f"status 2 with {len(errors)} lines: {said[:300]!r}"
    if not problem and status == 2 and len(said) > LONGEST:
        problem = f"an error of {len(said)} characters"
    if not problem and status not in (0, 1, 2):
        problem = f"status {status}"
    if not problem and status == 1 and name not in ("animate", "data check", "study report"):
        problem = "status 1"
    if not problem and snapshot(world) != before:
        problem = "changed a file that it was not told to write"
    rest = [path for path in folder.rglob("*")]
    if not problem and status == 2 and rest:
        problem = f"left {sorted(path.name for path in rest)[:5]} behind"
    if not problem and any(".partial" in path.name for path in rest):
        problem = "left a temporary file behind"
    if not problem and seconds > (RECORDING if name == "export-model" else SECONDS):
        problem = f"took {seconds:.0f} s"
    shutil.rmtree(folder)
    return status, problem


def run(name: str, line: Sequence[str]) -> int:
    """``main`` for a command line; commands that train end where training would begin."""
    from facediff.errors import FaceDiffError

    if name not in TRAINING:
        return main([*name.split(), *line])
    try:
        arguments_of(load(name), f"facediff {name}", line)
    except FaceDiffError as error:
        print(f"facediff: error: {error}", file=sys.stderr)
        return 2
    return 0
