"""Every number that a constructor takes states its range; whatever is built can be used, and all else is one sentence.

The catalogue is the registry itself: a new component, model, corpus or callback is drawn without a line here.
"""

from __future__ import annotations

import inspect
import math
import pickle
import typing
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Annotated, Any, get_args, get_origin

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError
from lightning.pytorch import Callback, LightningDataModule

import facediff.callbacks
import facediff.callbacks.checkpoints
from facediff import registry
from facediff.data import SpeechMotionDataModule
from facediff.data.parametric import FlameClips
from facediff.errors import ArgumentError, FaceDiffError
from facediff.models import AnimationModel
from facediff.registry import alias_path
from facediff.utils.hints import defaults
from facediff.utils.ranges import Range
from tests.fakes.tiny import SEEN, VERTICES, Tiny

for kind in registry.KINDS.values():
    kind.load()

USUAL_MISTAKES = (math.nan, -1, 0, 1.5, 2**40, "x", None)
FURTHER = (math.inf, -math.inf, -0.5, 1e-320, 1e300, 2**2000, "", [], [-1], 1j)
WILD = pytest.mark.parametrize(
    "values",
    [USUAL_MISTAKES, pytest.param(FURTHER, marks=pytest.mark.slow)],
    ids=["usual mistakes", "further values"],
)
NAMED_OTHERWISE = (
    "root people recordings lips upper_face extra_identities protocol metrics identities source sampler frame_rate "
    "n_vertices"
)
"""Arguments that stand for files, folders or names: the sentence names these."""

SIZES: dict[str, Any] = {"n_vertices": VERTICES, "identities": SEEN, "frame_rate": 25.0}
CALLBACKS = sorted(
    (
        made
        for module in (facediff.callbacks, facediff.callbacks.checkpoints)
        for made in vars(module).values()
        if inspect.isclass(made) and issubclass(made, Callback) and made.__module__.startswith("facediff")
    ),
    key=lambda made: made.__name__,
)
COMPONENTS = [entry for kind in registry.COMPONENTS.values() for entry in kind]
OWNED = [*(entry.implementation for entry in [*COMPONENTS, *registry.model, *registry.corpus]), *CALLBACKS]


def constructors(made: type) -> Iterator[Callable[..., None]]:
    """The constructors of a class and of those of its bases that are facediff's."""
    for cls in made.__mro__:
        if "__init__" in vars(cls) and cls.__module__.startswith("facediff"):
            yield vars(cls)["__init__"]


def arguments(made: type) -> dict[str, Any]:
    """The options of a class, with their type hints."""
    found: dict[str, Any] = {}
    for init in constructors(made):
        hints = typing.get_type_hints(init, include_extras=True)
        for name, parameter in inspect.signature(init).parameters.items():
            if name != "self" and parameter.kind is not parameter.VAR_KEYWORD:
                found.setdefault(name, hints[name])
    return found


def unbounded(hint: Any) -> bool:  # noqa: ANN401
    """Whether a hint lets any number pass."""
    if get_origin(hint) is Annotated:
        return not any(isinstance(extra, Range) for extra in get_args(hint))
    if get_origin(hint) is typing.Literal:
        return False
    return hint in (int, float) or any(map(unbounded, get_args(hint)))


@pytest.mark.parametrize("made", dict.fromkeys(OWNED), ids=lambda made: made.__name__)
def test_every_number_states_its_range(made: type) -> None:
    if made.__module__.split(".")[0] != "facediff":
        pytest.skip("optional for a third party")
    assert [name for name, hint in arguments(made).items() if unbounded(hint)] == []


def batch_of(tiny: Tiny) -> Any:  # noqa: ANN401
    from facediff.data import collate

    dataset = tiny.dataset("train")
    return collate([dataset[0], dataset[5]])


def draw(
    made: type,
    build: Callable[..., Any],
    use: Callable[[Any], None],
    path: str,
    values: Iterable[object],
    names: Iterable[str] = (),
) -> list[str]:
    """Give every argument each of the wild values; what neither works nor is refused by name."""
    wrong = []
    for name in names or arguments(made):
        for value in values:
            given = f"{name}={str(value)[:20]}"
            try:
                use(build(**{name: value}))
            except FaceDiffError as error:
                if f"{path}.{name}" not in str(error) and name not in NAMED_OTHERWISE.split():
                    wrong.append(f"{given}: {error}")
            except TypeCheckError as error:
                # The tests' import hook takes no whole number for a decimal one and no list for a tuple.
                if value not in (0, []):
                    wrong.append(f"{given}: {error}")
            except Exception as error:
                wrong.append(f"{given}: {type(error).__name__}: {error}")
    return wrong


TINY: dict[str, Any] = {
    "dim": 8,
    "audio_encoder": partial(registry.audio_encoder.mel, hidden_dim=8, num_layers=1),
}
MODELS: dict[str, dict[str, Any]] = {
    "DualPathDiffusion": {
        "style_encoder": partial(registry.style_encoder.tcn_gru_transformer, num_layers=1, dilations=(1,)),
        "decoder": partial(registry.decoder.style_transformer, num_layers=1),
        "diffusion_steps": 20,
        "sampler": partial(registry.sampler.ddim, steps=2),
    },
    "StyleContentDisentanglement": {
        "content_dim": 8,
        "mesh_encoder": registry.mesh_encoder.linear,
        "speech_layers": 1,
        "decoder_channels": (8,),
        "decoder_kernels": (3,),
        "decoder_hidden": (8,),
        "basis_size": 4,
    },
}


@pytest.fixture
def use_model(tiny: Tiny) -> Callable[[AnimationModel], None]:
    """A step of training, and inference."""
    batch, assets = batch_of(tiny), tiny.assets().with_motion_scale(1.0)

    def use(model: AnimationModel) -> None:
        model.adopt(assets)
        model.attach_mesh()
        model.train().losses(batch)["loss"].backward()
        model.configure_optimizers() if not model.warmup_steps and model.lr_schedule == "constant" else None
        assert torch.isfinite(model.eval().generate(batch, seed=0)).all()
        _ = model.evaluation

    return use


@WILD
@pytest.mark.parametrize("name", MODELS)
def test_wild_arguments_of_a_model(
    name: str, values: Iterable[object], use_model: Callable[[AnimationModel], None]
) -> None:
    made = registry.model.get(name)

    def build(**options: object) -> AnimationModel:
        model: AnimationModel = made(**{**SIZES, **TINY, **MODELS[name], **options})
        return model

    use_model(build())
    assert draw(made, build, use_model, "model", values) == []


@WILD
@pytest.mark.parametrize("entry", COMPONENTS, ids=lambda entry: entry.implementation.__name__)
def test_wild_arguments_of_a_component(
    entry: registry.Entry,
    values: Iterable[object],
    use_model: Callable[[AnimationModel], None],
    hubert_source: object,
    deepspeech_source: object,
) -> None:
    kind = alias_path(entry.implementation).split(".")[2]
    sources = {"hubert": hubert_source, "wav2vec2": hubert_source, "deepspeech": deepspeech_source}
    base: dict[str, Any] = {"source": str(sources[entry.name])} if entry.name in sources else {}
    if entry.name == "spiral":
        base = {"channels": (4,), "spiral_length": 4}
    if kind == "sampler":
        base = {"steps": 2}
    name = "StyleContentDisentanglement" if kind == "mesh_encoder" else "DualPathDiffusion"

    def build(**options: object) -> AnimationModel:
        chosen = {kind: partial(entry.implementation, **{**base, **options})}
        model: AnimationModel = registry.model.get(name)(**{**SIZES, **TINY, **MODELS[name], **chosen})
        return model

    options = [name for name in defaults(entry.implementation) if name != "config"]
    assert not options or draw(entry.implementation, build, use_model, f"model.{kind}", values, options) == []


@WILD
@pytest.mark.filterwarnings("ignore:.*a sub-sample of")
@pytest.mark.parametrize("made", [Tiny, *(e.implementation for e in registry.corpus)], ids=lambda made: made.__name__)
def test_wild_arguments_of_a_corpus(
    made: type[SpeechMotionDataModule], values: Iterable[object], tiny_root: object
) -> None:
    def use(data: LightningDataModule) -> None:
        if isinstance(data, Tiny) and data.num_workers == 0:
            next(iter(data.train_dataloader()))
            next(iter(data.predict_dataloader()))
            data.assets()

    needed = {"root": str(tiny_root), **({"layout": "flame_artalk"} if made is FlameClips else {})}
    assert draw(made, lambda **options: made(**{**needed, **options}), use, "data", values) == []


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"dim": 33}, "model.dim 33"),
        ({"dim": 10}, "model.decoder.num_heads 4"),
        (
            {"decoder": partial(registry.decoder.gru), "dim": 7, "style_encoder": registry.style_encoder.none},
            "model.dim 7",
        ),
        ({"sampler": partial(registry.sampler.ddim, steps=21)}, "model.diffusion_steps 20"),
        ({"diffusion_steps": 90_000, "noise_schedule": "linear"}, "model.noise_schedule linear"),
        ({"frame_rate": math.nan}, "model.frame_rate nan"),
        ({"identities": []}, "model.identities"),
        ({"learning_rate": np.float32("inf")}, "model.learning_rate inf"),
    ],
)
def test_arguments_that_do_not_go_together(options: dict[str, object], named: str) -> None:
    fixed = {"fusion": registry.fusion.add} if "style_encoder" in options or named.endswith("num_heads 4") else {}
    if named.endswith("num_heads 4"):
        fixed["style_encoder"] = registry.style_encoder.none
    with pytest.raises(ArgumentError, match=named.replace(".", r"\.")) as caught:
        registry.model.get("DualPathDiffusion")(**{**SIZES, **TINY, **MODELS["DualPathDiffusion"], **fixed, **options})
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # noqa: S301 - own bytes
    assert caught.value.sentence("--").startswith("--model.")
