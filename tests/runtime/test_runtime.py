"""Exported models: they give what the model gives, without PyTorch, and damaged folders are refused."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock

import facediff
from facediff import registry
from facediff.animation import write_archive
from facediff.animation.options import AnimationOptions
from facediff.animation.styles import marked
from facediff.cli.app import main
from facediff.errors import FaceDiffError, OptionError
from facediff.models import AnimationModel, DualPathDiffusion
from facediff.models.graphs import update_table
from facediff.models.inference import ClipNoise as ModelNoise
from facediff.models.inference import WindowNoise as ModelWindowNoise
from facediff.models.samplers import DdimSampler, DdpmSampler, DpmSolverSampler, NoiseProcess, Sampler
from facediff.pipelines.export_model import Precision, export_model, store_weights
from facediff.pipelines.exported import ExportedPipeline
from facediff.runtime import RuntimeModel
from facediff.runtime.noise import NormalStream, NumpyWindowNoise, stream_of
from facediff.runtime.styles import style_from
from facediff.speech.voice_activity import QUICK_GATE
from facediff.speech.windows import MotionWindow, WindowPlan
from tests.fakes.tiny import Tiny, tiny_model_options

PLAN = WindowPlan(seconds=1.2, overlap=0.4, before=0.5, after=0.2, above=2.0)
CPU = torch.device("cpu")

pytest.importorskip("onnxscript")


@pytest.mark.parametrize("count", [16, 17, 31, 64, 1000])
def test_noise_is_that_of_pytorch(count: int) -> None:
    for seed in (0, 7, 2**32 + 5):
        generator, found = torch.Generator().manual_seed(seed), NormalStream(seed)
        for _ in range(2):  # a second time from the same stream
            wanted = torch.randn((count,), generator=generator).numpy()
            np.testing.assert_allclose(found.draw((count,)), wanted, atol=2e-6)


def test_noise_of_clips_and_windows_is_that_of_the_model() -> None:
    like = torch.empty(2, 20, 8)
    wanted = ModelNoise(["speech"] * 2, [20] * 2, [3, 4], CPU)(like).numpy()
    for row, seed in zip(wanted, (3, 4), strict=True):
        np.testing.assert_allclose(stream_of("speech", seed)(20, 8)[0], row, atol=2e-6)
    for index in (0, 1, 2):
        window = MotionWindow(PLAN.in_frames(25.0), index, 30 if index < 2 else 17)
        shown = torch.empty(1, window.frames, 8)
        wanted = ModelWindowNoise("speech", window, [3], CPU)(shown).numpy()
        np.testing.assert_allclose(NumpyWindowNoise("speech", window, 3)(window.frames, 8), wanted, atol=2e-6)


@pytest.mark.parametrize(
    "make",
    [
        partial(DdimSampler, steps=4),
        partial(DdimSampler, steps=4, eta=0.5),
        partial(DdpmSampler, steps=5),
        partial(DpmSolverSampler, steps=6, order=3),
        partial(DpmSolverSampler, steps=1),
        partial(DpmSolverSampler, steps=1, spread=1.2),
        partial(DpmSolverSampler, steps=2, spread=1.3),
        partial(DpmSolverSampler, steps=3, spread=1.2),
        partial(DpmSolverSampler, steps=5, spread=1.1),
    ],
)
def test_table_of_updates_runs_the_sampler(make: Callable[..., Sampler]) -> None:
    sampler = make(process=NoiseProcess(40))
    noise = torch.randn(10, 3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    drawn, again = iter(noise[1:]), iter(noise[1:])
    wanted = sampler.run(lambda noisy, step: noisy.sin() + step / 40, noise[0], noise=lambda _: next(drawn))
    noisy, predictions = noise[0], list[torch.Tensor]()
    for step, row in zip(sampler.timesteps, update_table(sampler), strict=True):
        own, *factors, fresh, of_first = [*row, 0.0][:6]
        predictions = [noisy.sin() + step / 40, *predictions]
        noisy = (
            own * noisy + of_first * predictions[-1] + sum(f * p for f, p in zip(factors, predictions, strict=False))
        )
        noisy = noisy + fresh * next(again) if fresh else noisy
    torch.testing.assert_close(noisy, wanted)


def test_a_sampler_that_is_not_declared_linear_is_told_how() -> None:
    class Undeclared(DdimSampler):
        linear = False

    with pytest.raises(FaceDiffError, match=r"Undeclared is no fixed linear combination; .* linear = True"):
        update_table(Undeclared(process=NoiseProcess(), steps=4))


@pytest.fixture(scope="module")
def model(tiny_root: Path) -> AnimationModel:
    """A tiny trained-like model with every part that an export has, and an expressivity of its own."""
    return ready(tiny_root, expressivity=0.8)


def ready(root: Path, **options: object) -> AnimationModel:
    torch.manual_seed(0)
    data = Tiny(root=str(root))
    sampler = partial(registry.sampler.dpm_solver, steps=3)
    made = DualPathDiffusion(**{**tiny_model_options(), "sampler": sampler, **options})
    torch.nn.init.normal_(made.network.embed.bias)
    made.adopt(data.assets().with_motion_scale(data.motion_scale()))
    made.windows = PLAN
    return made.eval()


@pytest.fixture(scope="module")
def folder(model: AnimationModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model's folder; of all processes that run these tests, one exports it."""
    whole_run = tmp_path_factory.getbasetemp()
    shared = whole_run.parent if "PYTEST_XDIST_WORKER" in os.environ else whole_run
    path = shared / "tiny-onnx"
    with FileLock(shared / "tiny-onnx.lock"):
        if not path.exists():
            export_model(model, path)
    return path


def test_a_folder_is_scored_on_the_corpus_that_is_named(
    folder: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["generation-metrics", str(folder), "--corpus", "tests.fakes.tiny.Tiny", "--data-root", str(tiny_root)]
    sampled = ["--samples", "2", "--references", "1", "--max-clips", "1", "--quiet"]
    assert main([*words, *sampled, "--expressivity", "0"]) == 0
    printed = capsys.readouterr().out
    assert "clips: 1 of test_a, 1 of test_b; 2 samples each; dpm_solver with 3 steps, expressivity 0" in printed
    spread = next(line for line in printed.splitlines() if "spread / error, whole face" in line)
    assert spread.split()[-2:] == ["0.000", "0.000"]
    assert main([*words, *sampled, "--steps", "2"]) == 2
    assert "omit --sampler and --steps" in capsys.readouterr().err


def sound(seconds: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    loud = np.repeat(rng.random(int(seconds * 4) + 2), 4000)[: int(seconds * 16_000)]
    return (0.2 * loud * rng.normal(size=len(loud))).astype(np.float32)


def largest(found: np.ndarray, wanted: np.ndarray) -> float:
    """The largest difference as a share of the motion's range."""
    return float(np.abs(found - wanted).max() / np.ptp(wanted - wanted.mean(0)))


def test_an_exported_folder_keeps_the_models_own_voice_gate(folder: Path) -> None:
    """An imported model has none, so that pauses are its authors' too; options that choose one come first."""
    exported = RuntimeModel.open(folder)
    assert exported.description.voice_gate == "energy"
    ungated = copy(exported)
    ungated.description = replace(exported.description, voice_gate="off")
    for model, gate, expected in (
        *((exported, None, "energy"), (exported, "off", "off")),
        *((ungated, None, "off"), (ungated, "energy", "energy")),
    ):
        options = AnimationOptions(checkpoint=folder, voice_gate=gate)
        pipeline = ExportedPipeline(options, model=model)
        assert (pipeline.gate, pipeline.rest is None) == (expected, expected == "off")
    quick = ExportedPipeline(replace(options, low_latency=True, voice_gate=None), model=exported)
    assert quick.gate == QUICK_GATE


@pytest.mark.parametrize("seconds", [0.5, 1.99, 4.3])  # in one pass, and by windows of which the last is short
@pytest.mark.parametrize(("seed", "expressivity"), [(0, 1.0), (5, 1.5), (0, 0.0)])
def test_folder_gives_what_the_model_gives(
    model: AnimationModel, folder: Path, seconds: float, seed: int, expressivity: float
) -> None:
    speech = sound(seconds)
    wanted = model.animate(torch.from_numpy(speech), identity="B", seed=seed, expressivity=expressivity)
    runtime = RuntimeModel.open(folder)
    found = runtime.animate(speech, identity="B", seed=seed, expressivity=expressivity)
    assert largest(found.vertices, wanted.vertices.numpy()) < 1e-4
    assert found.metadata["identity"] == "B"
    assert np.array_equal(found.colours, model.assets.identity_colours["B"])
    assert found.metadata["seed"] == str(seed)


def test_low_latency_gives_what_the_model_gives(model: AnimationModel, folder: Path) -> None:
    runtime, speech = RuntimeModel.open(folder), sound(1.2)
    usual = runtime.animate(speech, identity="B", seed=1).vertices
    runtime.choose_low_latency()
    with model.choosing():
        model.choose_low_latency()
        wanted = model.animate(torch.from_numpy(speech), identity="B", seed=1).vertices.numpy()
    found = runtime.animate(speech, identity="B", seed=1)
    assert largest(found.vertices, wanted) < 1e-4
    assert largest(usual, wanted) > 1e-3
    assert found.metadata["sampler"].endswith("2 steps")
    exported = facediff.load(folder)
    options = {"identity": "B", "seed": 1, "low_latency": True}
    vertices = np.concatenate([*exported.stream(np.split(speech, [1, 9000]), **options)])  # type: ignore[arg-type]
    animation = exported.animate(speech, 16_000, **options)  # type: ignore[call-overload]
    assert np.abs(vertices - animation.vertices).max() < 1e-6 * np.ptp(vertices)


@pytest.mark.parametrize("frames", [1, 7, 130])  # the graph was recorded with 50
def test_style_of_motion_is_that_of_the_model(model: AnimationModel, folder: Path, frames: int) -> None:
    motion = 0.01 * np.random.default_rng(2).normal(size=(frames, 24, 3)).astype(np.float32)
    mask = torch.ones(1, frames, dtype=torch.bool)
    with torch.inference_mode():
        wanted = model.encode_style(torch.from_numpy(motion)[None], mask)[0].numpy()
    runtime = RuntimeModel.open(folder)
    found = runtime.encode_style(motion)
    np.testing.assert_allclose(found.vector, wanted, atol=1e-5 * np.abs(wanted).max())
    made = [runtime.animate(sound(0.5), style=style).vertices for style in (found, None)]
    assert np.abs(made[0] - made[1]).max() > 1e-5


def test_style_comes_from_a_file_or_a_mixture(model: AnimationModel, folder: Path, tmp_path: Path) -> None:
    runtime = RuntimeModel.open(folder)
    vertices = (model.assets.references["B"].motion + model.assets.template("B")).numpy()
    animation = replace(runtime.animate(sound(1.0), identity="B"), vertices=vertices, speech=None)
    write_archive(tmp_path / "b.npz", animation)
    np.save(tmp_path / "B_1.npy", animation.vertices)  # a bare array, whose name says whose face it is
    own = runtime.arrays["styles"][runtime.description.styles.index("B")]
    np.save(tmp_path / "vector.npy", own)
    still = model.encode_style(torch.zeros(1, 5, 24, 3), torch.ones(1, 5, dtype=torch.bool))[0].detach().numpy()
    np.save(tmp_path / "marked.npy", marked(own, still))  # as `facediff style extract` writes it
    np.save(tmp_path / "another.npy", marked(own, still[::-1]))
    with pytest.raises(FaceDiffError, match=r"another\.npy: is of another model"):
        style_from(str(tmp_path / "another.npy"), runtime, "A")
    with pytest.raises(OptionError) as caught:
        style_from("Zoe", runtime, "A")
    assert caught.value.on_command_line.startswith('--style: there is no "Zoe"')
    with pytest.raises(FaceDiffError, match="one style alone cannot be weighted"):
        style_from("A:0.5", runtime, "A")
    for name in ("b.npz", "B_1.npy", "vector.npy", "marked.npy"):
        found = style_from(str(tmp_path / name), runtime, "A")
        np.testing.assert_allclose(found.vector, own, atol=1e-5)
        assert found.name == Path(name).stem
    mixed = style_from(f"A:0.25,{tmp_path / 'b.npz'}:0.75", runtime, "A")
    wanted = 0.25 * runtime.arrays["styles"][runtime.description.styles.index("A")] + 0.75 * own
    np.testing.assert_allclose(mixed.vector, wanted, atol=1e-5)


def test_style_comes_from_what_python_has_at_hand(model: AnimationModel, folder: Path, tmp_path: Path) -> None:
    runtime = RuntimeModel.open(folder)
    motion = (model.assets.references["B"].motion + model.assets.template("B")).numpy()
    animation = replace(runtime.animate(sound(1.0), identity="B"), vertices=motion, speech=None)
    own = runtime.arrays["styles"][runtime.description.styles.index("B")]
    found = [style_from(given, runtime, "B").vector for given in (motion, animation, own, {"B": 1.0}, {"B": 3, "A": 0})]
    np.testing.assert_allclose(found, np.broadcast_to(own, (5, len(own))), atol=1e-5)
    animated = [facediff.load(folder).animate(sound(0.5), 16_000, identity="B", style=style) for style in (motion, "B")]
    np.testing.assert_allclose(animated[0].vertices, animated[1].vertices, atol=1e-5)
    np.testing.assert_allclose(facediff.load(folder).extract_style([motion, "B"], identity="B"), own, atol=1e-5)
    for wrong, expected in ((motion[:, :3], "3"), (["B"], "shape"), (own[:2], "2 numbers")):
        with pytest.raises(FaceDiffError, match=expected):
            style_from(wrong, runtime, "B")


def test_a_bare_motion_is_completed_by_a_folder(folder: Path, tmp_path: Path) -> None:
    exported = facediff.load(folder)
    animation = exported.animate(sound(0.5), 16_000, identity="B")
    np.save(tmp_path / "b.npy", animation.vertices)
    for model in (exported, folder):
        read = facediff.read(tmp_path / "b.npy", checkpoint=model, identity="B")
        np.testing.assert_array_equal(read.template, animation.template)
        assert (read.unit, read.frame_rate) == (animation.unit, animation.frame_rate) == (exported.unit, 25)
    assert (exported.n_vertices, exported.other_identities) == (
        len(animation.template),
        [*({*exported.model.description.faces} - {*exported.identities})],
    )
    keys = [{"time": 0, "channel": "style", "value": "A"}]
    with pytest.raises(FaceDiffError, match="needs the model itself"):
        exported.animate(sound(0.5), 16_000, direction=keys)


def test_gate_holds_the_mouth_at_rest_in_silence(folder: Path) -> None:
    still = facediff.load(folder).animate(np.zeros(32_000, np.float32), 16_000)
    weights = RuntimeModel.open(folder).arrays["rest_weights"][0]
    assert np.allclose(still.vertices[:, weights == 1], still.template[weights == 1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"sampling_space": "vertices"},
        {"motion_space": partial(registry.motion_space.components, count=6)},
        {"motion_space": partial(registry.motion_space.components, count=6, prior_frames=7)},
        {"sampler": partial(registry.sampler.ddpm, steps=4)},
        {"sampler": partial(registry.sampler.dpm_solver, steps=5, spread=1.3)},
        {"style_encoder": registry.style_encoder.none, "fusion": registry.fusion.add},
        {"decoder": registry.decoder.gru},
    ],
    ids=["vertices", "components", "prior over time", "ddpm", "spread", "no style", "gru"],
)
def test_other_parts_are_exported_too(tiny_root: Path, tmp_path: Path, options: dict[str, object]) -> None:
    made = ready(tiny_root, **options)
    if "motion_space" in options:
        made.measure(Tiny(root=str(tiny_root)))  # type: ignore[operator]
    check = export_model(made, tmp_path / "out").check
    assert check["share_of_range"] < 1e-4


@pytest.mark.slow
def test_faces_and_styles_of_some_identities_are_exported(tiny_root: Path, tmp_path: Path) -> None:
    made = ready(tiny_root)
    with pytest.raises(FaceDiffError, match='identities: there is no identity "nobody"'):
        export_model(made, tmp_path / "out", identities=["nobody"])
    description = export_model(made, tmp_path / "out", identities=["B"])
    assert description.faces == ["B"]
    assert all(name.startswith("B") for name in description.styles)
    speech = np.random.default_rng(0).normal(size=16_000).astype(np.float32) * 0.1
    assert facediff.load(tmp_path / "out").animate(speech, 16_000).metadata["identity"] == "B"


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "bound"), [("float16", 0.02), ("int8", 0.1)])
def test_fewer_bits_make_a_smaller_folder(
    tiny_root: Path, tmp_path: Path, precision: str, bound: float, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("facediff.pipelines.export_model.SMALLEST", 64)
    description = export_model(ready(tiny_root), tmp_path / "out", precision=precision)  # type: ignore[arg-type]
    assert 0 < description.check["share_of_range"] < bound
    whole = json.loads((folder / "model.json").read_text())["sizes"]["speech.onnx"]
    assert description.sizes["speech.onnx"] < whole


def test_without_pytorch_the_commands_animate_and_perform(folder: Path, tmp_path: Path) -> None:
    """A process in which torch, SciPy and Lightning cannot be imported."""
    import soundfile

    soundfile.write(tmp_path / "speech.wav", sound(1.0), 16_000)
    program = (
        "import sys\n"
        "for name in ('torch', 'scipy', 'lightning', 'transformers', 'torchmetrics'): sys.modules[name] = None\n"
        "import facediff\n"
        "from facediff.cli.app import main\n"
        "folder, speech, out = sys.argv[1:]\n"
        "for name in ('out.npz', 'out.glb', 'out.html'):\n"
        "    assert main(['animate', speech, '--checkpoint', folder, '-o', f'{out}/{name}', '--threads', '1']) == 0\n"
        "assert main(['live', folder, speech, '--to', f'jsonl:{out}/out.jsonl?weights=false', '--quiet']) == 0\n"
        "facediff.load(folder).animate(speech).save(f'{out}/python.npz')\n"
    )
    command = [sys.executable, "-c", program, str(folder), str(tmp_path / "speech.wav"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    sizes = {path.name: path.stat().st_size for path in tmp_path.glob("*.*")}
    assert all(sizes[name] > 1000 for name in ("out.npz", "out.glb", "out.html", "out.jsonl", "python.npz"))


BROKEN = {
    "no description": ("model.json", lambda path: path.unlink(), "model.json"),
    "other json": ("model.json", lambda path: path.write_text("[]"), "model.json"),
    "cut graph": ("step.onnx", lambda path: path.write_bytes(path.read_bytes()[:-9]), "step.onnx"),
    "no arrays": ("arrays.npz", lambda path: path.unlink(), "arrays.npz"),
    "no graph": (
        "speech.onnx",
        lambda path: path.write_bytes(b"\0" * path.stat().st_size),
        "speech.onnx",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_damaged_folder_is_refused(case: str, folder: Path, tmp_path: Path) -> None:
    name, spoil, named = BROKEN[case]
    shutil.copytree(folder, tmp_path / "copy")
    spoil(tmp_path / "copy" / name)
    with pytest.raises(FaceDiffError, match=named):
        RuntimeModel.open(tmp_path / "copy")


@pytest.mark.parametrize(("precision", "stored"), [("float16", "FLOAT16"), ("int8", "INT8"), ("float32", "FLOAT")])
def test_only_what_was_learnt_is_stored_in_fewer_bits(precision: Precision, stored: str) -> None:
    """A linear map's weights are learnt, in a graph as their transpose; the kernel of a transform is not."""
    from onnx import TensorProto, helper, numpy_helper

    module = torch.nn.Linear(64, 128, bias=False)
    kernel = np.cos(np.outer(np.arange(128), np.arange(128))).astype(np.float32)
    weight = module.weight.detach().numpy().T
    named = {"weight": weight, "kernel": kernel}
    nodes = [helper.make_node("MatMul", ["x", "weight"], ["y"]), helper.make_node("MatMul", ["y", "kernel"], ["z"])]
    ends = [[helper.make_tensor_value_info(*end)] for end in (("x", TensorProto.FLOAT, [1, 64]), ("z", 1, [1, 128]))]
    made = [numpy_helper.from_array(np.ascontiguousarray(value), name) for name, value in named.items()]
    document = helper.make_model(helper.make_graph(nodes, "two maps", *ends, made))
    store_weights(document, precision, module)
    found = {each.name: each.data_type for each in document.graph.initializer}
    assert found.pop("kernel") == TensorProto.FLOAT
    assert {kind for name, kind in found.items() if "scale" not in name} == {getattr(TensorProto, stored)}


def test_facediff_load_animates_a_folder_as_a_model(folder: Path, tmp_path: Path) -> None:
    import facediff

    model, runtime, speech = facediff.load(folder), RuntimeModel.open(folder), sound(4.3)
    assert model.identities[0] in runtime.description.identities
    for options in ({"seed": 2}, {"identity": "B", "expressivity": 0.5}):
        for gate in ("energy", "off"):
            chosen = {**options, "voice_gate": gate}
            animation = model.animate(speech, 16_000, **chosen)  # type: ignore[call-overload]
            assert isinstance(animation, facediff.Animation)
            pieces = np.split(speech, [1, 1000, 30_000, 30_001])
            streamed = np.concatenate([*model.stream(pieces, **chosen)])  # type: ignore[arg-type]
            assert np.abs(streamed - animation.vertices).max() < 1e-6 * np.ptp(streamed)
        # Without the gate it is the model's own motion.
        np.testing.assert_array_equal(animation.vertices, runtime.animate(speech, **options).vertices)
    assert model.animate([speech, speech[:9000]], 16_000, seed=None, low_latency=True)[1].metadata["seed"]
    assert len(model.animate(speech[:9000], 16_000, samples=2)) == 2
    np.testing.assert_array_equal(model.model.windows, runtime.windows)
    for option, value in {"steps": 3, "guidance": {"style": 2}, "precision": "bf16"}.items():
        with pytest.raises(FaceDiffError, match=f"{option}: is fixed in an exported model"):
            model.animate(speech, 16_000, **{option: value})  # type: ignore[call-overload]
    with pytest.raises(FaceDiffError, match="device: is fixed in an exported model"):
        facediff.load(folder, device="cuda")
    with pytest.raises(FaceDiffError, match="expressivity"):
        model.animate(speech, 16_000, expressivity={"lips": 0.5})
