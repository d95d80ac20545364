"""One model for many faces: two topologies and a rig's channels in miniature, trained together."""

from __future__ import annotations

import pickle
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from facediff import registry
from facediff.callbacks import EmaWithWarmup
from facediff.callbacks.checkpoints import AtomicCheckpointIO
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, ManyFaces, load_model
from facediff.models.checkpoint import corpus_of, read_checkpoint
from facediff.models.dual_path.network import TRUNK
from facediff.models.styles import style_from, vector_of
from tests.fakes.channels import TinyChannels, write_channels
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import VERTICES, Tiny, tiny_model_options, write_tiny


class Halved(Tiny):
    """Every second vertex of the miniature corpus: another topology."""

    n_vertices = VERTICES // 2
    mesh_files: ClassVar[tuple[str, ...]] = ()


def write_halved(root: Path) -> Path:
    write_tiny(root)
    for path in (root / "vertices_npy").glob("*.npy"):
        np.save(path, np.load(path).reshape(-1, VERTICES, 3)[:, ::2].reshape(-1, VERTICES * 3 // 2))
    templates = pickle.loads((root / "templates.pkl").read_bytes())  # noqa: S301 - written above
    (root / "templates.pkl").write_bytes(pickle.dumps({name: face[::2] for name, face in templates.items()}))
    for file, indices in (("lve.txt", range(6)), ("fdd.txt", range(6, 12))):
        (root / "regions" / file).write_text(",".join(map(str, indices)))
    (root / "regions" / "inner_lip_pairs.txt").write_text("0, 3\n")
    (root / "colours.npz").unlink()
    return root


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("faces")
    writers = {"tiny": write_tiny, "halved": write_halved, "weights": write_channels}
    return {name: write(folder / name) for name, write in writers.items()}


def corpora(roots: dict[str, Path], **options: Any) -> Tiny:  # noqa: ANN401
    further = {
        name: {"corpus": f"{kind.__module__}.{kind.__name__}", "root": str(roots[name]), "batch_size": 2}
        for name, kind in (("halved", Halved), ("weights", TinyChannels))
    }
    return Tiny(root=str(roots["tiny"]), batch_size=3, further_corpora=further, **options)


@pytest.mark.parametrize("name", ["keys", "items", "pop", "forward", "training", "type", "x.y", "clear", "a/b", ""])
def test_a_name_that_no_part_of_a_model_can_have_is_refused(name: str, roots: dict[str, Path]) -> None:
    further = {name: {"corpus": f"{Halved.__module__}.{Halved.__name__}", "root": str(roots["halved"])}}
    with pytest.raises(FaceDiffError, match="a name that a part of a model can have"):
        Tiny(root=str(roots["tiny"]), further_corpora=further)


def many_faces(data: Tiny) -> ManyFaces:
    sizes = ("n_vertices", "identities", "frame_rate")
    options = {name: value for name, value in tiny_model_options().items() if name not in sizes}
    torch.manual_seed(0)
    return ManyFaces.for_data(
        data,
        motion_space=partial(registry.motion_space.components, count=4),
        mesh_encoder=partial(registry.mesh_encoder.components, count=4),
        style_from_speech=True,
        **options,
    )


@pytest.fixture(scope="module")
def trained(roots: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained") / "many.ckpt"
    data = corpora(roots)
    trainer = quiet_trainer(path.parent, max_epochs=2, callbacks=[EmaWithWarmup()], plugins=[AtomicCheckpointIO()])
    trainer.fit(many_faces(data), data)
    assert {"val/energy", "val/halved/energy", "val/weights/energy"} <= trainer.callback_metrics.keys()
    trainer.save_checkpoint(path)
    return path


def test_batches_are_of_one_corpus_spread_evenly_and_go_on_where_they_were_left(roots: dict[str, Path]) -> None:
    loader = corpora(roots).train_dataloader()
    loader.sampler.set_epoch(1)
    order = [(batch.face, tuple(batch.names), batch.reference_names) for batch in loader]
    assert Counter(face for face, _, _ in order) == {"": 3, "halved": 4, "weights": 4}  # 8 clips by 3, 2 and 2
    assert len(loader) == len(order)
    for half in (order[: len(order) // 2], order[len(order) // 2 :]):
        assert len({face for face, _, _ in half}) == 3
    assert all(len({name[0] for name in names}) <= 2 for _, names, _ in order)
    again = corpora(roots).train_dataloader()
    again.load_state_dict({"epoch": 1, "batches": 5, "seed": 0})
    assert [(batch.face, tuple(batch.names), batch.reference_names) for batch in again] == order[5:]
    again.sampler.set_epoch(2)
    assert len(list(again)) == len(order)


def test_faces_share_the_trunk_and_nothing_else(roots: dict[str, Path]) -> None:
    model = many_faces(corpora(roots))
    for _, face in model.heads():
        for name in TRUNK:
            assert getattr(face.network, name) is getattr(model.network, name)
        for name in ("embed", "unembed", "mesh_encoder", "identity_encoder", "speech_style"):
            assert getattr(face.network, name) is not getattr(model.network, name)
    counted = sum(p.numel() for p in model.parameters())
    single = {name: sum(p.numel() for p in face.parameters()) for name, face in model.heads()}
    assert counted < single["halved"] + single["weights"]  # three faces, less than two models


def test_a_step_on_one_face_trains_the_trunk_and_its_own_head_only(roots: dict[str, Path], trained: Path) -> None:
    model = load_model(trained)
    assert isinstance(model, ManyFaces)
    batch = next(batch for batch in corpora(roots).train_dataloader() if batch.face == "weights")
    model.train().losses(batch)["loss"].backward()  # type: ignore[no-untyped-call]
    reached = {name for name, p in model.named_parameters() if p.grad is not None and bool(p.grad.any())}
    assert any(name.startswith("network.decoder") for name in reached)
    assert "further_faces.weights.network.embed.weight" in reached
    assert not any(name.startswith(("network.embed", "network.unembed", "further_faces.halved")) for name in reached)


def test_largest_movements_of_all_faces_have_one_size(trained: Path) -> None:
    model = load_model(trained)
    assert isinstance(model, ManyFaces)
    sizes = [float(face.motion_space.sizes[0]) for face in (model, *dict(model.heads()).values())]
    assert np.allclose(sizes, sizes[0], rtol=1e-4)


@pytest.mark.parametrize(("face", "shape"), [("halved", (12, 3)), ("weights", (24, 3))])
def test_each_face_is_a_model_of_its_own_by_its_name(
    roots: dict[str, Path], trained: Path, face: str, shape: tuple[int, int]
) -> None:
    speech = torch.sin(torch.arange(16000) / 9) * 0.3
    own = load_model(f"{trained}:{face}")
    assert type(own) is DualPathDiffusion
    assert own.assets.scored.templates["A"].shape == shape
    assert corpus_of(trained, read_checkpoint(f"{trained}:{face}"))[1]["root"] == str(roots[face])
    whole = load_model(trained)
    assert isinstance(whole, ManyFaces)
    head = dict(whole.heads())[face]
    one, other = (model.eval().animate(speech, identity="B", seed=1) for model in (own, head))
    assert torch.equal(one.vertices, other.vertices)
    assert whole.animate(speech, identity="B").vertices.shape[1:] == (24, 3)


def test_faces_take_each_others_styles(roots: dict[str, Path], trained: Path, tmp_path: Path) -> None:
    clip, vector = roots["halved"] / "vertices_npy" / "A_e02.npy", tmp_path / "style.npy"
    assert main(["style", "extract", str(clip), "--checkpoint", f"{trained}:halved", "-o", str(vector)]) == 0
    model = load_model(trained)
    np.testing.assert_array_equal(vector_of(style_from(str(vector), "B", model), model), np.load(vector))


def test_folders_of_publish_keep_all_faces(trained: Path, tmp_path: Path) -> None:
    whole = load_model(trained)
    assert isinstance(whole, ManyFaces)
    for part in (whole, dict(whole.heads())["halved"]):
        part.data_options["root"] = part.data_source["root"] = "corpora/mine"
    whole.save_pretrained(tmp_path / "folder")
    speech = torch.sin(torch.arange(8000) / 9) * 0.3
    for name in ("", ":halved"):
        one, other = (load_model(f"{path}{name}") for path in (trained, tmp_path / "folder"))
        animations = [model.animate(speech, identity="A", seed=2).vertices for model in (one, other)]
        assert torch.equal(*animations)
    config = (tmp_path / "folder" / "config.json").read_text()
    assert str(tmp_path.parent) not in config
    assert "corpora/mine" not in config
