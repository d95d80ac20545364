"""How quickly every published method animates at the size of VOCASET and BIWI, and what its literal way costs.

The weights are random, which changes no time; audio encoders have their published size. The table is Markdown, for
docs/methods.md, and every ratio in it is of one run on one machine:

    python tools/benchmarks/published_methods.py
    python tools/benchmarks/published_methods.py --without-literal --sets BIWI --methods DiffSpeaker

The literal ways take up to an hour, most of it CodeTalker's and FaceDiffuser's.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from sampling_tables import processor

from facediff import registry
from facediff.data import Assets
from facediff.models.deepspeech import DeepSpeechEncoder
from facediff.models.published.autoregressive import AutoregressiveModel
from facediff.models.published.base import PublishedModel
from facediff.models.published.diffspeaker import DiffSpeaker
from facediff.models.published.facediffuser import FaceDiffuser
from facediff.spaces import VERTICES
from facediff.spaces.layouts import layout

SETS = {"VOCASET": (5023, 30.0, 8), "BIWI": (23_370, 25.0, 6)}
LAYOUTS = {
    "LamAudio2Expression": ("arkit", 30.0),
    "UniTalker": ("arkit", 30.0),
    "EmoTalk": ("arkit", 30.0),
    "DiffPoseTalk": ("flame_diffposetalk", 25.0),
    "ARTalk": ("flame_artalk", 25.0),
}
"""Methods that generate parameters, timed in these once in place of faces."""
BASE = {"model_type": "wav2vec2", "hidden_size": 768, "num_hidden_layers": 12, "num_attention_heads": 12}
LARGE = {
    "model_type": "wav2vec2",
    "hidden_size": 1024,
    "num_hidden_layers": 24,
    "num_attention_heads": 16,
    "intermediate_size": 4096,
    "conv_bias": True,
    "feat_extract_norm": "layer",
    "do_stable_layer_norm": True,
}
TOY = {
    "model_type": "wav2vec2",
    "hidden_size": 8,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "intermediate_size": 8,
    "conv_dim": [4] * 7,
    "num_conv_pos_embeddings": 4,
    "num_conv_pos_embedding_groups": 2,
}
DEEPSPEECH = {"inputs": 494, "first": 2048, "second": 2048, "third": 4096, "cell": 2048, "fifth": 2048, "logits": 29}
TOY_OPTIONS: dict[str, dict[str, Any]] = {
    "CodeTalker": {"num_layers": 1, "prior_dim": 16, "prior_layers": 1, "tokens": 2, "codes": 4},
    "FaceDiffuser": {"diffusion_steps": 8},
    "EmoTalk": {"emotion_config": TOY, "emotion_dim": 2, "level_dim": 1, "person_dim": 1},
    "DiffPoseTalk": {"num_heads": 2, "style_dim": 8, "style_heads": 2, "diffusion_steps": 2},
    "ARTalk": {"num_heads": 2, "codec_dim": 8, "codec_heads": 2, "style_dim": 8, "style_heads": 2, "code_dim": 4},
    "Voca": {"components": 8},
}
"""Sizes of methods that ``dim=8`` alone does not make small."""

OPTIONS: dict[str, dict[str, Any]] = {
    "SelfTalk": {"lip_reader": "none"},
    "EmoTalk": {"emotion_config": LARGE},
    "LamAudio2Expression": {"transformer_layers": 6},
}
"""Options of methods whose defaults are for training."""

PROCESSOR_TIME = "--processor-time"
"""Seconds of the processor in place of the clock's, for a machine that has other work."""

WARM_UP = 4_000
"""Samples of an animation before the one that is timed, since the first one is slower."""

FEW_STEPS = 2
"""Denoising steps of the shorter of two animations, whose difference gives the cost of a step."""

HEAD = ("method", "faces", "way", "parameters", "seconds", "real-time factor", "times as fast as literal")


@dataclass(frozen=True)
class Way:
    """A way to animate that a method has.

    Attributes:
        name: for the table.
        attributes: of the model that choose it.
        literal: whether the published code computes so.
    """

    name: str
    attributes: dict[str, Any] = field(default_factory=dict)
    literal: bool = False


def ways_of(kind: type[PublishedModel]) -> list[Way]:
    """The ways of a method, the quickest first."""
    if issubclass(kind, AutoregressiveModel):
        return [
            Way("keys and values kept", {"loop": "cached"}),
            Way("literal", {"loop": "literal"}, literal=True),
        ]
    if issubclass(kind, FaceDiffuser):
        return [
            Way("speech once, folded", {"encode_speech": "once", "sampling_space": "folded"}),
            Way("speech once", {"encode_speech": "once", "sampling_space": "vertices"}),
            Way("literal", {"encode_speech": "every_step", "sampling_space": "vertices"}, literal=True),
        ]
    if issubclass(kind, DiffSpeaker):
        return [
            Way("folded", {"sampling_space": "folded"}),
            Way("literal", {"sampling_space": "vertices"}, literal=True),
        ]
    return [Way("one pass", literal=True)]


def methods() -> dict[str, type[PublishedModel]]:
    """Every published method by name."""
    found = {name: registry.model.get(name) for name in registry.model.names()}
    return {name: kind for name, kind in found.items() if issubclass(kind, PublishedModel)}


def made(name: str, faces: tuple[int, float, int], *, toy: bool) -> PublishedModel:
    """A method of random weights, with faces."""
    kind, (vertices, rate, count) = methods()[name], faces
    names = [f"speaker{i}" for i in range(count)]
    encoder: Any = kind.published_encoder
    if encoder is DeepSpeechEncoder:
        config = {name: 8 if toy and size > 494 else size for name, size in DEEPSPEECH.items()}
    else:
        source = encoder.keywords["source"]
        config = TOY if toy else LARGE if "large" in source or "xls-r" in source else BASE
    encoder = partial(encoder, config=config)
    options = {**OPTIONS.get(name, {}), **({"dim": 8, **TOY_OPTIONS.get(name, {})} if toy else {})}
    space = VERTICES
    if name in LAYOUTS:
        layout_name, rate = LAYOUTS[name]
        space = layout(layout_name)
        vertices = len(space.channels)
    sizes = {"n_vertices": vertices, "identities": names, "frame_rate": rate, "space": space}
    model = kind(**sizes, audio_encoder=encoder, **options)
    everything = torch.arange(vertices)
    templates = {each: torch.randn(vertices, space.dims) for each in names}
    regions = {"lips": everything, "upper_face": everything}
    model.adopt(Assets("none", True, "m", rate, names, templates, None, regions, space=space))
    return model.eval()


def seconds_of(work: Callable[[], object]) -> float:
    """Seconds that some work takes."""
    clock = time.process_time if PROCESSOR_TIME in sys.argv else time.perf_counter
    start = clock()
    work()
    return clock() - start


def timed(model: PublishedModel, way: Way, speech: torch.Tensor, steps: int) -> float:
    """Seconds of one animation; what is computed once a model is computed before."""
    for name, value in way.attributes.items():
        setattr(model, name, value)
    animate = partial(model.animate, identity=model.identities[0])
    if not isinstance(model, FaceDiffuser):
        animate(speech[:WARM_UP])
        return seconds_of(partial(animate, speech))
    # All of its steps cost the same, and so few of them are timed and then some more: the difference is theirs alone.
    found = {}
    for count in (min(FEW_STEPS, model.steps), min(FEW_STEPS + steps, model.steps)):
        model.skip_steps = model.steps - count
        animate(speech[:WARM_UP])
        found[count] = seconds_of(partial(animate, speech))
    (few, short), (more, long) = found.items()
    return short + max(long - short, 0.0) * (model.steps - few) / (more - few)


def rows_of(asked: argparse.Namespace) -> Iterator[tuple[str, ...]]:
    """The table's rows, each as soon as it is known with those of the same model."""
    speech = 0.1 * torch.randn(round(asked.seconds * 16_000))
    for faces in asked.sets:
        for name, kind in methods().items():
            if (asked.methods and name not in asked.methods) or (name in LAYOUTS and faces != asked.sets[0]):
                continue
            model = made(name, (30, *SETS[faces][1:]) if asked.toy else SETS[faces], toy=asked.toy)
            parameters = f"{sum(p.numel() for p in model.parameters()) / 1e6:.1f} M"
            chosen = [
                way for way in ways_of(kind) if not (asked.without_literal and way.literal) or len(ways_of(kind)) == 1
            ]
            taken = {way.name: timed(model, way, speech, asked.steps) for way in chosen}
            literal = next((taken[way.name] for way in chosen if way.literal and len(chosen) > 1), None)
            for way, seconds in taken.items():
                ratio = "" if literal is None or way == "literal" else f"{literal / seconds:.1f}"
                shown = LAYOUTS[name][0] if name in LAYOUTS else faces
                yield f"`{name}`", shown, way, parameters, f"{seconds:.2f}", f"{seconds / asked.seconds:.3f}", ratio


def main() -> None:
    """Print one row for each method, data set and way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the speech")
    parser.add_argument("--steps", type=int, default=10, help="denoising steps of FaceDiffuser that are timed")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS), help="sizes of faces")
    parser.add_argument("--methods", nargs="+", choices=list(methods()), help="these methods alone")
    parser.add_argument("--without-literal", action="store_true", help="leave out the slow ways of the published code")
    parser.add_argument(PROCESSOR_TIME, action="store_true", help="count the processor's seconds, not the clock's")
    parser.add_argument("--toy", action="store_true", help="tiny networks and faces, to try the benchmark itself")
    asked = parser.parse_args()
    threads, load = torch.get_num_threads(), os.getloadavg()[0]
    print(
        f"machine: {processor('cpu')}, {threads} threads, load {load:.1f}; {asked.seconds:g} s of speech",
        file=sys.stderr,
    )
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}", flush=True)
    for row in rows_of(asked):
        print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
