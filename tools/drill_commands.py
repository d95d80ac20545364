"""What ``tools/fault_drill.py`` runs: every command that writes, on inputs of a few kilobytes.

A command without an entry in :data:`DRILLS`, :data:`SERVES` or :data:`WRITES_NOTHING` makes a test fail.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

TINY = "tests.fakes.tiny.Tiny"
WEB_RUNTIME = "onnxruntime-web"
"""A folder with files in place of ONNX Runtime for browsers, which comes from the npm registry."""
RUN = "--trainer.accelerator=cpu --trainer.enable_progress_bar=false --trainer.logger.version=0"
PAPER = f"ours corpus --method other=theirs --topology {TINY} --width 120"
SMALL_MODEL = """\
seed_everything: 0
model:
  class_path: facediff.models.DualPathDiffusion
  init_args:
    dim: 16
    diffusion_steps: 20
    warmup_steps: 2
    lr_schedule: cosine
    audio_encoder: {class_path: mel, init_args: {hidden_dim: 16, num_layers: 1, dropout: 0.1}}
    style_encoder: {class_path: tcn_gru_transformer, init_args: {num_layers: 1}}
    decoder: {class_path: style_transformer, init_args: {num_layers: 1}}
    sampler: {class_path: dpm_solver, init_args: {steps: 2}}
data: {class_path: tests.fakes.tiny.Tiny, init_args: {root: corpus, batch_size: 3}}
"""
SMALL_TRAINER = """\
trainer:
  accelerator: cpu
  devices: 1
  log_every_n_steps: 1
  check_val_every_n_epoch: 2
  num_sanity_val_steps: 0
  gradient_clip_val: 1.0
  enable_progress_bar: false
  enable_model_summary: false
  logger: {class_path: lightning.pytorch.loggers.CSVLogger, init_args: {save_dir: runs, name: small, version: 0}}
"""
CALLBACKS = """\
  max_epochs: 6
  callbacks:
    - {class_path: lightning.pytorch.callbacks.EMAWeightAveraging, init_args: {decay: 0.9, use_buffers: false}}
    - {class_path: lightning.pytorch.callbacks.ModelCheckpoint,
       init_args: {monitor: val/lve, mode: min, filename: best}}
    - {class_path: lightning.pytorch.callbacks.LearningRateMonitor}
    - {class_path: facediff.callbacks.checkpoints.LastCheckpoint, init_args: {every_n_steps: 2}}
"""
"""Averaged weights, dropout, a schedule, shuffled batches, and the state saved at every second step."""


@dataclass(frozen=True)
class Drill:
    """A command on small inputs.

    Attributes:
        command: its name in ``facediff.cli.app.COMMANDS``.
        words: what follows the name, in a folder with copies of the inputs that the words mention.
        earlier: words of a run whose outputs are there already; an empty string stands for none.
        label: tells two drills of one command apart.
        pieces: whether the output grows file by file, and the next run continues it.
        also: inputs that the words do not mention.
        once: whether the command refuses a folder that is there, so that a kill after its last step is followed by a
            refusal of what is whole.
    """

    command: str
    words: str
    earlier: str = ""
    label: str = ""
    pieces: bool = False
    also: str = ""
    once: bool = False

    @property
    def name(self) -> str:
        """Command and label."""
        return f"{self.command} ({self.label})" if self.label else self.command

    def argv(self, words: str | None = None) -> list[str]:
        """The words after ``facediff``."""
        return [*self.command.split(), *(self.words if words is None else words).split()]

    def inputs(self, folder: Path) -> list[Path]:
        """The inputs that the words mention."""
        mentioned = f"{self.words} {self.earlier} {self.also}".replace("=", " ").replace("/", " ").split()
        return [path for path in sorted(folder.iterdir()) if path.name in mentioned]


DRILLS = [
    Drill("demo", "-o demo --epochs 1", "-o demo --epochs 2", also="corpus demo.yaml", pieces=True),
    Drill(
        "animate",
        "speech.wav --checkpoint model.ckpt --quiet -o out/a.npz",
        "speech.wav --checkpoint model.ckpt --quiet --seed 5 -o out/a.npz",
    ),
    Drill(
        "animate",
        "speech.wav --checkpoint model.ckpt --quiet --size 64 -o a.mp4",
        "speech.wav --checkpoint model.ckpt --quiet --seed 5 --size 64 -o a.mp4",
        label="video",
    ),
    Drill("animate", "speech.wav --checkpoint model.ckpt --quiet --samples 2 -o a.obj", label="samples, a new folder"),
    Drill(
        "animate",
        "recordings --checkpoint model.ckpt --quiet --workers 1 --suffix .glb -o out",
        label="batch",
        pieces=True,
    ),
    Drill(
        "adapt",
        "--checkpoint model.ckpt --person C --data-root corpus --epochs 1 --accelerator cpu --quiet -o C.ckpt",
        "--checkpoint model.ckpt --person C --data-root corpus --epochs 1 --accelerator cpu --quiet --seed 5 -o C.ckpt",
    ),
    Drill(
        "import-checkpoint",
        "author.pth --dataset vocaset --identities A,B,C --templates faces.pkl --audio-config audio.json -o made.ckpt",
        "author.pth --dataset vocaset --identities A,B,D --templates faces.pkl --audio-config audio.json -o made.ckpt",
    ),
    Drill(
        "animate",
        "speech.wav --checkpoint face --quiet -o a.npz",
        "speech.wav --checkpoint face --quiet --seed 5 -o a.npz",
        label="exported",
    ),
    Drill("export-model", "model.ckpt -o face-onnx", once=True),
    Drill("serve", "face -o site", also=WEB_RUNTIME, once=True),
    Drill("publish", "model.ckpt published --license mit", also="test_scores.csv", once=True),
    Drill(
        "style extract",
        "A_e01.npy --checkpoint model.ckpt -o style.npy",
        "A_e02.npy --checkpoint model.ckpt -o style.npy",
    ),
    Drill("view", "ball.npz -o page.html", "ball.npz --labels earlier -o page.html"),
    *(
        Drill(
            "export",
            f"ball.npz --quiet {size}-o out{suffix}",
            f"ball.npz --quiet {size}--expressiveness 0.5 -o out{suffix}",
            label=suffix,
        )
        for suffix in (".glb", ".usdc", ".pc2", ".mdd", ".npy", ".mp4", ".html")
        for size in ["--size 64 " if suffix == ".mp4" else ""]
    ),
    Drill("export", "ball.npz --quiet -o frames.ply", label=".ply"),
    Drill(
        "blendshapes",
        "ball.npz --shapes shapes -o weights.csv",
        "ball.npz --shapes shapes --smoothness 1 -o weights.csv",
    ),
    Drill(
        "retarget",
        "ball.npz --target-mesh coarse.obj --correspondence map.npz -o mine.npz",
        "ball.npz --target-mesh coarse.obj -o mine.npz",
    ),
    Drill("validate", f"--ckpt_path model.ckpt --data {TINY} --data.root corpus {RUN}", label="", pieces=True),
    Drill(
        "test",
        f"--ckpt_path model.ckpt --data {TINY} --data.root corpus {RUN}",
        f"--ckpt_path model.ckpt --data {TINY} --data.root corpus {RUN} --seed_everything=5",
        pieces=True,
    ),
    Drill(
        "test",
        f"--ckpt_path model.ckpt --data {TINY} --data.root packed.zarr {RUN}",
        f"--ckpt_path model.ckpt --data {TINY} --data.root packed.zarr {RUN} --seed_everything=5",
        label="packed",
        pieces=True,
    ),
    Drill(
        "predict",
        f"--ckpt_path model.ckpt --data {TINY} --data.root corpus {RUN}",
        f"--ckpt_path model.ckpt --data {TINY} --data.root corpus {RUN} --seed_everything=5",
        pieces=True,
    ),
    Drill(
        "evaluate",
        "ours corpus --bootstrap 20 --workers 1 --quiet --json a.json --csv a.csv",
        "ours corpus --bootstrap 10 --workers 1 --quiet --json a.json --csv a.csv",
        pieces=True,
    ),
    Drill("benchmark", "plan.yaml -o out", also="ours corpus tiny.yaml", pieces=True),
    Drill(
        "benchmark report",
        "benchmark --bootstrap 20 --baseline method_0",
        "benchmark --bootstrap 10 --baseline method_1",
        pieces=True,
    ),
    Drill(
        "benchmark referee",
        "--languages en --voices 1 --sentences 1 -o out",
        "--languages de --voices 1 --sentences 1 -o out",
        pieces=True,
    ),
    Drill(
        "generation-metrics",
        f"model.ckpt --corpus {TINY} --data-root corpus --samples 2 --references 1 --max-clips 1 --quiet --json a.json",
        f"model.ckpt --corpus {TINY} --data-root corpus --samples 3 --references 1 --max-clips 1 --quiet --json a.json",
    ),
    Drill("figure frames", f"{PAPER} --dpi 80 --phonemes m -o a.png", f"{PAPER} --dpi 80 --phonemes f -o a.png"),
    Drill("figure heatmap", f"{PAPER} --dpi 80 -o a.png", f"{PAPER} --dpi 100 -o a.png"),
    Drill("figure lips", f"{PAPER} --dpi 80 -o a.pdf", f"{PAPER} --dpi 100 -o a.pdf"),
    Drill(
        "study make",
        "ours=ours theirs=theirs --truth corpus --mesh corpus/tiny.ply --frame-rate 25 --max-clips 1 "
        "--still-controls 0 --same-controls 0 --repeats 0 --languages en --size 32 --workers 1 --quiet -o study",
        pieces=True,
    ),
    Drill(
        "study report",
        "answered --bootstrap 20 -o tables --json a.json",
        "answered --bootstrap 10 -o tables --json a.json",
        pieces=True,
    ),
    Drill("data prepare", "biwi biwi out --workers 1 --quiet", label="biwi", pieces=True),
    Drill("data prepare", "vocaset vocaset out --workers 1 --quiet", label="vocaset", pieces=True),
    Drill("data prepare", "mead3d mead3d out --flame flame.pkl --workers 1 --quiet", label="mead3d", pieces=True),
    Drill("data pack", f"corpus corpus.zarr --corpus {TINY} --workers 1 --quiet", pieces=True),
    Drill("data unpack", "packed.zarr back --workers 1 --quiet", once=True),
    Drill(
        "data import-person",
        "person.npy --audio person.wav --name Target --frame-rate 30 --corpus persons -o entry",
        once=True,
    ),
    Drill("data import-take", "take.csv person.wav --name Target --offset 0 -o entry", once=True),
]
"""One or several for each command that writes, except ``fit``, which has a drill of its own."""

WRITES_NOTHING = ("components", "check-install", "data check")
FIT = "fit"


SERVES = ("study serve", "serve", "live")
"""Run until they are stopped; that an acknowledged answer outlives a kill is in tests/study/test_store.py."""


def write_inputs(folder: Path, run: object) -> None:
    """Write all inputs; ``run(words, folder)`` runs a command in a folder.

    Args:
        folder: an empty folder.
        run: called with the words of a command and the folder to run it in.
    """
    import numpy as np
    import soundfile
    import trimesh

    from facediff.animation import Animation, write_archive
    from tests.fakes import biwi, flame, mead3d, person, published, study, vocaset
    from tests.fakes.benchmark import write_benchmark
    from tests.fakes.meshes import write_obj
    from tests.fakes.tiny import write_tiny

    assert callable(run)
    rng = np.random.default_rng(0)
    corpus = write_tiny(folder / "corpus")
    phonemes = "start,end,ipa,viseme\n0,0.10,,SIL\n0.10,0.20,m,PP\n0.20,0.30,a,AA\n0.30,0.9,f,FF\n"
    (corpus / "phonemes").mkdir()
    for name, moved in (("ours", 0.001), ("theirs", 0.004)):
        (folder / name).mkdir()
        for clip in ("A_e06", "A_e07"):
            truth = np.load(corpus / "vertices_npy" / f"{clip}.npy")
            np.save(folder / name / f"{clip}_condition_A.npy", truth + np.float32(moved))
            (corpus / "phonemes" / f"{clip}.csv").write_text(phonemes, encoding="utf-8")
    run(["data", "pack", "corpus", "packed.zarr", "--corpus", TINY, "--workers", "1", "--quiet"], folder)
    (folder / "demo.yaml").write_text(SMALL_MODEL + SMALL_TRAINER)
    (folder / "fit.yaml").write_text(SMALL_MODEL + SMALL_TRAINER + CALLBACKS)
    run(["fit", "--config", "fit.yaml", "--trainer.max_epochs=2", "--trainer.logger.save_dir=training"], folder)
    (made,) = (folder / "training").rglob("best.ckpt")
    shutil.move(made, folder / "model.ckpt")
    shutil.rmtree(folder / "training")

    run(["export-model", "model.ckpt", "-o", "face"], folder)
    (folder / WEB_RUNTIME).mkdir()
    for name in ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.wasm"):
        (folder / WEB_RUNTIME / name).write_bytes(name.encode())

    shutil.copy(corpus / "wav" / "A_e06.wav", folder / "speech.wav")
    soundfile.write(folder / "long.wav", np.sin(np.arange(3 * 16_000) / 9) * rng.random(3 * 16_000), 16_000)
    (folder / "recordings").mkdir()
    for clip in ("A_e01", "A_e02"):
        shutil.copy(corpus / "wav" / f"{clip}.wav", folder / "recordings" / f"{clip}.wav")
        shutil.copy(corpus / "vertices_npy" / f"{clip}.npy", folder / f"{clip}.npy")

    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rest = np.array(ball.vertices) * [1, 1.3, 0.8]
    shapes = {name: rng.normal(0, 2e-3, rest.shape) for name in ("jawOpen", "mouthFunnel", "mouthPucker")}
    weights = 0.5 + 0.5 * np.sin(np.arange(20)[:, None] / 3 + np.arange(3))
    vertices = rest + np.tensordot(weights, np.stack(list(shapes.values())), axes=1)
    speech = (0.3 * np.sin(np.arange(12_800) / 9)).astype(np.float32)
    performance = Animation(
        "ball",
        vertices.astype(np.float32),
        rest.astype(np.float32),
        25.0,
        faces=np.asarray(ball.faces, np.int32),
        speech=speech,
    )
    write_archive(folder / "ball.npz", performance)
    (folder / "shapes").mkdir()
    for name, moved_by in {"neutral": np.zeros_like(rest), **shapes}.items():
        write_obj(folder / "shapes" / f"{name}.obj", rest + moved_by, np.asarray(ball.faces))
    coarse = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    write_obj(folder / "coarse.obj", np.array(coarse.vertices) * [1, 1.3, 0.8], np.asarray(coarse.faces))

    biwi.write_raw_biwi(folder / "biwi")
    vocaset.write_raw_vocaset(folder / "vocaset")
    mead3d.write_raw_emote(folder / "mead3d", audio="wav")
    flame.write_flame(folder / "flame.pkl")
    masks = vocaset.python2_pickle(vocaset.flame_masks(flame.VERTICES))
    (folder / "FLAME_masks.pkl").write_bytes(masks)

    published.write_author_files(folder)
    write_benchmark(folder)

    asked = study.small_study(clips=3)
    store = study.write_answers(study.write_study(folder / "answered", asked), asked, 3)
    assert len(store.raters()) == 3

    person.write_auxiliary(folder / "persons")
    person.write_speech(folder / "person.wav", person.FRAMES / person.RATE)
    np.save(folder / "person.npy", person.person().seen.astype(np.float32))
    person.write_take(folder / "take.csv", person.FRAMES / person.RATE)
