r"""Read the model that comes with facediff back into a checkpoint, which can be adapted and trained on.

The package holds graphs, since they are small and need no PyTorch. What they compute with is what the model learnt, in
16 bits. Its checkpoint needs more: names, sizes and the corpus. A training of one step by the same recipe has those
(on one core, in about ten minutes; it makes the corpus, 2.2 GB):

    $ facediff fit --config configs/experiment/puppet_quality.yaml --model.motion_space.lips_weight=3.5 \
        --model.motion_space.eyelids_weight=20 --trainer.max_steps=1 --trainer.limit_val_batches=0
    $ python tools/bundled_checkpoint.py runs/puppet_quality/version_0/checkpoints/last.ckpt -o puppet.ckpt

It prints how far the two differ. The embedding of the diffusion step is a table in the graph, to which its network is
fitted; what speech says of the style is gathered anew from the corpus. Of what only training needs, nothing is left.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from facediff.callbacks.checkpoints import AtomicCheckpointIO
from facediff.cli.generation_metrics import corpus_of_checkpoint
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.models.base import build_model
from facediff.models.checkpoint import read_checkpoint
from facediff.models.dual_path.network import StepEmbedding
from facediff.pipelines.export_model import compare, record, trial_speech
from facediff.utils.hub import BUNDLED

Array = npt.NDArray[np.float32]
WITHOUT = ("network.no_style", "style_identity.", "network.speech_style.")
"""Weights that no graph holds: they are for training, or are gathered anew."""
ROUNDED = 2e-3
"""Largest relative difference that 16 bits leave of a number."""
TRAINING_STATE = (
    *("optimizer_states", "lr_schedulers", "loops", "callbacks"),
    *("facediff_training_state", "current_model_state", "averaging_state"),
)
"""Entries of a checkpoint from which its training would continue."""
SAME = 0.02
"""Share of the motion's range by which the two may differ."""
SEARCH = 1000
"""Steps of the search for their network."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("template", type=Path, help="checkpoint of one step by the recipe of the model")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--folder", type=Path, default=BUNDLED, help="model folder (default: the one of the package)")
    parser.add_argument("--data-root", type=Path, help="folder of the corpus (default: that of the training)")
    given = parser.parse_args(arguments)
    content = read_checkpoint(given.template)
    model = build_model(given.template, content)
    if not isinstance(model, DualPathDiffusion):
        raise FaceDiffError(f"{given.template}: holds no dual-path model; train one by the recipe of the folder")
    weights = weights_of(model, given.folder)
    model.load_state_dict(weights)
    weights |= model.fit_to_features(corpus_of_checkpoint(given.template, given.data_root, None, None))
    off = compare(model, given.folder, trial_speech())["share_of_range"]
    if not off < SAME:
        raise FaceDiffError(f"{given.template}: gives other motion than {given.folder}; train it by the same recipe")
    content = {key: value for key, value in content.items() if key not in TRAINING_STATE}
    AtomicCheckpointIO().save_checkpoint({**content, "state_dict": weights}, given.output)
    print(f"wrote {given.output}: its motion differs from the folder's by {off:.1e} of the range")


def weights_of(model: DualPathDiffusion, folder: Path) -> dict[str, Tensor]:
    """A model's weights out of the graphs of a folder.

    Args:
        model: a dual-path model of the same recipe; its own weights are lost.
        folder: of `facediff export-model`, by the same version of PyTorch, which names what has no name.

    Returns:
        the state dict; what no graph holds is as it was.

    Raises:
        FaceDiffError: if the folder's graphs are those of another model, or a weight is missing.
    """
    found = {name: value.clone() for name, value in model.state_dict().items()}
    # Each weight gets other numbers, by which it is recognised in a graph, whatever became of its name there.
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in model.parameters():
            weight.copy_(0.1 * torch.randn(weight.shape, generator=generator))
    missing = {name for name, _ in model.named_parameters()} - {n for n in found if n.startswith(WITHOUT)}
    for part in model.graphs().parts:
        mine = numbers(record(part))
        theirs = numbers(onnx.load(folder / f"{part.name}.onnx"))
        if mine.keys() != theirs.keys() or any(mine[name].shape != theirs[name].shape for name in mine):
            raise FaceDiffError(f"{folder / part.name}.onnx: is a graph of another model than the template")
        for form, back in forms(model):
            for name, array in mine.items():
                if array.shape == form.shape and np.allclose(array, form, atol=1e-5):
                    read = back(torch.from_numpy(theirs[name]))
                    found |= read
                    missing -= read.keys()
        for name, buffer in model.named_buffers():
            held = next((n for n in mine if n.removeprefix("model.") == name), None)
            # The template's own have all digits; eigenvectors may point the other way.
            if held is not None and not np.allclose(theirs[held], buffer.numpy(), rtol=ROUNDED, atol=1e-6):
                found[name] = torch.from_numpy(theirs[held])
    if missing:
        raise FaceDiffError(f"{folder}: no graph holds {', '.join(sorted(missing))}")
    return found


def numbers(document: onnx.ModelProto) -> dict[str, Array]:
    """What a graph holds, by its name before it was stored in 16 bits; equal single numbers may be stored once."""
    arrays = {each.name: numpy_helper.to_array(each) for each in document.graph.initializer}
    floats = {name: array.astype(np.float32) for name, array in arrays.items() if array.dtype.kind == "f"}
    return {name.removesuffix("_16"): array for name, array in floats.items() if array.size > 1}


Back = Callable[[Tensor], dict[str, Tensor]]
"""From a graph's numbers to weights by name."""


def forms(model: DualPathDiffusion) -> Iterator[tuple[Array, Back]]:
    """The forms in which a graph may hold a model's weights, each with the way back."""
    for name, weight in model.named_parameters():
        array = weight.detach().numpy()
        yield array, lambda held, name=name: {name: held}
        if array.ndim == 2:
            yield array.T, lambda held, name=name: {name: held.T.contiguous()}
        if name.endswith("style_attention.query.bias"):  # of one token, split into heads
            heads = array.reshape(-1, array.size // model.network.decoder.blocks[0].style_attention.num_heads, 1)
            yield heads, lambda held, name=name: {name: held.flatten()}
    levels = [f"network.identity_encoder.{level}.weight" for level in ("coarse", "mid", "fine")]
    tables = [model.get_parameter(name).detach() for name in levels]
    sizes = [table.shape[1] for table in tables]
    yield torch.cat(tables, 1).numpy(), lambda held: dict(zip(levels, torch.split(held, sizes, 1), strict=True))
    prefix = "network.style_encoder.gru."
    biases = [f"{prefix}bias_{end}_l0{way}" for way in ("", "_reverse") for end in ("ih", "hh")]
    rows = torch.stack([gates(model.get_parameter(name).detach()) for name in biases]).reshape(2, -1)
    yield rows.numpy(), lambda held: dict(zip(biases, map(gates, held.reshape(4, -1)), strict=True))
    embedding = model.network.step_embedding
    with torch.no_grad():
        yield embedding(torch.arange(model.process.steps)).numpy(), lambda held: fitted(embedding, held)


def gates(weight: Tensor) -> Tensor:
    """Reset and update gate exchanged: PyTorch has one order, ONNX the other."""
    reset, update, new = weight.chunk(3)
    return torch.cat([update, reset, new])


def fitted(embedding: StepEmbedding, table: Tensor) -> dict[str, Tensor]:
    """The weights of a network of step embeddings by its table (steps, channels).

    The last layer is solved for, since it is linear; the first one is searched.
    """
    network = copy.deepcopy(embedding).double()
    angle = torch.arange(len(table))[:, None] * network.frequencies
    first, bend, last = cast("tuple[nn.Linear, nn.SiLU, nn.Linear]", tuple(network.mlp))
    hidden_of = nn.Sequential(first, bend)
    waves, wanted = torch.cat([angle.sin(), angle.cos()], 1), table.double()

    def solved() -> Tensor:
        hidden = nn.functional.pad(hidden_of(waves), (0, 1), value=1)
        with torch.no_grad():
            square = hidden.T @ hidden
            ridge = 1e-9 * square.trace() / len(square) * torch.eye(len(square), dtype=torch.float64)
            both = torch.linalg.solve(square + ridge, hidden.T @ wanted)
            last.weight.copy_(both[:-1].T)
            last.bias.copy_(both[-1])
        return hidden @ both

    search = torch.optim.LBFGS(
        first.parameters(),
        max_iter=SEARCH,
        history_size=50,
        line_search_fn="strong_wolfe",
        tolerance_grad=1e-12,
        tolerance_change=1e-15,
    )

    def error() -> Tensor:
        search.zero_grad()
        value = 1e3 * (solved() - wanted).square().mean()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    search.step(error)  # type: ignore[no-untyped-call]
    off = float((solved() - wanted).square().mean().sqrt() / wanted.std())
    print(f"step embedding: its network differs from the table by {off:.1e} of the deviation")
    return {f"network.step_embedding.mlp.{name}": weight.float() for name, weight in network.mlp.state_dict().items()}


if __name__ == "__main__":
    main()
