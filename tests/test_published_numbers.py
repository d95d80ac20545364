"""Every number that the dual-path paper prints about its training: constructors' defaults and the paper's configs.

The paper: section 2.1 (data), 2.2 (setting), 1.2 and 1.3 (encoders), eq. 15 to 18 (losses).
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from typing import Any

import pytest
import torch
import yaml

from facediff.cli.app import main
from facediff.data import Biwi, Mead3D, SpeechMotionDataModule, Vocaset
from facediff.metrics import ShannonIndex
from facediff.models import DualPathDiffusion
from facediff.models.audio_encoders import HubertEncoder
from facediff.models.losses import huber
from facediff.models.losses_fused import fused_losses
from facediff.models.samplers import DdpmSampler, NoiseProcess
from facediff.models.speaker_encoders import TcnGruTransformer
from facediff.utils.hints import defaults

CORPORA: dict[str, type[SpeechMotionDataModule]] = {"biwi": Biwi, "vocaset": Vocaset, "mead3d": Mead3D}

MODEL = "model.init_args"
IN_CONFIGS: dict[str, Any] = {
    # What the paper states.
    "trainer.max_epochs": 50,
    "data.init_args.batch_size": 1,
    "data.init_args.max_frames_per_batch": None,
    f"{MODEL}.learning_rate": 1e-4,
    f"{MODEL}.weight_decay": 0.05,
    f"{MODEL}.diffusion_steps": 1000,
    f"{MODEL}.noise_schedule": "squaredcos_cap_v2",
    f"{MODEL}.velocity_weight": 0.003,
    f"{MODEL}.acceleration_weight": 0.003,
    f"{MODEL}.face_weight": 0.0005,
    f"{MODEL}.audio_encoder.class_path": "facediff.models.audio_encoders.HubertEncoder",
    f"{MODEL}.audio_encoder.init_args.source": "facebook/hubert-base-ls960",
    f"{MODEL}.style_encoder.class_path": "facediff.models.speaker_encoders.TcnGruTransformer",
    f"{MODEL}.style_encoder.init_args.dilations": [1, 2, 4, 8, 16],
    f"{MODEL}.style_encoder.init_args.num_layers": 2,
    f"{MODEL}.identity_encoder.class_path": "facediff.models.speaker_encoders.HierarchicalIdentity",
    f"{MODEL}.mesh_encoder.class_path": "facediff.models.mesh_encoders.LinearMeshEncoder",
    f"{MODEL}.fusion.class_path": "facediff.models.fusions.BidirectionalCrossAttention",
    f"{MODEL}.decoder.class_path": "facediff.models.decoders.StyleTransformer",
    f"{MODEL}.sampler.class_path": "facediff.models.samplers.DdpmSampler",
    f"{MODEL}.sampler.init_args.steps": 1000,
    # What it does not mention, so that there is none of it.
    "trainer.precision": "32-true",
    "trainer.gradient_clip_val": None,
    "trainer.accumulate_grad_batches": 1,
    f"{MODEL}.lr_schedule": "constant",
    f"{MODEL}.warmup_steps": 0,
    f"{MODEL}.motion_scale": "none",
    f"{MODEL}.motion_space.class_path": "facediff.models.motion_space.VertexMotion",
    f"{MODEL}.noise_scale": 1.0,
    f"{MODEL}.noise_draws": 1,
    f"{MODEL}.style_tokens": "single",
    f"{MODEL}.identity_dropout": 0.0,
    f"{MODEL}.style_dropout": 0.0,
    f"{MODEL}.speech_dropout": 0.0,
    f"{MODEL}.invented_speakers": 0.0,
    f"{MODEL}.speech_guidance": 1.0,
    f"{MODEL}.identity_guidance": 1.0,
    f"{MODEL}.style_guidance": 1.0,
    f"{MODEL}.expressivity": 1.0,
    f"{MODEL}.style_identity_weight": 0.0,
    f"{MODEL}.fusion.init_args.rotary": False,
    f"{MODEL}.decoder.init_args.final_norm": False,
    # Where it is silent: as in the code that it builds on (FaceDiffuser), or whole clips.
    f"{MODEL}.audio_encoder.init_args.frozen_layers": 2,
    f"{MODEL}.protocol": "paper",
    "data.init_args.window": None,
    "data.init_args.reference": "same_subject",
}


def value_at(config: dict[str, Any], path: str) -> object:
    found: Any = config
    for key in path.split("."):
        found = found[key]
    return found


@pytest.fixture(scope="module", params=CORPORA)
def config(request: pytest.FixtureRequest) -> dict[str, Any]:
    """A paper's config as the command line composes it."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.raises(SystemExit):
        main(["fit", "--config", f"configs/experiment/{request.param}_paper.yaml", "--print_config"])
    return {"corpus": request.param, **yaml.safe_load(printed.getvalue())}


def test_paper_configs_have_every_published_number(config: dict[str, Any]) -> None:
    found = {path: value_at(config, path) for path in IN_CONFIGS}
    assert {path: value for path, value in found.items() if value != IN_CONFIGS[path]} == {}
    assert config["data"]["class_path"].rpartition(".")[2] == CORPORA[config["corpus"]].__name__
    assert config["data"]["init_args"].get("split") == ("both" if config["corpus"] == "mead3d" else None)


def test_paper_configs_average_no_weights(config: dict[str, Any]) -> None:
    names = [callback["class_path"].rpartition(".")[2] for callback in config["trainer"]["callbacks"]]
    assert not [name for name in names if "Averaging" in name or "Ema" in name]


DEFAULTS: list[tuple[Callable[..., Any], str, Any]] = [
    (DualPathDiffusion, "learning_rate", 1e-4),
    (DualPathDiffusion, "weight_decay", 0.05),
    (DualPathDiffusion, "lr_schedule", "constant"),
    (DualPathDiffusion, "diffusion_steps", 1000),
    (DualPathDiffusion, "noise_schedule", "squaredcos_cap_v2"),
    (DualPathDiffusion, "velocity_weight", 0.003),
    (DualPathDiffusion, "acceleration_weight", 0.003),
    (DualPathDiffusion, "face_weight", 0.0005),
    (DualPathDiffusion, "protocol", "paper"),
    (TcnGruTransformer, "dilations", (1, 2, 4, 8, 16)),
    (TcnGruTransformer, "num_layers", 2),
    (HubertEncoder, "frozen_layers", 2),
    (ShannonIndex, "clusters", 40),
    (HubertEncoder, "source", "facebook/hubert-base-ls960"),
    (Biwi, "batch_size", 1),
    (Vocaset, "batch_size", 1),
    (Mead3D, "batch_size", 1),
]


@pytest.mark.parametrize(("owner", "option", "published"), DEFAULTS)
def test_defaults_of_constructors_are_the_published_numbers(
    owner: Callable[..., Any], option: str, published: object
) -> None:
    assert defaults(owner)[option] == published


def test_the_papers_sampler_visits_every_step() -> None:
    process = NoiseProcess(1000, "squaredcos_cap_v2")
    visited: list[int] = []

    def denoise(sample: torch.Tensor, step: int) -> torch.Tensor:
        visited.append(step)
        return sample

    start = torch.zeros(1, 2, 3)
    DdpmSampler(process=process).run(denoise, start, noise=torch.zeros_like)
    assert visited == list(range(999, -1, -1))


def test_the_cosine_schedule_is_the_published_one() -> None:
    """ᾱ_n = f(n) / f(0), f(n) = cos²((n/N + 0.008) / 1.008 · π/2), each step's noise at most 0.999."""
    steps = torch.arange(1001, dtype=torch.float64)
    f = torch.cos((steps / 1000 + 0.008) / 1.008 * torch.pi / 2) ** 2
    kept = (1 - (1 - f[1:] / f[:-1]).clamp(max=0.999)).cumprod(0)
    torch.testing.assert_close(NoiseProcess(1000, "squaredcos_cap_v2").signal.double(), kept, rtol=1e-4, atol=1e-7)


def test_the_huber_loss_turns_from_a_square_into_a_line_at_one() -> None:
    mask = torch.ones(1, 3, dtype=torch.bool)
    for gap, expected in ((0.5, 0.125), (1.0, 0.5), (3.0, 2.5)):
        truth = torch.zeros(1, 3, 2, 3)
        assert huber(truth + gap, truth, mask).item() == pytest.approx(expected)
        fused = fused_losses(
            torch.zeros(1, 3, 4), torch.zeros(6, 4), torch.full((6,), gap), truth, mask, torch.tensor([0]),
            {"reconstruction": 1.0, "velocity": 0.003, "acceleration": 0.003, "face": 0.0005}, scale=1.0,
        )  # fmt: skip
        assert fused["loss"].item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("corpus", "frame_rate", "vertices", "speakers", "clips"),
    [
        ("biwi", 25.0, 23370, 6, {"train": 192, "val": 24, "test_a": 24, "test_b": 32}),
        ("vocaset", 30.0, 5023, 8, {"train": 320, "val": 40, "test_b": 40}),
        ("mead3d", 25.0, 5023, 32, {}),
    ],
)
def test_facts_of_the_corpora(
    corpus: str, frame_rate: float, vertices: int, speakers: int, clips: dict[str, int]
) -> None:
    data = CORPORA[corpus]
    assert (data.frame_rate, data.n_vertices, len(data.identities)) == (frame_rate, vertices, speakers)
    assert {split: len(names) for split, names in data.expected_clips().items()} == clips
    assert Vocaset.stored_frame_rate == 60.0


def test_3dmead_is_split_by_speaker_as_configured() -> None:
    """32 speakers train, 7 others validate, 8 others test; nobody is in two splits."""
    data = Mead3D(root=".", split="identity")
    people = [f"{sex}{number:03d}" for sex in "MW" for number in range(1, 50)]
    found: dict[str | None, list[str]] = {}
    for person in people:
        splits = set()
        for name in (f"{person}_001_0_0", f"{person}_040_0_0", f"{person}_030_6_2"):
            clip = Mead3D.parse_name(name)
            assert clip is not None
            splits.add(data.split_of(clip))
        assert len(splits) == 1
        found.setdefault(splits.pop(), []).append(person)
    found.pop(None)
    assert {split: len(names) for split, names in found.items()} == {"train": 32, "val": 7, "test_b": 8}
