"""What sampling costs in principal components, beside folded sampling on vertices, at the size of a mesh.

Run ``python tools/benchmarks/motion_spaces.py``: random weights of the demo's width, 10 s of noise as speech, 23 370
vertices as in BIWI. Both models take turns and the quickest of the repeats counts, so that whatever else the machine
does meets them alike.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Sequence
from functools import partial

import torch

from facediff import registry
from facediff.data import Assets, Sample, collate
from facediff.models import DualPathDiffusion
from facediff.speech.audio import samples_for

FRAME_RATE = 25.0
SAMPLERS = {
    "vertices, dpm_solver 5": ("vertices", partial(registry.sampler.dpm_solver, steps=5)),
    "vertices, dpm_solver 10": ("vertices", partial(registry.sampler.dpm_solver, steps=10)),
    "components, dpm_solver 10": (
        "components",
        partial(registry.sampler.dpm_solver, steps=10, spacing="log_snr", last_noise=0.5),
    ),
}


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vertices", type=int, default=23370, help="vertices of the face (default: BIWI's 23370)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the speech (default: 10)")
    parser.add_argument("--dim", type=int, default=128, help="model width (default: the demo's 128)")
    parser.add_argument("--count", type=int, default=64, help="principal components (default: the demo's 64)")
    parser.add_argument("--repeats", type=int, default=5, help="timed repetitions (default: 5)")
    given = parser.parse_args(arguments)
    frames = round(given.seconds * FRAME_RATE)
    template = torch.zeros(given.vertices, 3)
    region = torch.arange(10)
    assets = Assets(
        corpus="noise",
        synthetic=True,
        unit="m",
        frame_rate=FRAME_RATE,
        identities=["A"],
        templates={"A": template},
        faces=None,
        regions={"lips": region, "upper_face": region},
        motion_scale=1.0,
    )
    sample = Sample(
        name="A_e01",
        identity_name="A",
        identity=0,
        sentence="e01",
        audio=torch.randn(samples_for(frames, FRAME_RATE)),
        motion=torch.zeros(frames, given.vertices, 3),
        template=template,
        reference=torch.randn(100, given.vertices, 3),
        reference_name="A_e02",
    )
    batch, models = collate([sample]), {}
    for name, (space, sampler) in SAMPLERS.items():
        torch.manual_seed(0)
        options = {"count": given.count} if space == "components" else {}
        model = DualPathDiffusion(
            n_vertices=given.vertices,
            identities=["A"],
            frame_rate=FRAME_RATE,
            dim=given.dim,
            motion_space=partial(registry.motion_space.get(space), **options),
            mesh_encoder=registry.mesh_encoder.get("components" if space == "components" else "linear"),
            sampler=sampler,
        )
        model.adopt(assets)
        models[name] = model.eval()
    spent: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(given.repeats + 1):  # the first warms up
        for name, model in models.items():
            start = time.perf_counter()
            with torch.inference_mode():
                model.generate(batch, seed=0)
            spent[name].append(time.perf_counter() - start)
    best = {name: min(times[1:]) for name, times in spent.items()}
    first = next(iter(best))
    print(
        f"{platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}; width {given.dim}, ",
        end="",
    )
    print(f"{given.vertices} vertices, {given.count} components, {given.seconds:g} s of speech")
    print(f"{'':28}{'seconds':>9}{'real-time factor':>18}{'ratio':>8}")
    for name, seconds in best.items():
        print(f"{name:28}{seconds:9.3f}{seconds / given.seconds:18.4f}{seconds / best[first]:8.2f}")


if __name__ == "__main__":
    main()
