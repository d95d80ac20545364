"""Imported checkpoints give what the published inference gives, by references that share no code with the models."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from facediff.models import FaceDiffuser, FaceFormer
from facediff.models.published.positions import periodic_bias, periodic_positions
from facediff.models.speech_networks import Wav2Vec2Encoder
from tests.fakes import published
from tests.fakes.published import IDENTITIES, RATES, VERTICES
from tests.models.published.author import face, imported, speech_of


@pytest.mark.parametrize(("dataset", "steps"), [("vocaset", 40), ("vocaset", 205), ("biwi", 41), ("biwi", 58)])
def test_faceformer(dataset: str, steps: int, tmp_path: Path) -> None:
    state = published.faceformer_state(dataset)
    model = imported(state, tmp_path, dataset)
    assert isinstance(model, FaceFormer)
    speech = speech_of(steps)
    assert model.audio_encoder.steps_of(len(speech)) == steps
    # As published in floating point: 205 steps are 122 frames, not 123.
    assert model.frames_of(len(speech)) == {("vocaset", 40): 24, ("vocaset", 205): 122, ("biwi", 41): 20}.get(
        (dataset, steps), 29
    )
    for number, name in enumerate(IDENTITIES):
        if steps > 100 and name != "B":
            continue
        made = model.animate(speech, identity="A", condition=name).vertices.flatten(1)
        expected = published.faceformer_reference(state, speech, dataset, number, face("A"))
        torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


FURTHER = [pytest.param(*case, marks=pytest.mark.slow) for case in (("vocaset", 40), ("biwi", 41))]


@pytest.mark.parametrize(("dataset", "steps"), [("vocaset", 41), ("biwi", 58), *FURTHER])
def test_facediffuser(dataset: str, steps: int, tmp_path: Path) -> None:
    state = published.facediffuser_state(6)
    model = imported(state, tmp_path, dataset)
    speech = speech_of(steps)
    for number, name in enumerate(IDENTITIES):
        made = model.animate(speech, identity=name, seed=number).vertices.flatten(1)
        expected = published.facediffuser_reference(state, speech, dataset, number, face(name), number)
        torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


def test_facediffuser_skips_steps(tmp_path: Path) -> None:
    state = published.facediffuser_state(9)
    model = imported(state, tmp_path, "vocaset", skip_steps=4)
    made = model.animate(speech_of(40), identity="B", seed=7).vertices.flatten(1)
    expected = published.facediffuser_reference(state, speech_of(40), "vocaset", 1, face("B"), 7, skip=4)
    torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


def test_facediffuser_folded_is_the_same_process_of_mapped_noise(tmp_path: Path) -> None:
    """With the first map of the very noise, folded sampling gives the same motion."""
    model = imported(published.facediffuser_state(6), tmp_path, "vocaset")
    assert isinstance(model, FaceDiffuser)
    frames = torch.tensor([20])
    drawn = [torch.randn(1, 20, 3 * VERTICES) for _ in range(6)]
    clip = model.clip_of(speech_of(40), "A", None)
    results = []
    for space in ("vertices", "folded"):
        model.sampling_space = space
        weight = model.network.motion_in.weight
        values, vectors = torch.linalg.eigh(weight.double() @ weight.double().T)
        root = (vectors / values.clamp_min(1e-12).sqrt() @ vectors.T).float()  # the inverse of the fold's own root
        mapped = [noise @ weight.T @ root for noise in drawn] if space == "folded" else drawn
        queue = iter(mapped)
        with torch.no_grad():
            results.append(model.sample(clip, frames, lambda _, queue=queue: next(queue)))
    torch.testing.assert_close(results[0], results[1], rtol=0, atol=1e-4)


@pytest.mark.parametrize("large", [False, True], ids=["base", "large"])
def test_the_speech_network_of_both_sizes(large: bool) -> None:
    state = published.backbone_state("", published.Drawn(3), large=large)
    sizes = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 32}
    config = {
        **sizes,
        "model_type": "hubert" if large else "wav2vec2",
        "conv_dim": [8] * 7,
        "conv_bias": large,
        "feat_extract_norm": "layer" if large else "group",
        "do_stable_layer_norm": large,
        "num_conv_pos_embeddings": 16,
        "num_conv_pos_embedding_groups": 4,
    }
    encoder = Wav2Vec2Encoder(dim=None, config=config, edges=False, epsilon=1e-5).eval()
    encoder.network.load_state_dict(state)
    speech = speech_of(41)
    lengths = torch.tensor([len(speech)])
    features = published.features_of(published.standardised(speech, 1e-5), state, "")
    whole = published.hidden_of(features, state, "")
    expected = {
        "features": published.hidden_of(published.interpolated(features, 24), state, ""),
        "features_cut": published.hidden_of(features[:24], state, ""),
        "hidden": published.interpolated(whole, 24),
        "hidden_cut": whole[:24],
    }
    for rule, wanted in expected.items():
        with torch.no_grad():
            made = encoder.at_steps(speech[None], lengths, torch.tensor([24]), rule)  # type: ignore[arg-type]
        torch.testing.assert_close(made[0], wanted, rtol=0, atol=1e-5)


def test_tables_at_their_edges() -> None:
    torch.testing.assert_close(periodic_positions(61, 8, 30), published.positions(61, 8, 30), rtol=0, atol=1e-6)
    torch.testing.assert_close(periodic_positions(3, 8, 25, start=24), published.positions(27, 8, 25)[24:])
    assert torch.equal(periodic_bias(62, 4, 30), published.self_bias(62, 4, 30))
    assert torch.equal(periodic_bias(2, 4, 25, start=50), published.self_bias(52, 4, 25)[:, 50:])


@pytest.mark.parametrize("dataset", RATES)
def test_a_checkpoint_of_facediff_is_the_imported_model(dataset: str, tmp_path: Path) -> None:
    from facediff.models import load_model
    from facediff.models.published.importing import save_model

    author = published.faceformer_state(dataset)
    state = {f"module.{name}": author[name] for name in reversed(author)}  # the order in the file means nothing
    model = imported({"state_dict": state}, tmp_path, dataset)  # type: ignore[dict-item]
    save_model(model, tmp_path / "model.ckpt")
    loaded = load_model(tmp_path / "model.ckpt")
    speech = speech_of(40)
    one, other = (each.animate(speech, identity="C").vertices for each in (model, loaded))
    assert torch.equal(one, other)
    assert {licence.commercial for licence in loaded.licences} >= {"unknown", "forbidden"}
