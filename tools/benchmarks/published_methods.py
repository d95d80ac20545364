"""How quickly the published methods animate, at the size of VOCASET and BIWI, and what their literal ways cost.

The weights are random, which changes no time. Every ratio is of one run on one machine:

    python tools/benchmarks/published_methods.py --seconds 10
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from facediff.data import Assets
from facediff.models import AnimationModel, CodeTalker, FaceDiffuser, FaceFormer, SelfTalk, TalkingStyle
from facediff.models.published.autoregressive import AutoregressiveModel, Loop
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.utils.tables import print_table

Size = tuple[int, float, int]
"""Vertices, frames a second and identities."""

SETS: dict[str, Size] = {"VOCASET": (5023, 30.0, 8), "BIWI": (23_370, 25.0, 6)}
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


LOOPED: dict[str, type[AutoregressiveModel]] = {
    "FaceFormer": FaceFormer,
    "TalkingStyle": TalkingStyle,
    "CodeTalker": CodeTalker,
}
"""Methods that go frame by frame."""


def made(
    kind: type[AnimationModel],
    vertices: int,
    rate: float,
    count: int,
    network: dict[str, Any] = BASE,
    **options: Any,  # noqa: ANN401
) -> AnimationModel:
    """A model of random weights with a face."""
    names = [f"speaker{i}" for i in range(count)]
    encoder = partial(Wav2Vec2Encoder, config=network, edges=False, epsilon=1e-5)
    model = kind(n_vertices=vertices, identities=names, frame_rate=rate, audio_encoder=encoder, **options)
    everything = torch.arange(vertices)
    templates = {name: torch.randn(vertices, 3) for name in names}
    model.adopt(Assets("none", True, "m", rate, names, templates, None, {"lips": everything, "upper_face": everything}))
    return model.eval()


def seconds_of(work: Callable[[], object]) -> float:
    """Seconds that some work takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


Note = Callable[[str, AnimationModel, float], None]
"""Takes a way, its model and its seconds."""


def time_loops(
    kind: type[AutoregressiveModel], network: dict[str, Any], size: Size, speech: Tensor, note: Note
) -> None:
    """A method that goes frame by frame: with keys and values kept, and without."""
    model = made(kind, *size, network)
    assert isinstance(model, AutoregressiveModel)
    model.animate(speech[:16_000], identity="speaker0")  # the first call is slower
    loops: tuple[Loop, Loop] = ("cached", "literal")
    spent = []
    for model.loop in loops:
        spent.append(seconds_of(partial(model.animate, speech, identity="speaker0")))
        note(model.loop, model, spent[-1])
    print(f"{kind.__name__}: cached is {spent[1] / spent[0]:.1f} times as fast as literal")


def time_selftalk(size: Size, speech: Tensor, note: Note) -> None:
    """SelfTalk without its lip reader, of which only training has any use."""
    model = made(SelfTalk, *size, LARGE, lip_reader="none")
    model.animate(speech[:16_000], identity="speaker0")
    note("one pass", model, seconds_of(partial(model.animate, speech, identity="speaker0")))


def time_facediffuser(size: Size, speech: Tensor, note: Note, steps: int) -> None:
    """FaceDiffuser with speech encoded in each step or once, on vertices and folded; some of the steps are timed."""
    model = made(FaceDiffuser, *size)
    assert isinstance(model, FaceDiffuser)
    # All steps cost the same; the speech of the other ways is encoded once among those that are timed.
    part = model.steps / steps
    model.skip_steps = model.steps - steps
    clip = model.clip_of(speech, "speaker0", None)
    heard = seconds_of(partial(torch.no_grad()(model.hear), clip, clip.frame_lengths))
    found = {}
    for way, encode, space in (
        ("literal", "every_step", "vertices"),
        ("speech once", "once", "vertices"),
        ("speech once, folded", "once", "folded"),
    ):
        model.encode_speech, model.sampling_space = encode, space  # type: ignore[assignment]
        taken = seconds_of(partial(model.animate, speech, identity="speaker0"))
        taken = taken * part if encode == "every_step" else heard + max(taken - heard, 0.0) * part
        found[way] = taken
        note(way, model, taken)
    for way in ("speech once", "speech once, folded"):
        print(f"FaceDiffuser: {way} is {found['literal'] / found[way]:.1f} times as fast as literal")


def main() -> None:
    """Print one row for each method, data set and way."""
    methods = (*LOOPED, "SelfTalk", "FaceDiffuser")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the speech")
    parser.add_argument("--steps", type=int, default=10, help="denoising steps of FaceDiffuser that are timed")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS), help="sizes of faces")
    parser.add_argument("--methods", nargs="+", choices=methods, default=methods, help="which are timed")
    asked = parser.parse_args()
    speech = 0.1 * torch.randn(int(asked.seconds * 16_000))
    rows: list[tuple[object, ...]] = []
    for name, size in ((name, SETS[name]) for name in asked.sets):
        for method in asked.methods:

            def note(way: str, model: AnimationModel, taken: float, name: str = name, method: str = method) -> None:
                parameters = sum(p.numel() for p in model.parameters()) / 1e6
                rows.append((method, name, way, f"{parameters:.1f} M", f"{taken:.2f}", f"{taken / asked.seconds:.2f}"))
                print(*rows[-1], flush=True)

            if method == "FaceDiffuser":
                time_facediffuser(size, speech, note, asked.steps)
            elif method == "SelfTalk":
                time_selftalk(size, speech, note)
            else:
                time_loops(LOOPED[method], LARGE if method == "TalkingStyle" else BASE, size, speech, note)
    print_table(["method", "faces", "way", "parameters", "seconds", "seconds per second of speech"], rows)


if __name__ == "__main__":
    main()
