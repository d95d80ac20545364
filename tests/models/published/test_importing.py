"""The door of foreign checkpoints: what is used, what is reported, what is refused; nothing of a file runs."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import facediff
from facediff import Animator, registry
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import import_checkpoint
from facediff.models.published.cards import cards
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.importing import examine, import_files
from facediff.utils.hints import options_of
from tests.fakes import published
from tests.fakes.published import AUDIO_CONFIG, IDENTITIES, VERTICES, write_author_files

Change = Callable[[published.State], object]


def words(folder: Path, **changed: str | None) -> list[str]:
    options: dict[str, str | None] = {
        "dataset": "vocaset",
        "identities": "A,B,C",
        "templates": str(folder / "faces.pkl"),
        "audio-config": str(folder / "audio.json"),
        "output": str(folder / "model.ckpt"),
        **changed,
    }
    flags = [[f"--{name}", value] for name, value in options.items() if value is not None]
    return ["import-checkpoint", str(folder / "author.pth"), *(word for pair in flags for word in pair)]


def given(folder: Path, **more: Any) -> dict[str, Any]:  # noqa: ANN401
    faces = folder / "faces.pkl"
    return {"dataset": "vocaset", "identities": IDENTITIES, "templates": faces, "audio_config": AUDIO_CONFIG, **more}


@pytest.mark.parametrize("card", cards(), ids=lambda card: card.required[0])
def test_a_release_card_names_a_method_and_its_options(card: Any) -> None:  # noqa: ANN401
    own = options_of(registry.model.get(card.method)).keys()
    assert card.options.keys() <= own
    for release in card.releases:
        assert release["options"].keys() <= own | {"frame_rate"}
    assert card.reads
    assert set(card.reads) <= ImportOptions.__dataclass_fields__.keys()
    assert card.licence_source


def test_every_tensor_is_used_or_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_author_files(tmp_path)
    assert main(words(tmp_path)) == 0
    printed = "".join(capsys.readouterr())
    assert "not needed: 1 tensor" in printed
    assert "12 vertices" in printed
    assert (tmp_path / "model.ckpt").is_file()


OPTIONS: list[tuple[dict[str, str | None], str]] = [
    ({"dataset": None}, "--dataset"),
    ({"dataset": "biwi"}, "PPE.pe"),
    ({"identities": None}, "--identities"),
    ({"identities": "A,B,B"}, "--identities"),
    ({"templates": None}, "--templates"),
    ({"audio-config": None}, "--audio-config"),
    ({"option": "no_such=1"}, "no_such"),
    ({"option": "period=many"}, "period"),
    ({"data-root": "."}, "--data-root: FaceFormer"),
    ({"output": "model.txt"}, "model.txt"),
]


@pytest.mark.parametrize(("changed", "named"), OPTIONS)
def test_an_option_that_is_missing_or_wrong_is_named(
    changed: dict[str, str | None], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_author_files(tmp_path)
    assert main(words(tmp_path, **changed)) == 2
    assert named in capsys.readouterr().err
    assert not (tmp_path / "model.ckpt").exists()


CHANGES: dict[str, tuple[Change, str]] = {
    "missing": (lambda s: s.pop("transformer_decoder.layers.0.norm2.bias"), r"missing: .*norms\.1\.bias"),
    "unexpected": (lambda s: s.update(extra=torch.ones(2)), "unexpected: extra"),
    "misshapen": (lambda s: s.update({"vertice_map.weight": torch.ones(16, 5)}), "misshapen: .*motion_in.weight"),
    "of whole numbers": (lambda s: s.update({"vertice_map.bias": torch.ones(16).long()}), "misshapen: .*motion_in"),
    "not finite": (lambda s: s["vertice_map.bias"].fill_(torch.nan), "not finite: .*motion_in.bias"),
    "of another period": (lambda s: s["PPE.pe"].add_(0.5), "PPE.pe"),
    "of another project": (lambda s: (s.clear(), s.update(weight=torch.ones(2))), "no method that can be imported"),
}
CONV = "audio_encoder.encoder.pos_conv_embed.conv"


@pytest.mark.parametrize("name", CHANGES)
def test_a_tensor_that_does_not_fit_is_named(name: str, tmp_path: Path) -> None:
    change, named = CHANGES[name]
    path = write_author_files(tmp_path, change)
    with pytest.raises(FaceDiffError, match=named):
        import_checkpoint(path, **given(tmp_path))


def test_the_doctor_prints_every_difference_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(state: published.State) -> None:
        del state["vertice_map.bias"]
        state["vertice_map.weight"] = torch.ones(16, 5)
        state["more.weight"] = torch.ones(3)
        state["vertice_map_r.bias"].fill_(torch.nan)

    path = write_author_files(tmp_path, change)
    before = sorted(tmp_path.iterdir())
    assert main([*words(tmp_path), "--doctor"]) == 0
    lines = "".join(capsys.readouterr())
    for expected in (
        hashlib.sha256(path.read_bytes()).hexdigest(),
        "method: FaceFormer",
        "missing: network.motion_in.bias (16,)",
        "unexpected: more.weight (3,)",
        "misshapen: network.motion_in.weight (16, 5), expected (16, 36)",
        "not finite: network.motion_out.bias",
        "not needed: PPE.pe",
        "do not fit",
    ):
        assert expected in lines
    assert sorted(tmp_path.iterdir()) == before
    write_author_files(tmp_path)
    options = given(tmp_path)
    assert [*examine([path], ImportOptions(**options))][-1].endswith("all fit")
    torch.save({"obj_vector.weight": torch.ones(2, 2), "PPE.pe": torch.ones(2, 2)}, path)
    assert "FaceFormer's have obj_vector.weight" in [*examine([path], ImportOptions(**options))][-1]


def test_tensors_may_be_left_out_and_are_reported(tmp_path: Path) -> None:
    path = write_author_files(tmp_path, lambda s: s.update({"extra.a": torch.ones(2), "extra.b": torch.ones(2)}))
    options = ImportOptions(**given(tmp_path), model_options={"ignore": "extra."})
    assert import_files(path, options).files.ignored.keys() == {"extra.a", "extra.b", "PPE.pe"}


def test_options_come_from_one_file_too(tmp_path: Path) -> None:
    path = write_author_files(tmp_path)
    content = {
        "encoder_config": AUDIO_CONFIG,
        "dataset": "vocaset",
        "identities": IDENTITIES,
        "fps": 30,
        "epsilon": 1e-7,
    }
    (tmp_path / "hparams.json").write_text(json.dumps(content), encoding="utf-8")
    made = import_checkpoint(path, templates=tmp_path / "faces.pkl", hparams=tmp_path / "hparams.json")
    assert made.audio_encoder.epsilon == 1e-7
    again = import_checkpoint(path, **given(tmp_path, hparams=tmp_path / "hparams.json", epsilon="1e-6"))
    assert again.audio_encoder.epsilon == 1e-6
    (tmp_path / "hparams.json").write_text("[]", encoding="utf-8")
    with pytest.raises(FaceDiffError, match="hparams"):
        import_checkpoint(path, **given(tmp_path, hparams=tmp_path / "hparams.json"))


def test_new_and_old_names_of_weight_norm_are_the_same(tmp_path: Path) -> None:
    def rename(state: published.State) -> None:
        for old, new in (("weight_g", "original0"), ("weight_v", "original1")):
            state[f"{CONV}.parametrizations.weight.{new}"] = state.pop(f"{CONV}.{old}")

    weights = [
        import_checkpoint(write_author_files(tmp_path, change), **given(tmp_path)).state_dict()
        for change in (lambda state: None, rename)
    ]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_an_imported_model_knows_its_corpus_but_not_its_folder(tmp_path: Path) -> None:
    """So that ``facediff test --ckpt_path`` asks for nothing but the folder."""
    from facediff.data import Vocaset
    from facediff.models.checkpoint import corpus_of, read_checkpoint

    write_author_files(tmp_path)
    assert main(words(tmp_path)) == 0
    path = tmp_path / "model.ckpt"
    assert corpus_of(path, read_checkpoint(path)) == (Vocaset, {})


def test_an_imported_model_gives_its_authors_motion_in_pauses_too(tmp_path: Path) -> None:
    """As soon as lips are known a voice gate would change it; the checkpoint that is written says so as well."""
    (tmp_path / "regions").mkdir()
    for name, indices in (("lve", range(6)), ("fdd", range(6, VERTICES))):
        (tmp_path / "regions" / f"{name}.txt").write_text(", ".join(map(str, indices)), encoding="utf-8")
    write_author_files(tmp_path)
    assert main(words(tmp_path, regions=str(tmp_path / "regions"))) == 0
    voice = 0.1 * np.random.default_rng(0).standard_normal(16_000).astype(np.float32)
    speech = np.concatenate([voice, np.zeros(16_000, np.float32), voice])
    model = facediff.load(tmp_path / "model.ckpt")
    assert isinstance(model, Animator)
    usual, gated, free = (
        model.animate(speech, 16_000, identity="A", voice_gate=gate) for gate in (None, "energy", "off")
    )
    expected = model.module.animate(torch.from_numpy(speech), identity="A").vertices.numpy()
    np.testing.assert_array_equal(usual.vertices, expected)
    np.testing.assert_array_equal(free.vertices, expected)
    assert np.abs(gated.vertices - expected)[36:54].max() > 1e-3
    assert gated.metadata["voice gate"] == "energy"


# Pickles.


class Calls:
    """What a pickle makes of it: a call of a function with arguments."""

    def __init__(self, function: Callable[..., object], *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call


@pytest.mark.parametrize("call", [Calls(eval, "1"), Calls(Path.touch, "harm"), Calls(torch.hub.load, "a/b", "c")])
@pytest.mark.parametrize("place", ["state", "options"])
def test_a_checkpoint_that_calls_functions_runs_nothing(
    call: object, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_author_files(tmp_path)
    state: dict[str, Any] = dict(published.faceformer_state("vocaset"))
    content = {"state_dict": state | {"harm": call}} if place == "state" else {"state_dict": state, "callbacks": [call]}
    torch.save(content, path)
    main(words(tmp_path))
    assert not Path("harm").exists()


def test_a_container_with_other_objects_is_read_without_them(tmp_path: Path) -> None:
    """As Lightning's, which keeps options and optimisers next to the tensors."""
    import argparse

    path = write_author_files(tmp_path)
    state = published.faceformer_state("vocaset")
    torch.save({"state_dict": state, "hyper_parameters": argparse.Namespace(lr=1.0)}, path)
    made = import_checkpoint(path, **given(tmp_path))
    assert torch.equal(made.state_dict()["network.motion_in.bias"], state["vertice_map.bias"])


def test_faces_of_another_topology_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_author_files(tmp_path)
    (tmp_path / "faces.pkl").write_bytes(pickle.dumps({"A": np.zeros((VERTICES + 1, 3))}))
    assert main(words(tmp_path)) == 2
    assert "faces.pkl" in capsys.readouterr().err
