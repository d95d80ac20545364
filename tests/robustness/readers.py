"""Every reader of every format: how a small valid file is written, and what reads it.

A function of the package that decodes files and is reached by none of these readers makes a test fail.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

SAMPLES = 8000
MATERIAL = Path(tempfile.gettempdir())
"""Where material is made that several readers share, whatever the environment says later."""
VERTICES = 9
FACES = [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4], [3, 4, 6], [4, 7, 6], [4, 5, 7], [5, 8, 7]]


@dataclass(frozen=True)
class Reader:
    """A format.

    Attributes:
        suffix: of its files.
        write: writes a valid file.
        read: reads a file, valid or not.
        share: share of the rounds that it gets; less where reading takes long.
    """

    suffix: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    share: float = 1.0


def new_folder() -> Path:
    """A folder that is removed when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix="readers-", dir=MATERIAL))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def grid() -> np.ndarray:
    """Nine vertices in a plane that is not quite one."""
    y, x = np.divmod(np.arange(VERTICES), 3)
    return np.stack([x * 0.1, y * 0.1, 0.01 * np.sin(x + y)], -1)


@functools.cache
def shared(name: str) -> Path:
    """Material that is made once in a process.

    ``tiny`` (a corpus), ``packed`` (the same, packed), ``checkpoint`` (a model trained on it).
    """
    folder = new_folder()
    if name == "tiny":
        from tests.fakes.tiny import write_tiny

        return write_tiny(folder / "tiny", sentences=2)
    if name == "packed":
        from facediff.data.packed.packing import pack

        pack(shared("tiny"), folder / "corpus.zarr", corpus="tests.fakes.tiny.Tiny", workers=1)
        return folder / "corpus.zarr"
    import lightning.pytorch as pl
    import torch

    from facediff import registry
    from facediff.models import DualPathDiffusion
    from tests.fakes.tiny import SEEN, Tiny, write_tiny
    from tests.fakes.tiny import VERTICES as OF_TINY

    torch.manual_seed(0)
    model = DualPathDiffusion(
        n_vertices=OF_TINY,
        identities=SEEN,
        frame_rate=25.0,
        dim=16,
        diffusion_steps=4,
        audio_encoder=functools.partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1),
        style_encoder=functools.partial(registry.style_encoder.tcn_gru_transformer, num_layers=1),
        decoder=functools.partial(registry.decoder.style_transformer, num_layers=1),
        sampler=functools.partial(registry.sampler.ddim, steps=2),
    )
    trainer = pl.Trainer(
        accelerator="cpu",
        devices=1,
        max_steps=1,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        enable_checkpointing=False,
        limit_val_batches=0,
        num_sanity_val_steps=0,
        default_root_dir=folder,
    )
    trainer.fit(model, datamodule=Tiny(root=str(write_tiny(folder / "tiny"))))
    trainer.save_checkpoint(folder / "model.ckpt")
    return folder / "model.ckpt"


def in_a_corpus(path: Path, name: str) -> Path:
    """The tiny corpus with the file at ``name``, next to the file."""
    root = path.parent / "corpus"
    if not root.exists():
        shutil.copytree(shared("tiny"), root)
    (root / name).parent.mkdir(exist_ok=True)
    shutil.copy(path, root / name)
    return root


# Plans


def plan(path: Path) -> None:
    (path.parent / "one.yaml").write_text("model: {dim: 3}\n")
    path.write_text(
        """\
title: Two methods
metrics: [lve, fdd]
seeds: [0, 1]
baseline: one
options: &all {trainer.max_epochs: 4, model.dim: 8}
test_options: *all
threads: 2
workers: 2
references: [still]
corpora:
  tiny: {label: Tiny, options: {data.window: 9}}
methods:
  one: {label: One, config: one.yaml}
  two: {config: one.yaml, before: {prior: {config: one.yaml}}, options: {model.prior: "{prior}"}, seeds: [3]}
"""
    )


def read_plan(path: Path) -> object:
    from facediff.benchmark import cells_of
    from facediff.benchmark import read_plan as read

    (path.parent / "one.yaml").write_text("model: {dim: 3}\n")
    return cells_of(read(path))


def benchmark_plan(path: Path) -> None:
    from facediff.benchmark.outline import write_outline
    from tests.fakes.benchmark import outline

    write_outline(path.parent, outline())
    (path.parent / "plan.json").rename(path)


def read_a_benchmark_plan(path: Path) -> object:
    from facediff.benchmark.outline import read_outline

    if path.is_file():
        shutil.copy(path, path.with_name("plan.json"))
    return read_outline(path.parent)


def exported_model(path: Path) -> None:
    from tests.fakes.exported import write_exported

    folder = write_exported(path.with_name("exported"))
    for each in folder.iterdir():
        each.rename(path.parent / each.name)
    folder.rmdir()
    (path.parent / "model.json").rename(path)


def read_an_exported_model(path: Path) -> object:
    from facediff.runtime.folder import read_folder

    exported_model(path.with_name("whole.json"))
    return read_folder(Path(shutil.move(path, path.with_name("model.json"))).parent)


def exported_graph(path: Path) -> None:
    from tests.fakes.exported import graphs

    path.write_bytes(graphs()["step"].SerializeToString())


def read_an_exported_graph(path: Path) -> object:
    from facediff.pipelines.export_model import OPSET, described_ends
    from facediff.runtime.graph_check import check_graph
    from tests.fakes.exported import graphs

    return check_graph(path, OPSET, described_ends(graphs()["step"]))


def benchmark_cell(path: Path) -> None:
    from tests.fakes.benchmark import results

    (found,) = results(rows=1, seeds=1, clips=2)
    found.write(path.parent).rename(path)


def read_a_benchmark_cell(path: Path) -> object:
    from facediff.benchmark import read_result, report_of
    from tests.fakes.benchmark import outline

    found = read_result(path)
    return None if found is None else report_of(outline(rows=1), [found], resamples=10)


def provenance(path: Path) -> None:
    from facediff.utils.plain_files import write_json
    from facediff.utils.provenance import Provenance

    write_json(path, Provenance("FaceFormer", {"audio_encoder": "mel"}, "recipe", 3, 10, "hash").as_dict())


def read_a_provenance(path: Path) -> object:
    from facediff.utils.provenance import read_provenance

    if path.is_file():
        shutil.copy(path, path.with_name("provenance.json"))
    return read_provenance(path.parent)


# User studies


def answers(path: Path) -> None:
    from facediff.study import simulate
    from tests.fakes.study import SCORES, as_file, small_study

    study = small_study(clips=2, still=1)
    path.write_text(json.dumps(as_file(simulate(study, SCORES, 1)[0], study)))


def read_the_answers(path: Path) -> object:
    from facediff.study.answers import read_answers
    from tests.fakes.study import small_study

    return read_answers(path, small_study(clips=2, still=1))


def a_study(path: Path) -> None:
    from facediff.study.definition import STUDY_FILE
    from tests.fakes.study import small_study

    small_study(clips=2, still=1).write(path.parent)
    (path.parent / STUDY_FILE).rename(path)


def read_the_study(path: Path) -> object:
    from facediff.study import read_study
    from facediff.study.definition import STUDY_FILE

    folder = path.parent / "study"
    folder.mkdir(exist_ok=True)
    shutil.copy(path, folder / STUDY_FILE)
    return read_study(folder)


# Speech


def sound(path: Path) -> None:
    import soundfile

    wave = 0.1 * np.sin(np.arange(SAMPLES) * 0.2)
    options = {"format": "OGG", "subtype": "OPUS"} if path.suffix == ".opus" else {}
    soundfile.write(path, wave, 16_000, **options)


def container(path: Path) -> None:
    import av

    kind = {".flv": "flv", ".webm": "webm", ".m4a": "mp4", ".mkv": "matroska"}.get(path.suffix, path.suffix[1:])
    with av.open(str(path), "w", format="adts" if path.suffix == ".aac" else kind) as out:
        stream = out.add_stream("libopus" if path.suffix == ".webm" else "aac", rate=48_000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 24_000), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 48_000
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            out.mux(packet)


def read_sound(path: Path) -> object:
    from facediff.speech.audio import read_speech

    return read_speech(path)


def read_a_stretch(path: Path) -> object:
    from facediff.speech.audio import read_stretch

    return read_stretch(path, 100, 2000, None)


# Meshes and shapes


def mesh(path: Path) -> None:
    import trimesh

    trimesh.Trimesh(grid(), FACES, process=False).export(path)


def read_a_mesh(path: Path) -> object:
    from facediff.mesh import read_mesh

    return read_mesh(path)


def shape_folder(path: Path) -> object:
    from facediff.spaces.shape_files import read_shape_files

    folder = path.parent / "shapes"
    folder.mkdir()
    mesh(folder / "neutral.obj")
    shutil.copy(path, folder / "jawOpen.obj")
    return read_shape_files(folder)


def targets(path: Path) -> None:
    from facediff.export import ExportOptions, write_animations
    from tests.fakes.clicks import clicks

    write_animations(path, [clicks()], ExportOptions())


def read_targets(path: Path) -> object:
    from facediff.spaces.shape_files import read_shape_files

    return read_shape_files(path)


def recorded(layout: str) -> Callable[[Path], None]:
    """A writer of a recording in parameters, in a layout."""

    def write(path: Path) -> None:
        from facediff.spaces.files import ParameterClip, write_parameters
        from facediff.spaces.layouts import LAYOUTS

        space = LAYOUTS[layout].space
        values = np.random.default_rng(0).random((4, len(space.channels))).astype(np.float32)
        write_parameters(path, ParameterClip("take", values, space, 30.0, layout=layout), layout=layout)

    return write


def read_recorded(path: Path) -> object:
    from facediff.spaces.files import read_parameters

    arrays = path.suffix in (".npy", ".npz")
    return read_parameters(path, layout="flame_diffposetalk" if arrays else None)


def read_parts(path: Path) -> object:
    from facediff.mesh.parts import mesh_parts

    return mesh_parts(path)


def add_motion(path: Path) -> object:
    from facediff.export.glb_added import add_to_glb
    from tests.fakes.clicks import clicks

    add_to_glb(path.with_name("added.glb"), path, clicks(), 0.05)
    return (path.with_name("added.glb")).read_bytes()


def head() -> np.ndarray:
    """A small patch with lids, and a face around it."""
    return np.concatenate([0.2 * grid(), grid() + [0, 0.3, 0]])


def eyes(path: Path) -> None:
    lids = [{"upper": [0, 1, 2], "lower": [3, 4, 5]}]
    path.write_text(json.dumps({"lids": lids, "eyeballs": [[6, 7, 8, 9], [10, 11, 12, 14]]}))


def blinks(path: Path) -> None:
    path.write_text(json.dumps({"neutral": "neutral.obj", "blinks": ["blink.npy"], "eyeballs": ["balls.txt"]}))


def eyes_arrays(path: Path) -> None:
    np.savez(path, closing=np.full((18, 3), 0.01), neutral=head(), eyeball_left=np.arange(3, 9))


def read_the_eyes(path: Path) -> object:
    import trimesh

    from facediff.editing.eyes import read_eyes

    trimesh.Trimesh(head(), FACES, process=False).export(path.parent / "neutral.obj")
    np.save(path.parent / "blink.npy", np.full((18, 3), 0.01))
    (path.parent / "balls.txt").write_text("6, 7, 8, 10, 12")
    return read_eyes(path, head())


def direction(path: Path) -> None:
    from facediff.editing.direction import Direction, Key

    Direction([Key(0, "style", "F1_e03"), Key(1.5, "head.pitch", -2.5, "linear", 0.5), Key(2, "sway", 3)]).save(path)


def read_the_direction(path: Path) -> object:
    from facediff.editing.direction import read_direction

    return read_direction(path).at([0.0, 1.0])


# Animations, styles, weights


def animation(path: Path) -> None:
    from facediff.animation import write_archive
    from tests.fakes.clicks import clicks

    write_archive(path, clicks())


def read_an_animation(path: Path) -> object:
    from facediff.animation import read_animation

    return read_animation(path)


def read_a_style(path: Path) -> object:
    from facediff.animation.style_files import open_style

    opened = open_style(path)
    return np.asarray(opened.array).sum()


def correspondence(path: Path) -> None:
    from facediff.editing.correspondence import correspond
    from facediff.editing.retargeting import save_correspondence

    save_correspondence(path, correspond(grid(), np.array(FACES), grid(), np.array(FACES)))


def read_correspondence(path: Path) -> object:
    from facediff.editing.retargeting import load_correspondence

    return load_correspondence(path)


def landmarks(path: Path) -> None:
    path.write_text("source,target\n1,2\n3,4\n5,6\n")


def picked_landmarks(path: Path) -> None:
    from facediff.editing.landmarks import Landmarks, Places, write_landmarks

    target = Places(np.array([[4, 4, 4], [1, 2, 3]]), np.array([[1.0, 0.0, 0.0], [0.25, 0.5, 0.25]]))
    write_landmarks(path, Landmarks(("nose_tip", "mole"), Places.of_vertices(np.array([124, 7])), target), 1008, 42)


def read_the_landmarks(path: Path) -> object:
    from facediff.editing.landmarks import read_landmarks

    return read_landmarks(path)


def _hierarchy(cache: Path) -> object:
    from facediff.mesh.hierarchy import mesh_hierarchy

    return mesh_hierarchy(grid(), np.array(FACES), levels=1, factor=2, spiral_length=3, cache=cache)


def hierarchy(path: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        _hierarchy(Path(folder))
        (made,) = Path(folder).iterdir()
        shutil.copy(made, path)


def read_hierarchy(path: Path) -> object:
    """A damaged file in the cache is made again."""
    cache = path.parent / "made"
    cache.mkdir()
    _hierarchy(cache)
    (made,) = cache.iterdir()
    shutil.copy(path, made)
    return _hierarchy(cache)


# Corpora


def templates(path: Path) -> None:
    path.write_bytes(pickle.dumps({"A": grid(), "B": grid() + 1}))


def read_the_templates(path: Path) -> object:
    from facediff.data.corpus import read_templates

    return read_templates(path, VERTICES)


def vertices(path: Path) -> None:
    np.save(path, np.zeros((5, 3 * VERTICES), np.float32))


def read_the_vertices(path: Path) -> object:
    from facediff.utils.arrays import open_vertices

    return np.asarray(open_vertices(path, VERTICES)).sum()


def packed(place: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """A file of a packed corpus; it is read at an address, so that what is kept of it is read as well."""

    def write(path: Path) -> None:
        shutil.copy(shared("packed") / place, path)

    def read(path: Path) -> object:
        from facediff.data.check import check
        from tests.fakes.tiny import Tiny

        with tempfile.TemporaryDirectory(dir=MATERIAL) as folder:
            root = Path(shutil.copytree(shared("packed"), Path(folder) / "corpus.zarr"))
            shutil.copy(path, root / place)
            with mock.patch.dict(os.environ, FACEDIFF_CACHE=str(Path(folder) / "cache")):
                corpus = Tiny(root=f"file://{root}").corpus
                for clip in corpus.clips.values():
                    corpus.read_motion(clip)
                    corpus.read_audio(clip, 0, corpus.frames(clip))
                    corpus.read_motion(clip)
                return check(root, "tests.fakes.tiny.Tiny", workers=1).sound

    return write, read


def read_to_pack(path: Path) -> object:
    """Pack a corpus that has this recording, and find that it is packed."""
    from facediff.data.packed.packing import pack

    with tempfile.TemporaryDirectory(dir=MATERIAL) as folder:
        root = Path(shutil.copytree(shared("tiny"), Path(folder) / "corpus"))
        shutil.copy(path, root / "wav" / "A_e01.wav")
        for _ in range(2):
            report = pack(root, Path(folder) / "corpus.zarr", corpus="tests.fakes.tiny.Tiny", workers=1)
        return report.clips


def indices(path: Path) -> None:
    path.write_text("1, 2, 3, 4, 8")


def read_the_indices(path: Path) -> object:
    from facediff.data.corpus import find_region

    return find_region(path.parent, [path.name], "lips", VERTICES)


def weights(path: Path) -> None:
    path.write_text("\n".join(f"{0.1 * vertex:.3f}" for vertex in range(VERTICES)))


def read_the_weights(path: Path) -> object:
    from facediff.evaluation import read_region

    return read_region("lips", VERTICES, source=f"{path}>0.1")


def pairs(path: Path) -> None:
    path.write_text("0, 6\n1, 7\n")


def read_the_pairs(path: Path) -> object:
    from facediff.evaluation.files import read_pairs

    return read_pairs(str(path), None, VERTICES)


def masks(path: Path) -> None:
    path.write_bytes(pickle.dumps({"lips": np.arange(4), "forehead": np.arange(5, 9)}, protocol=2))


def read_the_masks(path: Path) -> object:
    from facediff.mesh.flame import read_masks

    try:
        return read_masks(path, "lips+forehead")
    except ValueError as error:  # as its callers do
        from facediff.errors import FaceDiffError

        raise FaceDiffError(str(error)) from error


def clip_table(path: Path) -> None:
    path.write_text("clip,subject,sentence,mood\nA_e01,A,e01,calm\nB_e01,B,e01,lively\n")


def read_the_clip_table(path: Path) -> object:
    from facediff.data.corpus import Corpus, read_clip_table

    root = in_a_corpus(path, "clips.csv")
    read_clip_table(root)
    return Corpus


def corpus_pairs(path: Path) -> object:
    from tests.fakes.tiny import Tiny

    root = in_a_corpus(path, "regions/inner_lip_pairs.txt")
    data = Tiny(root=str(root))
    data.setup("test")
    return data.assets


def colours(path: Path) -> None:
    np.savez(path, A=np.full((24, 3), 200, np.uint8), B=np.zeros((24, 3), np.uint8))


def corpus_colours(path: Path) -> object:
    from facediff.data.corpus import Corpus

    return Corpus(in_a_corpus(path, "colours.npz"), 24, 25).read_colours()


def phonemes(path: Path) -> None:
    path.write_text("start,end,ipa\n0.0,0.1,b\n0.1,0.3,a\n")


def read_the_phonemes(path: Path) -> object:
    from facediff.speech.phonemes import read_phonemes

    return read_phonemes(path)


def textgrid(path: Path) -> None:
    head = 'File type = "ooTextFile"\nObject class = "TextGrid"\n\n0\n0.3\n<exists>\n1\n'
    head += '"IntervalTier"\n"phones"\n0\n0.3\n2\n'
    path.write_text(head + '0\n0.1\n"m"\n0.1\n0.3\n"a"\n')


def read_the_textgrid(path: Path) -> object:
    from facediff.speech.phonemes import read_alignment

    return read_alignment(path)


def read_the_text_grid_of_a_recording(path: Path) -> object:
    from facediff.synthetic.recordings import read_text_grid

    return read_text_grid(path)


def truth_shapes(path: Path) -> None:
    path.write_text("shape\neyeBlinkLeft\njawOpen\n")


def read_the_truth(path: Path) -> object:
    """The stored truth of one clip of the built-in corpus, in which the names of shapes may be damaged."""
    from facediff.data.check.truth import measure_truth

    root, rng = path.parent / "truth", np.random.default_rng(0)
    for folder in ("weights_npy", "gaze_npy", "head_npy", "rigs", "regions", "phonemes"):
        (root / folder).mkdir(parents=True)
    shutil.copy(path, root / "shapes.csv")
    for name, width in (("weights", 2), ("gaze", 2), ("head", 3)):
        np.save(root / f"{name}_npy" / "A_e01.npy", rng.uniform(0, 20, (60, width)))
    np.save(root / "rigs" / "A.npy", rng.normal(size=(3, VERTICES, 3)))
    for name, text in (("lve", "0,1,2"), ("fdd", "3,4"), ("inner_lip_pairs", "0, 1\n1, 2")):
        (root / "regions" / f"{name}.txt").write_text(text)
    phonemes(root / "phonemes" / "A_e01.csv")
    return measure_truth(root, ["A_e01"], 25.0)


def manifest(path: Path) -> None:
    path.write_text(json.dumps({"frame_rate": 25, "unit": "m", "files": {"a": {"bytes": 1, "sha256": "b"}}}))


def read_the_manifest(path: Path) -> object:
    from facediff.data.corpus import read_manifest

    target = path.with_name("manifest.json")
    os.replace(path, target)
    return read_manifest(target.parent)


def checking(name: str) -> Callable[[Path], object]:
    """Check a corpus folder in which one file is damaged."""

    def check(path: Path) -> object:
        from facediff.data.check import check as check_folder

        root = in_a_corpus(path, name)
        return check_folder(root, "tests.fakes.tiny.Tiny", workers=1, progress=False)

    return check


def of_tiny(name: str) -> Callable[[Path], object]:
    """A copy of a file of the tiny corpus."""
    return lambda path: shutil.copy(shared("tiny") / name, path)


def state(path: Path) -> None:
    from facediff.data.prepare.runner import prepare
    from tests.data.prepare.test_prepare_runner import toy_plan

    with tempfile.TemporaryDirectory() as folder:
        prepare(toy_plan(), Path(folder), workers=1, quiet=True)
        shutil.copy(Path(folder) / "manifest.json", path)


def read_the_state(path: Path) -> object:
    from facediff.data.prepare.runner import prepare
    from tests.data.prepare.test_prepare_runner import toy_plan

    out = path.parent / "out"
    out.mkdir()
    shutil.copy(path, out / "manifest.json")
    return prepare(toy_plan(), out, workers=1, quiet=True)


def record(path: Path) -> None:
    speech = {"path": "a.wav", "bytes": 3, "modified_ns": 5, "sha256": "0"}
    recipe = {"command": ["seed=0"], "files": {"model.ckpt": "1"}}
    path.write_text(json.dumps({"speech": speech, "recipe": recipe, "output_bytes": 7, "problem": ""}))


def read_a_record(path: Path) -> object:
    from facediff.utils.batch import RECORDS, FileTask, Recipe

    folder = path.parent / RECORDS
    folder.mkdir()
    shutil.copy(path, folder / "a.mp4.json")
    task = FileTask(path.parent / "a.wav", path.parent / "a.mp4", Recipe(("seed=0",), {"model.ckpt": "1"}))
    return task.change(), task.earlier_problem()


def read_the_store(path: Path) -> object:
    """A damaged file in the store counts as none."""
    from facediff.utils.arrays import ArrayStore

    store = ArrayStore(path.parent / "store")
    store.put("key", np.zeros(3, np.float32))
    shutil.copy(path, store.path("key"))
    return store.get("key")


# Raw data sets, people, FLAME


def flame(path: Path) -> None:
    from tests.fakes.flame import flame_arrays, write_flame

    if path.suffix == ".npz":
        np.savez(path, **flame_arrays())
    else:
        write_flame(path)


def read_flame(path: Path) -> object:
    from facediff.mesh.flame import Flame

    return Flame.read(path)


def vl(path: Path) -> None:
    from tests.fakes.biwi import vl_bytes

    path.write_bytes(vl_bytes(grid()))


def read_a_vl(path: Path) -> object:
    from facediff.data.prepare.biwi import read_vl

    return read_vl(path)


def parameters(path: Path) -> None:
    from tests.fakes.mead3d import CLIPS, parameters_of, write_hdf5

    parts = parameters_of(CLIPS[0])
    if path.suffix == ".npy":
        np.save(path, np.concatenate([parts["shape"], parts["exp"], parts["jaw"]], 1)[None])
    else:
        write_hdf5(path, parts)


def read_the_parameters(path: Path) -> object:
    from facediff.data.prepare.motion import read_parameters

    return read_parameters(path)


def raw_vocaset(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of the raw distribution, and makes the plan of a folder with it."""

    @functools.cache
    def folder() -> Path:
        from tests.fakes.vocaset import write_raw_vocaset

        return write_raw_vocaset(new_folder() / "raw")

    def read(path: Path) -> object:
        from facediff.data.prepare.vocaset import plan

        raw = path.parent / "raw"
        shutil.copytree(folder(), raw)
        shutil.copy(path, raw / name)
        return plan(raw)

    return lambda path: shutil.copy(folder() / name, path), read


# Training


def checkpoint(path: Path) -> None:
    shutil.copy(shared("checkpoint"), path)


def read_a_checkpoint(path: Path) -> object:
    from facediff.models import load_model

    return load_model(path)


def one_of(
    made: Callable[[], Path], name: str, read: Callable[[Path], object]
) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of a valid folder, and reads the folder with that file in its place."""

    def read_with(path: Path) -> object:
        folder = path.parent / "folder"
        shutil.copytree(made(), folder)
        shutil.copy(path, folder / name)
        return read(folder)

    return lambda path: shutil.copy(made() / name, path), read_with


@functools.cache
def model_folder() -> Path:
    """The checkpoint as a folder that can be handed to others."""
    folder = new_folder() / "model"
    read_a_checkpoint(shared("checkpoint")).save_pretrained(folder)  # type: ignore[attr-defined]
    return folder


def published(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of a model folder, and loads the model with it."""
    return one_of(model_folder, name, read_a_checkpoint)


@functools.cache
def author_folder() -> Path:
    """A checkpoint of a published method as its authors write it, with what else the import needs."""
    from tests.fakes.published import write_author_files

    folder = new_folder()
    write_author_files(folder)
    return folder


def authors(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of a published method, and imports the method with it."""

    def read(folder: Path) -> object:
        from facediff.models import import_checkpoint

        options = {"templates": folder / "faces.pkl", "audio_config": folder / "audio.json"}
        return import_checkpoint(folder / "author.pth", dataset="vocaset", identities=["A", "B", "C"], **options)

    return one_of(author_folder, name, read)


@functools.cache
def voca_folder() -> Path:
    """A checkpoint of VOCA as its authors write it, in TensorFlow's files, with DeepSpeech's graph and faces."""
    from tests.fakes.voca import write_voca

    folder = new_folder()
    write_voca(folder)
    (folder / "faces.pkl").write_bytes(pickle.dumps({"A": np.zeros((12, 3))}))
    return folder


def voca(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of VOCA, and imports the method with it."""

    def read(folder: Path) -> object:
        from facediff.models import import_checkpoint

        files = [folder / "gstep_52280.model.index", folder / "output_graph.pb"]
        options = {"dataset": "vocaset", "identities": ["A", "B", "C"], "templates": folder / "faces.pkl"}
        return import_checkpoint(files, **options)

    return one_of(voca_folder, name, read)


def curves(path: Path) -> None:
    path.write_text("epoch,step,train/loss\n0,0,1.0\n0,1,0.5\n1,2,0.25\n")


def read_the_curves(path: Path) -> object:
    from facediff.evaluation.figures.training import read_curves

    return read_curves(path)


@functools.cache
def hubert_folder() -> Path:
    """A HuBERT in miniature."""
    from transformers import HubertConfig, HubertModel
    from transformers.utils import logging

    folder = new_folder()
    small = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    config = HubertConfig(**small, conv_dim=(8,) * 7, num_conv_pos_embeddings=8, num_conv_pos_embedding_groups=4)
    logging.disable_progress_bar()
    HubertModel(config).save_pretrained(folder)
    return folder


def hubert(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of a pretrained audio encoder, and loads the encoder with it."""

    def read(folder: Path) -> object:
        from facediff.models.audio_encoders import load_hubert

        return load_hubert(str(folder), None)

    return one_of(hubert_folder, name, read)


def config(path: Path) -> None:
    path.write_text(
        "seed_everything: 0\nmodel:\n  class_path: facediff.models.DualPathDiffusion\n  init_args: {dim: 16}\n"
        "data: {class_path: tests.fakes.tiny.Tiny, init_args: {root: nowhere}}\ntrainer: {max_epochs: 2}\n"
    )


def read_a_config(path: Path) -> object:
    from facediff.cli.lightning import run_cli

    try:
        with open(os.devnull, "w") as nowhere, _output_to(nowhere):
            return run_cli("fit", ["--config", str(path), "--print_config"])
    except SystemExit as stop:  # after printing
        return stop.code


def _output_to(stream: object) -> object:
    from contextlib import redirect_stdout

    return redirect_stdout(stream)


@functools.cache
def surface_folder() -> Path:
    """A textured .obj with its materials and a picture, and a .glb made of it."""
    from PIL import Image

    from facediff.animation import Animation
    from facediff.export import write_animations
    from facediff.mesh import read_mesh

    folder = new_folder()
    mesh(folder / "face.obj")
    points = [line for line in (folder / "face.obj").read_text().splitlines() if line.startswith("v ")]
    corners = ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in FACES]
    uvs = [f"vt {i / VERTICES} {i % 2}" for i in range(VERTICES)]
    lines = ["mtllib face.mtl", *points, *uvs, "usemtl skin", *corners[:4], "usemtl cloth", *corners[4:]]
    (folder / "face.obj").write_text("\n".join(lines) + "\n")
    (folder / "face.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd skin.png\nnewmtl cloth\nKd 0.2 0.4 0.6\n")
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(folder / "skin.png")
    read = read_mesh(folder / "face.obj")
    rest = read.vertices.astype(np.float32)
    animation = Animation("face", rest[None], rest, 25.0, faces=read.faces)
    write_animations(folder / "face.glb", [animation], into=folder / "face.obj")
    return folder


def surface(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of a textured mesh, and reads its surface with it."""

    def read(folder: Path) -> object:
        from facediff.mesh import read_mesh
        from facediff.mesh.textures import read_textures

        textured = folder / ("face.glb" if name == "face.glb" else "face.obj")
        surface = read_textures(textured, len(read_mesh(textured).faces))
        return [material.picture_bytes() for material in surface.materials]

    return one_of(surface_folder, name, read)


@functools.cache
def audio2face_folder() -> Path:
    """A network of Audio2Face-3D with all that its folder holds."""
    from tests.fakes.audio2face import write_audio2face

    folder = new_folder()
    write_audio2face(folder)
    return folder


def audio2face(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of a folder of Audio2Face-3D, and reads the folder with it."""

    def read(folder: Path) -> object:
        from facediff.runtime.audio2face_folder import read_audio2face

        return read_audio2face(folder)

    return one_of(audio2face_folder, name, read)


@functools.cache
def diffposetalk_folder() -> Path:
    """The two files of DiffPoseTalk, as its authors write them."""
    from tests.fakes.published_parameters import write_diffposetalk

    folder = new_folder()
    write_diffposetalk(folder, head=True)
    return folder


def diffposetalk(name: str) -> tuple[Callable[[Path], object], Callable[[Path], object]]:
    """Writes one file of DiffPoseTalk, and imports the method with it."""

    def read(folder: Path) -> object:
        from facediff.models import import_checkpoint
        from tests.fakes.published import AUDIO_CONFIG
        from tests.fakes.published_parameters import SHAPE, statistics

        files, shape = sorted(folder.glob("*.pt"))[::-1], np.zeros(SHAPE, np.float32)
        options = {"audio_config": AUDIO_CONFIG, "statistics": statistics(), "templates": {"A": shape}}
        return import_checkpoint(files, **options)

    return one_of(diffposetalk_folder, name, read)


def read_recorded_style(path: Path) -> object:
    """Motion in parameters as a style."""
    from facediff.animation.parameter_styles import recorded_parameters

    return recorded_parameters(str(path), 30.0)


def read_conversation(path: Path) -> object:
    """The partner's motion of a clip."""
    from facediff.data.conversations import conversation_file

    (path.parent / "partner").mkdir(exist_ok=True)
    shutil.copy(path, path.parent / "partner" / "clip.npy")
    return conversation_file(path.parent, "partner", "clip")


def read_words(path: Path) -> object:
    """The words that a recording of people says."""
    from facediff.models import transcribed

    return transcribed.read_words(path)


def channel_array(path: Path) -> None:
    """Channels of a clip as a corpus stores them."""
    np.save(path, np.random.default_rng(0).random((4, 52)).astype(np.float32))


def read_channel_array(path: Path) -> object:
    """The same."""
    from facediff.data.storage import ChannelFolder
    from facediff.spaces import layout

    folder = ChannelFolder(path.parent, layout("arkit"))
    folder.path_of("clip").parent.mkdir(exist_ok=True)
    shutil.copy(path, folder.path_of("clip"))
    motion = folder.open("clip")
    return motion.offsets(range(motion.frames), np.zeros((52, 1), np.float32))


def gaze_array(path: Path) -> None:
    """Where the eyes of a clip of the built-in corpus look."""
    np.save(path, np.random.default_rng(0).random((4, 2)).astype(np.float32))


def read_puppet_channels(path: Path) -> object:
    """Channels of a clip of the built-in corpus, of three files."""
    from facediff.data.puppet import SHAPES, PuppetChannels, channel_space

    folder = PuppetChannels(path.parent, channel_space())
    for name, width in ((folder.folder, len(SHAPES)), ("head_npy", 3)):
        (path.parent / name).mkdir(exist_ok=True)
        np.save(path.parent / name / "clip.npy", np.zeros((4, width), np.float32))
    (path.parent / "gaze_npy").mkdir(exist_ok=True)
    shutil.copy(path, path.parent / "gaze_npy" / "clip.npy")
    return folder.values("clip")


def read_a_released_array(path: Path) -> object:
    """Neutral faces of UniTalker's data release."""
    from facediff.models.published.unitalker_checkpoints import released_array

    return released_array(path.parent, ".", path.name, (None, 52))


def released_components(path: Path) -> None:
    """Mean and components of a data set of UniTalker's release."""
    mean, basis = np.zeros(12, np.float32), np.ones((3, 12), np.float32)
    np.savez(path, original_data_mean=mean, components_to_data=basis, data_components_mean=np.zeros(3))


def read_released_components(path: Path) -> object:
    """The same."""
    from facediff.models.published.unitalker_checkpoints import ReleasedData, components_of

    shutil.copy(path, path.parent / "pca.npz")
    released = mock.create_autospec(ReleasedData, instance=True, folder=".", width=12)
    return components_of(path.parent, released, 2)


def read_whether_it_may_have_weights(path: Path) -> object:
    """Whether an exported folder animates weights, by its description alone."""
    from facediff.utils.hub import may_have_weights

    shutil.copy(path, path.parent / "model.json")
    return may_have_weights(path.parent)


def read_whether_an_animation_may_have_weights(path: Path) -> object:
    """Whether weights can be had of an archive's motion."""
    from facediff.cli.export import _may_have_weights

    return _may_have_weights(path, lent=False)


READERS = {
    "plan": Reader(".yaml", plan, read_plan),
    "benchmark, plan": Reader(".json", benchmark_plan, read_a_benchmark_plan),
    "exported model": Reader(".json", exported_model, read_an_exported_model),
    "exported graph": Reader(".onnx", exported_graph, read_an_exported_graph),
    "benchmark, cell": Reader(".json", benchmark_cell, read_a_benchmark_cell),
    "provenance": Reader(".json", provenance, read_a_provenance),
    "answers of a rater": Reader(".json", answers, read_the_answers),
    "study": Reader(".json", a_study, read_the_study),
    **{suffix: Reader(f".{suffix}", sound, read_sound) for suffix in ("wav", "flac", "ogg", "opus", "mp3", "aiff")},
    "wav, a part": Reader(".wav", sound, read_a_stretch),
    **{
        suffix: Reader(f".{suffix}", container, read_sound, 0.5)
        for suffix in ("flv", "m4a", "mp4", "mov", "mkv", "webm", "avi", "aac")
    },
    **{suffix: Reader(f".{suffix}", mesh, read_a_mesh) for suffix in ("obj", "ply", "stl", "off", "glb")},
    "shapes, a folder": Reader(".obj", mesh, shape_folder),
    "shapes, glb": Reader(".glb", targets, read_targets),
    "parameters, Live Link Face": Reader(".csv", recorded("live_link"), read_recorded),
    "parameters, Audio2Face": Reader(".csv", recorded("audio2face"), read_recorded),
    "parameters, BEAT": Reader(".json", recorded("arkit"), read_recorded),
    "parameters, npy": Reader(".npy", recorded("flame_diffposetalk"), read_recorded),
    "parameters, npz": Reader(".npz", recorded("flame_diffposetalk"), read_recorded),
    "parameters, a clip of the built-in corpus": Reader(".npy", gaze_array, read_puppet_channels, 0.3),
    "unitalker, faces": Reader(".npy", channel_array, read_a_released_array, 0.3),
    "unitalker, components": Reader(".npz", released_components, read_released_components, 0.3),
    "exported model, at a glance": Reader(".json", exported_model, read_whether_it_may_have_weights, 0.3),
    "parameters, a style": Reader(".csv", recorded("live_link"), read_recorded_style, 0.5),
    "parameters, a clip of a corpus": Reader(".npy", channel_array, read_channel_array, 0.5),
    "words of a recording": Reader(".txt", lambda path: path.write_text("ſo saß sie da\n", "utf-8"), read_words, 0.3),
    "conversation": Reader(".npy", channel_array, read_conversation, 0.5),
    **{
        f"surface, {name}": Reader(Path(name).suffix, *surface(name), 0.5)
        for name in ("face.obj", "face.mtl", "skin.png", "face.glb")
    },
    **{
        f"audio2face, {name}": Reader(Path(name).suffix, *audio2face(name), 0.3)
        for name in (
            *("bs_skin.npz", "bs_skin_config.json", "implicit_emo_db.npz", "model.json"),
            *("model_config_Nobody.json", "model_data.npz", "network.onnx", "network_info.json"),
        )
    },
    **{
        f"diffposetalk, {name}": Reader(".pt", *diffposetalk(name), 0.2)
        for name in ("iter_0110000.pt", "iter_0026000.pt")
    },
    "parts of a mesh, obj": Reader(".obj", mesh, read_parts),
    "mesh that an animation is added to, glb": Reader(".glb", targets, add_motion),
    "eyes": Reader(".json", eyes, read_the_eyes),
    "eyes, shapes": Reader(".json", blinks, read_the_eyes),
    "eyes, arrays": Reader(".npz", eyes_arrays, read_the_eyes),
    **{f"direction, {suffix}": Reader(f".{suffix}", direction, read_the_direction) for suffix in ("json", "csv")},
    "animation": Reader(".npz", animation, read_an_animation),
    "animation, its weights": Reader(".npz", animation, read_whether_an_animation_may_have_weights),
    "style, archive": Reader(".npz", animation, read_a_style),
    "style, array": Reader(".npy", vertices, read_a_style),
    "correspondence": Reader(".npz", correspondence, read_correspondence),
    "hierarchy": Reader(".npz", hierarchy, read_hierarchy, 0.5),
    "landmarks": Reader(".csv", landmarks, read_the_landmarks),
    "picked landmarks": Reader(".json", picked_landmarks, read_the_landmarks),
    "templates": Reader(".pkl", templates, read_the_templates),
    "vertices": Reader(".npy", vertices, read_the_vertices),
    "indices": Reader(".txt", indices, read_the_indices),
    "weights": Reader(".txt", weights, read_the_weights),
    "lip pairs": Reader(".txt", pairs, read_the_pairs),
    "masks": Reader(".pkl", masks, read_the_masks),
    "clip table": Reader(".csv", clip_table, read_the_clip_table),
    "a corpus's lip pairs": Reader(".txt", pairs, corpus_pairs),
    "a corpus's colours": Reader(".npz", colours, corpus_colours, 0.5),
    "phonemes": Reader(".csv", phonemes, read_the_phonemes),
    "alignment": Reader(".TextGrid", textgrid, read_the_textgrid),
    "alignment of a recording": Reader(".TextGrid", textgrid, read_the_text_grid_of_a_recording),
    "truth of the built-in corpus": Reader(".csv", truth_shapes, read_the_truth, 0.5),
    "manifest": Reader(".json", manifest, read_the_manifest),
    **{
        f"check, {name}": Reader(Path(name).suffix, of_tiny(name), checking(name), 0.3)
        for name in (
            "wav/A_e01.wav",
            "vertices_npy/A_e01.npy",
            "templates.pkl",
            "clips.csv",
            "regions/lve.txt",
            "tiny.ply",
        )
    },
    "check, manifest.json": Reader(".json", manifest, checking("manifest.json"), 0.3),
    "prepared": Reader(".json", state, read_the_state, 0.5),
    "batch record": Reader(".json", record, read_a_record),
    "flame": Reader(".pkl", flame, read_flame, 0.5),
    "flame, arrays": Reader(".npz", flame, read_flame, 0.5),
    "array store": Reader(".npy", vertices, read_the_store),
    "vl": Reader(".vl", vl, read_a_vl),
    "parameters, hdf5": Reader(".hdf5", parameters, read_the_parameters, 0.5),
    "parameters, array": Reader(".npy", parameters, read_the_parameters),
    **{
        f"vocaset, {name}": Reader(Path(name).suffix, *raw_vocaset(name), 0.5)
        for name in ("data_verts.npy", "subj_seq_to_idx.pkl", "raw_audio_fixed.pkl", "templates.pkl")
    },
    "checkpoint": Reader(".ckpt", checkpoint, read_a_checkpoint, 0.3),
    **{
        f"model folder, {name}": Reader(Path(name).suffix, *published(name), 0.2)
        for name in ("config.json", "assets.npz", "model.safetensors")
    },
    **{
        f"published method, {name}": Reader(Path(name).suffix, *authors(name), 0.2)
        for name in ("author.pth", "faces.pkl", "audio.json")
    },
    **{
        f"voca, {name}": Reader(Path(name).suffix, *voca(name), 0.2)
        for name in ("gstep_52280.model.index", "gstep_52280.model.data-00000-of-00001", "output_graph.pb")
    },
    **{
        f"packed, {name}": Reader(Path(name).suffix, *packed(name), 0.2)
        for name in ("zarr.json", "motion_int16/zarr.json", "motion_int16/c/0/0", "speech/c/0", "files/c/0")
    },
    "recording to pack": Reader(
        ".wav", lambda path: shutil.copy(shared("tiny") / "wav/A_e01.wav", path), read_to_pack, 0.2
    ),
    "curves": Reader(".csv", curves, read_the_curves),
    "hubert, config": Reader(".json", *hubert("config.json"), 0.2),
    "hubert, weights": Reader(".safetensors", *hubert("model.safetensors"), 0.2),
    "config": Reader(".yaml", config, read_a_config, 0.1),
}
"""By a name for the tests."""
