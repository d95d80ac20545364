"""Files that cannot be imported: one sentence, no model, nothing run."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import facediff
from facediff import Animator
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import import_checkpoint
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.importing import import_files
from tests.fakes import published
from tests.fakes.published import IDENTITIES, VERTICES, write_author_files

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
    given = [[f"--{name}", value] for name, value in options.items() if value is not None]
    return ["import-checkpoint", str(folder / "author.pth"), *(word for pair in given for word in pair)]


def test_what_became_of_every_tensor_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_author_files(tmp_path)
    assert main(words(tmp_path)) == 0
    printed = capsys.readouterr()
    assert "PPE.pe" in printed.out + printed.err
    assert "12 vertices" in printed.out + printed.err
    assert (tmp_path / "model.ckpt").is_file()


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"dataset": None}, "--dataset"),
        ({"dataset": "biwi"}, "--dataset biwi"),
        ({"identities": None}, "--identities"),
        ({"identities": "A,B"}, "--identities"),
        ({"identities": "A,B,B"}, "--identities"),
        ({"templates": None}, "--templates"),
        ({"audio-config": None}, "--audio-config"),
        ({"option": "no_such=1"}, "no_such"),
        ({"option": "period=many"}, "period"),
        ({"option": "loop"}, "--option loop"),
        ({"statistics": "faces.pkl"}, "--statistics: FaceFormer does not read"),
        ({"data-root": "."}, "--data-root: FaceFormer"),
        ({"template-row": "1"}, "--template-row: FaceFormer"),
        ({"output": "model.txt"}, "model.txt"),
    ],
)
def test_what_is_missing_or_wrong_is_named(
    changed: dict[str, str | None], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_author_files(tmp_path)
    assert main(words(tmp_path, **changed)) == 2
    printed = capsys.readouterr().err
    assert named in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "model.ckpt").exists()


def test_a_face_of_another_topology_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_author_files(tmp_path)
    (tmp_path / "faces.pkl").write_bytes(pickle.dumps({"A": np.zeros((VERTICES + 1, 3))}))
    assert main(words(tmp_path)) == 2
    assert "faces.pkl" in capsys.readouterr().err


CHANGES: dict[str, tuple[Change, str]] = {
    "a tensor is missing": (lambda s: s.pop("vertice_map.weight"), "vertice_map|motion_in"),
    "a layer's tensor is missing": (lambda s: s.pop("transformer_decoder.layers.0.norm2.bias"), "norm2.bias"),
    "a tensor of no use": (lambda s: s.update(extra=torch.ones(2)), "extra"),
    "another shape": (lambda s: s.update({"vertice_map.weight": torch.ones(16, 5)}), "vertice_map.weight"),
    "no dimensions": (lambda s: s.update({"vertice_map_r.weight": torch.tensor(1.0)}), "vertice_map_r"),
    "not finite": (lambda s: s["vertice_map.bias"].fill_(torch.nan), "NaN"),
    "another table": (lambda s: s["PPE.pe"].add_(0.5), "PPE.pe"),
    "another project": (lambda s: (s.clear(), s.update(weight=torch.ones(2))), "FaceFormer"),
    "whole numbers": (lambda s: s.update({"vertice_map.bias": torch.ones(16).long()}), "motion_in.bias"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_tensors_that_do_not_fit_are_named(name: str, tmp_path: Path) -> None:
    change, named = CHANGES[name]
    path = write_author_files(tmp_path, change)
    options: dict[str, Any] = {"templates": tmp_path / "faces.pkl", "audio_config": published.AUDIO_CONFIG}
    with pytest.raises(FaceDiffError, match=named) as caught:
        import_checkpoint(path, dataset="vocaset", identities=IDENTITIES, **options)
    assert str(caught.value).count(". ") <= 1


def test_tensors_of_no_use_may_be_left_out_and_are_reported(tmp_path: Path) -> None:
    path = write_author_files(
        tmp_path, lambda state: state.update({"extra.a": torch.ones(2), "extra.b": torch.ones(2)})
    )
    options: dict[str, Any] = {"templates": tmp_path / "faces.pkl", "audio_config": published.AUDIO_CONFIG}
    made = import_files(
        path, ImportOptions(dataset="vocaset", identities=IDENTITIES, **options, model_options={"ignore": "extra."})
    )
    assert {"extra.a", "extra.b", "PPE.pe"} == set(made.ignored)


def test_new_and_old_names_of_weight_norm_are_the_same(tmp_path: Path) -> None:
    def rename(state: published.State) -> None:
        conv = "audio_encoder.encoder.pos_conv_embed.conv"
        for old, new in (("weight_g", "original0"), ("weight_v", "original1")):
            state[f"{conv}.parametrizations.weight.{new}"] = state.pop(f"{conv}.{old}")

    options: dict[str, Any] = {"audio_config": published.AUDIO_CONFIG, "dataset": "vocaset", "identities": IDENTITIES}
    weights = []
    for change in (lambda state: None, rename):
        path = write_author_files(tmp_path, change)
        model = import_checkpoint(path, templates=tmp_path / "faces.pkl", **options)
        weights.append(model.state_dict())
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
    assert "voice gate" not in usual.metadata
    assert gated.metadata["voice gate"] == "energy"


class Hostile:
    def __reduce__(self) -> tuple[Any, ...]:
        import os

        return os.system, ("touch harm",)


def test_a_hostile_pickle_runs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": {"weight": torch.ones(2)}, "hyper_parameters": Hostile()}, "author.ckpt")
    with pytest.raises(FaceDiffError, match=r"author\.ckpt"):
        import_checkpoint("author.ckpt")
    assert not Path("harm").exists()


class Calls:
    """What a pickle makes of it: a call of a function with arguments."""

    def __init__(self, function: Callable[..., object], *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call


@pytest.mark.parametrize("call", [Hostile(), Calls(Path.touch, "harm"), Calls(torch.hub.load, "a/b", "c")])
@pytest.mark.parametrize("place", ["state", "options"])
def test_no_function_that_a_whole_checkpoint_calls_is_run(
    call: object, place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_author_files(tmp_path)
    state: dict[str, Any] = dict(published.faceformer_state("vocaset"))
    content = {"state_dict": state | {"harm": call}} if place == "state" else {"state_dict": state, "callbacks": [call]}
    torch.save(content, path)
    main(words(tmp_path))
    assert not Path("harm").exists()


def test_options_of_omegaconf_are_passed_over(tmp_path: Path) -> None:
    """As in the containers of projects that are configured by it."""
    omegaconf = pytest.importorskip("omegaconf")
    path = write_author_files(tmp_path)
    options = omegaconf.OmegaConf.create({"lr": 1e-4, "layers": [1, {"deep": "x"}]})
    torch.save({"state_dict": published.faceformer_state("vocaset"), "hyper_parameters": options}, path)
    assert main(words(tmp_path)) == 0


def test_a_missing_tensor_is_named_as_its_authors_do(tmp_path: Path) -> None:
    path = write_author_files(tmp_path, lambda state: state.pop("transformer_decoder.layers.0.self_attn.in_proj_bias"))
    with pytest.raises(FaceDiffError, match=r"transformer_decoder\.layers\.0\.self_attn\.in_proj_bias"):
        import_checkpoint(
            path,
            dataset="vocaset",
            identities=IDENTITIES,
            templates=tmp_path / "faces.pkl",
            audio_config=published.AUDIO_CONFIG,
        )


@pytest.mark.parametrize("shape", [lambda table: table[0], lambda table: table.int()], ids=["2-d", "whole numbers"])
def test_a_table_of_positions_of_another_kind_is_refused(shape: Callable[..., object], tmp_path: Path) -> None:
    write_author_files(tmp_path, lambda state: state.update({"PPE.pe": shape(state["PPE.pe"])}))
    assert main(words(tmp_path)) == 2


@pytest.mark.parametrize(
    "wrong", [{"num_attention_heads": "x"}, {"conv_stride": [1]}, {"hidden_act": "nonsense"}, {"layer_norm_eps": "z"}]
)
def test_a_configuration_that_makes_no_network_is_refused(wrong: dict[str, Any], tmp_path: Path) -> None:
    path = write_author_files(tmp_path)
    with pytest.raises(FaceDiffError, match="audio-config"):
        import_checkpoint(
            path,
            dataset="vocaset",
            identities=IDENTITIES,
            templates=tmp_path / "faces.pkl",
            audio_config={**published.AUDIO_CONFIG, **wrong},
        )


def test_both_names_of_a_tensor_at_once_are_refused(tmp_path: Path) -> None:
    conv = "audio_encoder.encoder.pos_conv_embed.conv"
    write_author_files(
        tmp_path, lambda state: state.update({f"{conv}.parametrizations.weight.original0": state[f"{conv}.weight_g"]})
    )
    assert main(words(tmp_path)) == 2


def test_a_small_number_may_be_given_without_a_point(tmp_path: Path) -> None:
    path = write_author_files(tmp_path)
    model = import_checkpoint(
        path,
        dataset="vocaset",
        identities=IDENTITIES,
        templates=tmp_path / "faces.pkl",
        audio_config=published.AUDIO_CONFIG,
        epsilon="1e-7",
    )
    assert model.hparams["audio_encoder"]["init_args"]["epsilon"] == 1e-7


def test_a_container_with_other_objects_is_read_without_them(tmp_path: Path) -> None:
    """As Lightning's, which keeps options and optimisers next to the tensors."""
    import argparse

    path = write_author_files(tmp_path)
    state = published.faceformer_state("vocaset")
    content = {"state_dict": state, "hyper_parameters": argparse.Namespace(lr=1.0), "callbacks": {Path: 1}}
    torch.save(content, path)
    made = import_checkpoint(
        path,
        dataset="vocaset",
        identities=IDENTITIES,
        templates=tmp_path / "faces.pkl",
        audio_config=published.AUDIO_CONFIG,
    )
    assert torch.equal(made.state_dict()["network.motion_in.bias"], state["vertice_map.bias"])


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_file_is_refused(share: float, tmp_path: Path) -> None:
    path = write_author_files(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(FaceDiffError, match=r"author\.pth"):
        import_checkpoint(path)
