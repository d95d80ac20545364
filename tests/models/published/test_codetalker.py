"""CodeTalker: parity of both stages, what its stages share, its options, and its authors' files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch import Trainer
from torch import Tensor

from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel, CodeTalker, import_checkpoint, load_model
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.importing import import_files
from tests.fakes import codetalker, published
from tests.fakes.published import COORDINATES, IDENTITIES, VERTICES, State
from tests.fakes.tiny import Tiny
from tests.models.published import test_laws as laws
from tests.models.published.author import face, speech_of, templates

MakeMethod = Callable[..., AnimationModel]
MakeTrainer = Callable[..., Trainer]


def write(folder: Path, **states: State) -> list[Path]:
    """The authors' files, each a container of its tensors."""
    files = []
    for name, state in states.items():
        files.append(folder / f"{name}.pth.tar")
        torch.save({"state_dict": state}, files[-1])
    return files


def imported(files: list[Path], dataset: str, **options: Any) -> CodeTalker:  # noqa: ANN401
    made = import_checkpoint(
        files,
        dataset=dataset,
        identities=IDENTITIES,
        templates=templates(),
        audio_config=published.AUDIO_CONFIG,
        **{"num_heads": 4, "prior_heads": codetalker.PRIOR_HEADS, **options},
    )
    assert isinstance(made, CodeTalker)
    return made


@pytest.mark.parametrize(
    ("dataset", "steps"),
    [
        ("vocaset", 41),
        ("biwi", 41),
        pytest.param("vocaset", 40, marks=pytest.mark.slow),
        pytest.param("biwi", 58, marks=pytest.mark.slow),
    ],
)
def test_it_animates_as_published(dataset: str, steps: int, tmp_path: Path) -> None:
    one, two = codetalker.stage_one(dataset), codetalker.stage_two(dataset)
    model = imported(write(tmp_path, one=one, two=two), dataset)
    speech = speech_of(steps)
    for number, name in enumerate(IDENTITIES):
        expected, margin = codetalker.reference(one, two, speech, dataset, number, face("A"))
        assert margin > 1e-4  # no code is nearly another one, so that rounding decides nothing
        made = model.animate(speech, identity="A", condition=name).vertices.flatten(1)
        torch.testing.assert_close(made, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("corrected", [False, True], ids=["published", "corrected"])
@pytest.mark.parametrize(("dataset", "frames"), [("vocaset", 7), ("biwi", 1), ("biwi", 24)])
def test_the_prior_reconstructs_as_published(dataset: str, frames: int, corrected: bool, tmp_path: Path) -> None:
    one = codetalker.stage_one(dataset, seed=4)
    how = {"place": "frames", "scaled_by": "heads"} if corrected else {}
    model = imported(write(tmp_path, one=one), dataset, leak=0.1, corrected=corrected)
    assert model.stage == "prior"
    motion = torch.randn(frames, COORDINATES, generator=torch.Generator().manual_seed(frames))
    tokens = codetalker.encoded(motion, one, 0.1, **how)
    codes, margin = codetalker.quantised(tokens, one)
    assert margin > 1e-4
    with torch.no_grad():
        own = model.prior.encode(motion[None])
        torch.testing.assert_close(own[0], tokens, rtol=0, atol=1e-5)
        made = model.prior.quantise(own)
        torch.testing.assert_close(made.values[0], codes, rtol=0, atol=1e-6)
        expected = codetalker.decoded_motion(codes, one, 0.1, **how)
        torch.testing.assert_close(model.prior.decode(made.values)[0], expected, rtol=0, atol=1e-5)
        torch.testing.assert_close(model.prior.decode_last(made.values)[0], expected[-1], rtol=0, atol=1e-5)


# What both stages train on.


def one_clip(model: CodeTalker, frames: int) -> Any:  # noqa: ANN401
    sample = laws.clips(frames)[0]
    motion = torch.randn(frames, VERTICES, 3, generator=torch.Generator().manual_seed(3))
    return collate([replace(sample, motion=motion, template=torch.zeros(VERTICES, 3), identity=1)])


def test_tokens_are_drawn_to_codes_by_a_quarter_of_what_codes_are_drawn_by(tmp_path: Path) -> None:
    """β = 0.25 stands at the tokens (van den Oord et al. 2017, eq. 3); the values of the two terms are equal."""
    prior = imported(write(tmp_path, one=codetalker.stage_one("vocaset"))[:1], "vocaset").eval()
    batch = one_clip(prior, 24)
    tokens = prior.prior.encode_clips(batch.motion.flatten(2), batch.frame_lengths).detach().requires_grad_()
    prior.prior.encode_clips = lambda *_: tokens
    table = prior.prior.codebook
    to_tokens, to_codes = torch.autograd.grad(prior.losses(batch)["quantisation"], (tokens, table))
    codes = prior.prior.quantise(tokens)
    error = 2 * (tokens - codes.entries) / tokens.numel()
    torch.testing.assert_close(to_tokens, 0.25 * error)
    moved = torch.zeros_like(table).index_add_(0, codes.numbers.flatten(), -error.reshape(-1, table.shape[1]))
    torch.testing.assert_close(to_codes, moved)


def test_the_losses_of_both_stages_are_the_published_ones(tmp_path: Path) -> None:
    one, two = codetalker.stage_one("vocaset"), codetalker.stage_two("vocaset")
    files = write(tmp_path, one=one, two=two)
    model, prior = imported(files, "vocaset").eval(), imported(files[:1], "vocaset").eval()
    batch = one_clip(model, 24)
    motion = batch.motion[0].flatten(1)
    tokens = codetalker.encoded(motion, one)
    codes, margin = codetalker.quantised(tokens, one)
    assert margin > 1e-4
    error = (codetalker.decoded_motion(codes, one) - motion).abs().mean()
    # With nothing to differentiate, both terms are the same mean square.
    quantisation = 1.25 * (codes - tokens).square().mean()
    used = torch.stack(
        [(codes.reshape(-1, 4) == row).all(1).float().mean() for row in one["quantize.embedding.weight"]]
    )
    entropy = -sum(share * share.log() for share in used if share > 0)
    own = prior.losses(batch)
    torch.testing.assert_close(own["reconstruction"], error)
    torch.testing.assert_close(own["quantisation"], quantisation)
    torch.testing.assert_close(own["perplexity"], torch.as_tensor(entropy).exp())
    torch.testing.assert_close(own["loss"], error + quantisation)
    # The predictor: true frames shifted by one, of which the first is a zero that goes through the map.
    speech = batch.audio[0]
    features = published.features_of(published.standardised(speech, 1e-5), two, "audio_encoder.")
    features, _ = published.resampled(features, "vocaset", 24)
    memory = published.linear(published.hidden_of(features, two, "audio_encoder."), two, "audio_feature_map")
    shifted = torch.cat([torch.zeros(1, COORDINATES), motion[:-1]])
    x = published.linear(shifted, two, "vertice_map") + two["learnable_style_emb.weight"][1] + two["PPE.pe"][0, :24]
    made = published.linear(published.decoded(x, memory, two, "transformer_decoder.", "vocaset"), two, "feat_map")
    chosen, margin = codetalker.quantised(made, one)
    assert margin > 1e-4
    wrong = (codetalker.decoded_motion(chosen, one) - motion).square().mean()
    far = (made - codes).square().mean()
    found = model.losses(batch)
    torch.testing.assert_close(found["reconstruction"], wrong)
    torch.testing.assert_close(found["features"], far)
    torch.testing.assert_close(found["loss"], wrong + far)


def test_a_predictor_may_continue_its_own_motion(make_method: MakeMethod) -> None:
    model = laws.with_assets(make_method("CodeTalker", history="own", motion_scale="none"))
    assert isinstance(model, CodeTalker)
    batch = collate(laws.clips(9, 14))
    given: list[Tensor] = []
    made: list[Tensor] = []
    model.network.motion_in.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    model.network.out.register_forward_hook(lambda _, inputs, output: made.append(output))
    passes = set()
    for seed in range(8):
        given.clear()
        made.clear()
        model.losses(batch, torch.Generator().manual_seed(seed))
        assert not given[0].any()
        for before, now in zip(made, given[1:], strict=False):
            motion = model.motion_of(before, model.trained_frames(batch))
            torch.testing.assert_close(now[:, 1:], motion[:, :-1])
            assert not now[:, 0].any()
        passes.add(len(given))
    assert passes == {1, 2, 3}
    model.eval()  # no dropout: validation draws from its own numbers, and leaves those of training alone
    state = torch.get_rng_state()
    model.losses(batch, torch.Generator().manual_seed(0))
    assert torch.equal(torch.get_rng_state(), state)


def test_gradients_pass_the_codes_and_move_them(make_method: MakeMethod) -> None:
    prior = make_method("CodeTalker", stage="prior").prior
    assert isinstance(prior, torch.nn.Module)
    tokens = torch.randn(1, 5, 16, requires_grad=True)
    codes = prior.quantise(tokens)  # type: ignore[operator]
    weights = torch.randn(1, 5, 16)
    (codes.values * weights).sum().backward()
    torch.testing.assert_close(tokens.grad, weights)
    assert prior.codebook.grad is None


LAWS = [
    laws.test_padding_and_other_clips_change_nothing,
    laws.test_the_loss_of_a_batch_does_not_look_at_padding,
    laws.test_gradients_reach_every_trainable_weight,
    laws.test_mixed_precision_gives_numbers,
    laws.test_training_lowers_the_loss_of_one_clip,
]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_the_prior_obeys(law: Callable[..., None], make_method: MakeMethod) -> None:
    """The laws that the predictor obeys in test_laws.py, where they concern what a prior does."""
    law("CodeTalker", lambda name, **options: make_method(name, stage="prior", **options))


# Two stages, one model.


def test_a_predictor_is_trained_on_a_trained_prior(
    make_method: MakeMethod, tiny: Tiny, make_trainer: MakeTrainer, tmp_path: Path
) -> None:
    limits = {"limit_train_batches": 2, "limit_val_batches": 1, "limit_test_batches": 1}
    prior, trainer = make_method("CodeTalker", stage="prior", motion_scale="unit"), make_trainer(**limits)
    trainer.fit(prior, datamodule=tiny)
    scores = trainer.test(prior, datamodule=tiny, verbose=False)
    assert not any("shuffled" in name for split in scores for name in split)
    trainer.save_checkpoint(tmp_path / "prior.ckpt", weights_only=True)
    loaded = load_model(tmp_path / "prior.ckpt")
    assert isinstance(loaded, CodeTalker)
    assert loaded.stage == "prior"
    with pytest.raises(FaceDiffError, match="prior"):
        loaded.animate(torch.zeros(16_000), identity="A")
    with pytest.raises(FaceDiffError, match="prior"):
        loaded.stream(identity="A")

    model = make_method("CodeTalker", seed=1, motion_scale="unit", prior=str(tmp_path / "prior.ckpt"))
    trainer = make_trainer(**limits)
    trainer.fit(model, datamodule=tiny)
    trainer.save_checkpoint(tmp_path / "model.ckpt", weights_only=True)
    (tmp_path / "prior.ckpt").unlink()
    whole = load_model(tmp_path / "model.ckpt")
    assert isinstance(whole, CodeTalker)
    for name, value in loaded.prior.state_dict().items():
        assert torch.equal(whole.prior.state_dict()[name], value), name
    assert whole.assets.motion_scale == loaded.assets.motion_scale
    assert whole.hparams["prior"] is None


@pytest.mark.parametrize("validated", [False, True])
def test_without_a_prior_no_predictor_is_trained(
    validated: bool, make_method: MakeMethod, tiny: Tiny, make_trainer: MakeTrainer, prior_file: Path
) -> None:
    trainer, model = make_trainer(limit_train_batches=1, limit_val_batches=1), make_method("CodeTalker", prior=None)
    if validated:
        trainer.validate(model, datamodule=tiny, verbose=False)
    with pytest.raises(FaceDiffError, match=r"--model\.prior"):
        trainer.fit(model, datamodule=tiny)
    model.prior_file = str(prior_file)  # type: ignore[assignment]
    trainer.fit(model, datamodule=tiny)
    for name, value in load_model(prior_file).prior.state_dict().items():  # type: ignore[operator, union-attr]
        assert torch.equal(model.prior.state_dict()[name], value), name  # type: ignore[operator, union-attr]


@pytest.mark.parametrize("option", ["codes", "motion_scale", "leak"])
def test_a_prior_of_other_options_is_refused(
    option: str, make_method: MakeMethod, tiny: Tiny, make_trainer: MakeTrainer
) -> None:
    other = {"codes": 5, "motion_scale": "unit", "leak": 0.3}
    model = make_method("CodeTalker", **{option: other[option]})
    with pytest.raises(FaceDiffError, match=f"prior.*{option}"):
        make_trainer().fit(model, datamodule=tiny)


def test_another_models_checkpoint_is_no_prior(
    make_method: MakeMethod, tiny: Tiny, make_trainer: MakeTrainer, tmp_path: Path
) -> None:
    from facediff.models.published.importing import save_model

    save_model(laws.with_assets(make_method("FaceFormer")), tmp_path / "former.ckpt")
    for path in (tmp_path / "former.ckpt", tmp_path / "nothing.ckpt"):
        with pytest.raises(FaceDiffError, match=path.name):
            make_trainer().fit(make_method("CodeTalker", prior=str(path)), datamodule=tiny)


@pytest.mark.parametrize("prior", [None, "moved.ckpt"])
def test_a_predictor_goes_on_without_the_priors_file(
    prior: str | None, make_method: MakeMethod, tiny: Tiny, make_trainer: MakeTrainer, tmp_path: Path
) -> None:
    trainer = make_trainer(limit_train_batches=1, limit_val_batches=0)
    trainer.fit(make_method("CodeTalker"), datamodule=tiny)
    trainer.save_checkpoint(tmp_path / "model.ckpt")
    again = make_trainer(max_epochs=2, limit_train_batches=1, limit_val_batches=0)
    model = make_method("CodeTalker", prior=prior)
    model.check_training(resumed=True)  # as `facediff fit` does
    again.fit(model, datamodule=tiny, ckpt_path=tmp_path / "model.ckpt")
    assert again.current_epoch == 2


# The authors' files.


def test_the_stages_come_in_any_order_and_an_inner_prior_wins(tmp_path: Path) -> None:
    one, two = codetalker.stage_one("vocaset"), codetalker.stage_two("vocaset")
    other = codetalker.stage_one("vocaset", seed=9)
    inner = {**two, **{f"autoencoder.{name}": value for name, value in one.items()}}
    files = dict(zip("abcd", write(tmp_path, a=one, b=two, c=inner, d=other), strict=True))
    states = [imported([files[name] for name in names], "vocaset").state_dict() for names in ("ab", "ba", "c", "cd")]
    for state in states[1:]:
        assert all(torch.equal(state[name], value) for name, value in states[0].items())
    made = import_files(
        [files["c"], files["d"]],
        ImportOptions(
            dataset="vocaset",
            identities=IDENTITIES,
            templates=templates(),
            audio_config=published.AUDIO_CONFIG,
            model_options={"prior_heads": 2},
        ),
    )
    assert "quantize.embedding.weight" in made.files.ignored


def test_a_predictor_can_be_trained_on_an_authors_prior(tmp_path: Path) -> None:
    from facediff.models.published.importing import save_model

    one = codetalker.stage_one("biwi")
    save_model(imported(write(tmp_path, one=one), "biwi"), tmp_path / "prior.ckpt")
    loaded = load_model(tmp_path / "prior.ckpt")
    assert isinstance(loaded, CodeTalker)
    assert torch.equal(loaded.prior.codebook, one["quantize.embedding.weight"])
    assert loaded.prior_facts()["tokens"] == 2


def test_a_second_stage_alone_says_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(FaceDiffError, match="stage1") as caught:
        imported(write(tmp_path, two=codetalker.stage_two("vocaset")), "vocaset")
    assert str(caught.value).count(". ") <= 1
