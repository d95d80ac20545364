"""Every model that has graphs: the runtime makes of them what the model makes.

Recording a graph takes seconds, so the quick tests run the graphs' modules as they are, in place of ONNX Runtime; the
slow ones export them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facediff import registry
from facediff.data import collate
from facediff.data.batch import UNKNOWN_IDENTITY
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel
from facediff.models.evaluation import with_identity
from facediff.models.graphs import Graph
from facediff.pipelines.export_model import arrays_of, describe, export_model, record
from facediff.pipelines.exported_model import ExportedModel
from facediff.runtime import RuntimeModel
from facediff.speech.windows import WindowPlan
from tests.fakes.channels import CHANNELS, TinyChannels, write_channels
from tests.fakes.tiny import RATE, SEEN, UNSEEN, VERTICES, Tiny
from tests.models.published.conftest import METHODS
from tests.runtime.test_runtime import sound

PLAN = WindowPlan(seconds=1.2, overlap=0.4, before=0.5, after=0.2, above=2.0)
MEL = partial(registry.audio_encoder.mel, hidden_dim=16, num_layers=1, dropout=0.0)
SIZES: dict[str, Any] = {"n_vertices": VERTICES, "identities": SEEN, "frame_rate": float(RATE), "audio_encoder": MEL}

STYLE_CONTENT = {"dim": 16, "content_dim": 16}
SELFTALK = {**METHODS["SelfTalk"], "lip_reader": "none"}
FACEDIFFUSER, DIFFSPEAKER, VOCA = (METHODS[name] for name in ("FaceDiffuser", "DiffSpeaker", "Voca"))
OWN = {"audio_dim": None}  # the encoder's own channels

DUAL_PATH = {
    **{"dim": 16, "diffusion_steps": 40, "sampler": partial(registry.sampler.dpm_solver, steps=3)},
    "style_encoder": partial(registry.style_encoder.tcn_gru_transformer, num_layers=1),
    "decoder": partial(registry.decoder.style_transformer, num_layers=1),
}
IN_CHANNELS = {"n_vertices": len(CHANNELS.channels), "space": CHANNELS}

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "dual path in channels": ("DualPathDiffusion", {**DUAL_PATH, **IN_CHANNELS}),
    "style content in channels": (
        "StyleContentDisentanglement",
        {**STYLE_CONTENT, **IN_CHANNELS, "mesh_encoder": registry.mesh_encoder.linear},
    ),
    "EmoTalk in channels": ("EmoTalk", {**METHODS["EmoTalk"], **IN_CHANNELS}),
    "UniTalker in channels": ("UniTalker", {**METHODS["UniTalker"], **IN_CHANNELS}),
    "LAM in channels": ("LamAudio2Expression", {**METHODS["LamAudio2Expression"], **IN_CHANNELS}),
    "style content": ("StyleContentDisentanglement", STYLE_CONTENT),
    "style content at 50": ("StyleContentDisentanglement", {**STYLE_CONTENT, "speech_rate": 50}),
    "style content at 12.5": ("StyleContentDisentanglement", {**STYLE_CONTENT, "speech_rate": 12.5}),
    "SelfTalk": ("SelfTalk", SELFTALK),
    "SelfTalk at 25, wav2vec": ("SelfTalk", {**SELFTALK, **OWN, "audio_encoder": "wav2vec2"}),
    "SelfTalk at 30, wav2vec": ("SelfTalk", {**SELFTALK, **OWN, "audio_encoder": "wav2vec2", "frame_rate": 30.0}),
    "EmoTalk": ("EmoTalk", METHODS["EmoTalk"]),
    "FaceDiffuser": ("FaceDiffuser", FACEDIFFUSER),
    "FaceDiffuser, folded, HuBERT": (
        "FaceDiffuser",
        {**FACEDIFFUSER, **OWN, "audio_encoder": "wav2vec2", "sampling_space": "folded"},
    ),
    "FaceDiffuser, offsets, skips": ("FaceDiffuser", {**FACEDIFFUSER, "noised": "offsets", "skip_steps": 3}),
    "FaceDiffuser at 30": ("FaceDiffuser", {**FACEDIFFUSER, "frame_rate": 30.0, "sampling_space": "folded"}),
    "DiffSpeaker": ("DiffSpeaker", DIFFSPEAKER),
    "DiffSpeaker, ddim, HuBERT": (
        "DiffSpeaker",
        {**DIFFSPEAKER, **OWN, "audio_encoder": "wav2vec2", "scheduler": "ddim", "smooth": False},
    ),
    "Voca": ("Voca", VOCA),
    "Voca at 25, DeepSpeech": ("Voca", {**VOCA, **OWN, "audio_encoder": "deepspeech"}),
    "Voca at 60, DeepSpeech": ("Voca", {**VOCA, **OWN, "audio_encoder": "deepspeech", "frame_rate": 60.0}),
}
"""Models by what is special about them, and their options."""

Sources = dict[str, Path]


@pytest.fixture(scope="module")
def sources(hubert_source: Path, deepspeech_source: Path, tmp_path_factory: pytest.TempPathFactory) -> Sources:
    """Pretrained networks in miniature by the audio encoder that reads them, and the corpus in channels."""
    channels = write_channels(tmp_path_factory.mktemp("corpus") / "channels")
    return {"wav2vec2": hubert_source, "deepspeech": deepspeech_source, "channels": channels}


@dataclass
class Session:
    """A graph as ONNX Runtime would run it, by PyTorch."""

    graph: Graph

    def get_inputs(self) -> list[Any]:
        return [type("Input", (), {"name": name}) for name in self.graph.inputs]

    def run(self, _: None, inputs: dict[str, np.ndarray], __: object) -> list[np.ndarray]:
        assert {*inputs} == {*self.graph.inputs}
        with torch.inference_mode():
            made = self.graph.module(*(torch.from_numpy(inputs[name]) for name in self.graph.inputs))
        return [each.numpy() for each in (made if isinstance(made, tuple) else (made,))]


def ready(case: str, root: Path, sources: Sources) -> AnimationModel:
    torch.manual_seed(0)
    name, options = CASES[case]
    options = {**SIZES, **options}
    if isinstance(encoder := options["audio_encoder"], str):
        options["audio_encoder"] = partial(registry.audio_encoder.get(encoder), source=str(sources[encoder]))
    made, data = registry.model.get(name)(**options), Tiny(root=str(root))
    if "space" in options:
        data = TinyChannels(root=str(sources["channels"]))
    for parameter in made.parameters():
        if parameter.requires_grad and not parameter.any():
            torch.nn.init.normal_(parameter, std=0.1)
    assets = data.assets().with_motion_scale(data.motion_scale())
    made.adopt(replace(assets, frame_rate=made.frame_rate))
    made.attach_mesh()
    return made.eval()  # type: ignore[no-any-return]


def in_eager(model: AnimationModel) -> RuntimeModel:
    """The runtime over the graphs' own modules."""
    graphs = model.graphs()
    parts = {part.name: part for part in graphs.parts}
    faces = list(model.assets.templates)
    arrays, styles = arrays_of(model, graphs, faces, {})
    about = describe(model, graphs, "float32", {}, dict.fromkeys(parts, {}), styles, faces)
    return RuntimeModel(about, arrays, lambda name: Session(parts[name]))


def assert_alike(runtime: RuntimeModel, model: AnimationModel, seconds: float, identity: str, seed: int) -> None:
    runtime.windows = model.windows = PLAN
    speech = sound(seconds)
    wanted = model.animate(torch.from_numpy(speech), identity=identity, seed=seed).vertices.numpy()
    found = runtime.motion(speech, runtime.stream(identity=identity, seed=seed))
    assert found.shape == wanted.shape
    span = np.ptp(wanted - model.assets.template(identity).numpy())
    assert np.abs(found - wanted).max() / span < 1e-4


@pytest.mark.parametrize("case", CASES)
def test_runtime_gives_what_the_model_gives(case: str, tiny_root: Path, sources: Sources) -> None:
    model = ready(case, tiny_root, sources)
    runtime = in_eager(model)
    for seconds, identity in ((0.3, "B"), (1.013, UNSEEN), (4.317, "A")):  # the last one by windows
        assert_alike(runtime, model, seconds, identity, seed=5)


@pytest.mark.parametrize("case", ["dual path in channels", "style content", "Voca", "FaceDiffuser"])
def test_scores_of_graphs_are_of_the_motion_that_the_model_makes(case: str, tiny_root: Path, sources: Sources) -> None:
    """For its own speakers, those of others, and speakers whose name is hidden; with a style of motion or by name."""
    model = ready(case, tiny_root, sources)
    data = TinyChannels(root=str(sources["channels"])) if "channels" in case else Tiny(root=str(tiny_root))
    exported = ExportedModel.of(in_eager(model), model.assets)
    assert exported.samples == model.samples
    known, hidden = data.dataset("test_a")[0], data.dataset("test_b")[0]
    for sample in (known, hidden, replace(known, identity=UNKNOWN_IDENTITY)):
        batch = collate([sample])
        with torch.inference_mode():
            wanted = model.sample_clip(batch, [3])
            assert torch.allclose(exported.sample_clip(batch, [3]), wanted, atol=1e-4 * float(wanted.abs().max()))
            usual, of_folder = model.default_style("B"), exported.default_style("B")
            vectors = [
                each.style_of(with_identity(batch, 1, style)) for each, style in ((model, usual), (exported, of_folder))
            ]
        assert torch.allclose(*vectors, atol=1e-2)


def test_channels_are_decoded_by_the_rig_of_the_face(tiny_root: Path, sources: Sources) -> None:
    model = ready("dual path in channels", tiny_root, sources)
    runtime, assets = in_eager(model), model.assets
    for identity in ("B", UNSEEN):
        animation = runtime.animate(sound(1.0), identity=identity, seed=5)
        assert animation.values is not None
        assert animation.space == CHANNELS
        offsets = torch.from_numpy(animation.values)[..., None] - assets.template(identity)
        decoded = (assets.to_scored(offsets, identity) + assets.mesh.template(identity)).numpy()
        # The folder's displacements have 16 bits.
        assert np.abs(animation.vertices - decoded).max() < 1e-4 * np.ptp(decoded - decoded[:1])


def test_style_content_takes_a_style_from_motion(tiny_root: Path) -> None:
    model = ready("style content", tiny_root, {})
    motion = 0.01 * np.random.default_rng(2).normal(size=(30, VERTICES, 3)).astype(np.float32)
    with torch.inference_mode():
        wanted = model.encode_style(torch.from_numpy(motion)[None], torch.ones(1, 30, dtype=torch.bool))[0].numpy()
    np.testing.assert_allclose(in_eager(model).encode_style(motion).vector, wanted, atol=1e-6)
    with pytest.raises(FaceDiffError, match="style"):
        in_eager(ready("Voca", tiny_root, {})).encode_style(motion)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_exported_folder_gives_what_the_model_gives(
    case: str, tiny_root: Path, tmp_path: Path, sources: Sources
) -> None:
    model = ready(case, tiny_root, sources)
    assert export_model(model, tmp_path / "out").check["share_of_range"] < 1e-4
    runtime = RuntimeModel.open(tmp_path / "out")
    for seconds, identity in ((0.3, "B"), (4.317, UNSEEN)):
        assert_alike(runtime, model, seconds, identity, seed=5)
    if "style" in runtime.description.graphs:
        shape = (33, model.n_vertices, model.dims)
        motion = 0.01 * np.random.default_rng(2).normal(size=shape).astype(np.float32)
        with torch.inference_mode():
            wanted = model.encode_style(torch.from_numpy(motion)[None], torch.ones(1, 33, dtype=torch.bool))[0].numpy()
        np.testing.assert_allclose(runtime.encode_style(motion).vector, wanted, atol=1e-5 * np.abs(wanted).max())


def test_direct_model_has_no_samples_around_a_mean(tiny_root: Path) -> None:
    model = ready("style content", tiny_root, {})
    runtime = in_eager(model)
    with pytest.raises(FaceDiffError, match="expressivity"):
        runtime.animate(sound(1.0), expressivity=0.5)
    with pytest.raises(FaceDiffError, match="expressivity"):
        ExportedModel.of(runtime, model.assets).choose_expressivity(0.5)


class Branching(torch.nn.Module):
    """Asks for a value, which a graph cannot know."""

    def forward(self, motion: torch.Tensor) -> torch.Tensor:
        return motion if motion.sum() > 0 else -motion


class ByLength(torch.nn.Module):
    def forward(self, motion: torch.Tensor) -> torch.Tensor:
        return motion if motion.shape[1] > 64 else -motion


def test_a_part_that_depends_on_the_length_is_refused() -> None:
    with pytest.raises(FaceDiffError, match="step: a component branches on the clip's length"):
        record(Graph("step", ByLength(), {"motion": torch.ones(1, 5)}, {"motion": {1: "frames"}}, ("clean",)))


def test_a_part_that_depends_on_values_is_refused_in_one_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(FaceDiffError, match=r"step: .*data-dependent") as caught:
        record(Graph("step", Branching(), {"motion": torch.ones(1, 5)}, {"motion": {1: "frames"}}, ("clean",)))
    assert "[96m" not in str(caught.value)
    assert capfd.readouterr().err == ""
