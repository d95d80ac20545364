"""Options of the published training: the rate's decay, windows that fill a clip, a speaker's style, masks, words."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer

from facediff.data import Vocaset
from facediff.data.corpus import Clip
from facediff.data.dataset import ClipBatches
from facediff.errors import FaceDiffError
from facediff.mesh.flame import read_masks
from facediff.models import Style, load_model
from facediff.models.checkpoint_content import STYLES_KEY
from facediff.models.optimizers import lr_factor
from facediff.models.style_content.losses import squared_distance, style_distance
from tests.fakes.style_content import make
from tests.fakes.tiny import Tiny, write_tiny

MakeTrainer = Callable[..., Trainer]


def test_the_rate_falls_as_its_schedule_says() -> None:
    """By a tenth in every epoch from the thirtieth, or by half once in twenty epochs."""
    exponential = ((0, 1.0), (29, 1.0), (30, 0.9), (31, 0.81), (199, 0.9**170))
    step = ((0, 1.0), (19, 1.0), (20, 0.5), (39, 0.5), (40, 0.25), (199, 0.5**9))
    for name, factors, more in (("exponential", exponential, {}), ("step", step, {"decay": 0.5, "decay_epoch": 20})):
        options: dict[str, Any] = {"total": 200 * 7, "warmup_steps": 0, "schedule": name, "epoch_steps": 7, **more}
        for epoch, expected in factors:
            assert [lr_factor(7 * epoch + n, **options) for n in (0, 6)] == pytest.approx([expected] * 2), (name, epoch)
        assert lr_factor(0, **{**options, "warmup_steps": 10}) == pytest.approx(0.1)


def test_training_follows_the_rate(tiny_root: Path, make_trainer: MakeTrainer) -> None:
    model, rates = make(lr_schedule="exponential", lr_decay=0.5, lr_decay_epoch=1, learning_rate=1e-3), []
    step = model.on_train_batch_start = lambda *_: rates.append(model.optimizers().param_groups[0]["lr"])  # type: ignore[method-assign, assignment]
    assert step is not None
    make_trainer(max_epochs=3, limit_val_batches=0).fit(model, datamodule=Tiny(root=str(tiny_root), batch_size=4))
    assert rates == pytest.approx([1e-3] * 2 + [5e-4] * 2 + [2.5e-4] * 2)


@pytest.mark.parametrize("context", [False, True])
@pytest.mark.parametrize("windows", [False, True])
@pytest.mark.parametrize("pairs", [False, True])
def test_training_asks_the_data_for_what_the_options_say(
    tiny_root: Path, make_trainer: MakeTrainer, context: bool, windows: bool, pairs: bool
) -> None:
    model = make(window_context=context, aligned_windows=windows, aligned_pairs=pairs)
    data, trainer = Tiny(root=str(tiny_root), window=8), make_trainer()
    model.trainer, trainer.datamodule = trainer, data  # type: ignore[attr-defined]
    model.setup("fit")
    assert data.pair_sentences
    assert data.aligner is (model.alignments if windows and pairs else None)
    assert data.window_context == ((16, 7) if context else (0, 0))
    model.train()
    assert model.alignment_allowed() == (windows and pairs)
    model.eval()
    assert not model.alignment_allowed()


def test_a_new_basis_starts_from_principal_components_and_a_trained_one_stays(
    tiny_root: Path, make_trainer: MakeTrainer
) -> None:
    model, data, trainer = make(), Tiny(root=str(tiny_root)), make_trainer()
    model.trainer, trainer.datamodule = trainer, data  # type: ignore[attr-defined]
    basis = model.network.decoder.basis
    before = basis.weight.detach().clone()
    model.setup("fit")
    mean, shapes = data.principal_motion(6)
    torch.testing.assert_close(basis.bias.detach(), mean * model.scale)
    torch.testing.assert_close(basis.weight.detach()[:, : len(shapes)], (shapes * model.scale).T)
    torch.nn.init.zeros_(basis.weight)
    model.setup("fit")  # resumed: its assets are known
    assert not basis.weight.any()
    fresh = make()
    fresh.trainer = trainer
    fresh.setup("test")
    assert torch.equal(fresh.network.decoder.basis.weight, before)


def test_an_epoch_takes_as_many_windows_as_it_should() -> None:
    """Pairs of one group, no clip with itself, every clip as often as asked, each time with another seed."""
    copies, groups = [1, 3, 2, 3, 1, 1], ["a", "b", "b", "b", "a", "c"]
    batches = ClipBatches([9] * 6, batch_size=4, training=True, copies=copies, groups=groups)
    picks = [pick for batch in batches for pick in batch]
    counts = Counter(pick.index for pick in picks)
    assert all(counts[index] >= count for index, count in enumerate(copies))
    assert len({(pick.index, pick.seed) for pick in picks}) >= sum(copies)
    for batch in batches:
        for one, other in zip(batch[::2], batch[1::2], strict=True):
            assert one.index != other.index
    assert len(list(batches)) == len(batches)
    once = [ClipBatches([9] * 6, batch_size=4, training=True, groups=groups, copies=each) for each in (None, [1] * 6)]
    assert list(once[0]) == list(once[1])


def test_masks_may_be_left_out_of_others(tmp_path: Path) -> None:
    masks = {"face": np.arange(6), "eyes": np.array([1, 4]), "left-ear": np.array([7])}
    (tmp_path / "masks.pkl").write_bytes(pickle.dumps(masks, 2))
    assert read_masks(tmp_path / "masks.pkl", "face-eyes") == [0, 2, 3, 5]
    assert read_masks(tmp_path / "masks.pkl", "face-eyes+left-ear") == [0, 2, 3, 5, 7]
    with pytest.raises(FaceDiffError, match='no mask "eye"'):
        read_masks(tmp_path / "masks.pkl", "face-eye")


def test_a_face_that_no_file_lists_is_refused(tiny: Tiny) -> None:
    with pytest.raises(FaceDiffError, match=r"data\.face"):
        make(vertices="face").adopt(tiny.assets())


def test_the_encoders_do_not_see_what_is_not_the_face(tmp_path: Path) -> None:
    root = write_tiny(tmp_path / "tiny", sentences=5)
    (root / "regions" / "face.txt").write_text(",".join(map(str, range(20))))
    data = Tiny(root=str(root), face="regions/face.txt")
    model = make(vertices="face")
    model.adopt(data.assets().with_motion_scale(100.0))
    model.attach_mesh()
    motion, mask = torch.randn(1, 6, 24, 3), torch.ones(1, 6, dtype=torch.bool)
    other = motion.clone()
    other[:, :, 20:] += 1.0
    with torch.no_grad():
        assert torch.equal(model.encode_style(motion, mask), model.encode_style(other, mask))
        assert torch.equal(model.network.content(motion, mask), model.network.content(other, mask))
    assert model.lower_face().tolist() == list(range(12))
    batch = next(iter(data.val_dataloader()))
    same = model.distance_to(batch, other, motion, mask, None)
    assert float(same) == 0.0
    model.assets.regions["face"] = torch.tensor([3, 5, 20])
    assert model.lower_face().tolist() == [3, 5]


def test_plain_distances_by_hand() -> None:
    one, other = torch.randn(2, 5, 3), torch.randn(2, 5, 3)
    mask = torch.tensor([[True] * 5, [True, True, False, False, False]])
    kept = ((one - other) ** 2).double().numpy()[mask.numpy()]
    assert float(squared_distance(one, other, mask)) == pytest.approx(kept.mean(), rel=1e-5)
    styles = torch.randn(4, 3)
    pairs = [(0, 2), (0, 3), (2, 3)]
    want = np.mean([((styles[i] - styles[k]) ** 2).mean().item() for i, k in pairs])
    assert float(style_distance(styles, ["A", "B", "A", "A"])) == pytest.approx(want, rel=1e-5)
    assert float(style_distance(styles[:2], ["A", "B"])) == 0.0


def test_a_speakers_style_is_of_all_their_motion(tiny_root: Path, tmp_path: Path, make_trainer: MakeTrainer) -> None:
    """The mean over stretches of a reference's length, of clips that are not evaluated; a checkpoint keeps it."""
    data, model = Tiny(root=str(tiny_root), batch_size=4, reference_frames=8), make(style_source="person")
    seen: list[torch.Tensor | None] = []
    generate = model.generate_clips

    def note(batch: object, **options: object) -> torch.Tensor:
        seen.append(batch.style)  # type: ignore[attr-defined]
        return generate(batch, **options)  # type: ignore[arg-type]

    model.generate_clips = note  # type: ignore[method-assign, assignment]
    trainer = make_trainer(max_epochs=1)
    trainer.fit(model, datamodule=data)
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    assert model.person_styles.keys() == {"A", "B", "C"}
    loaded = load_model(tmp_path / "a.ckpt")
    for name in "ABC":
        total, frames = torch.zeros(4), 0
        for number in (1, 2, 3, 4, *([5] if name == "C" else [])):
            motion = data.corpus.read_motion(data.corpus.clips[f"{name}_e0{number}"])
            for part in torch.split(motion, 8):
                whole = torch.ones(1, len(part), dtype=torch.bool)
                total += len(part) * loaded.encode_style(part[None], whole)[0].detach()
                frames += len(part)
        style = loaded.default_style(name)
        assert isinstance(style, Style)
        torch.testing.assert_close(style.vector, total / frames, rtol=1e-4, atol=1e-6)
    (used,) = seen  # of both validation clips
    assert used is not None
    torch.testing.assert_close(used, torch.stack([model.person_styles[name].vector for name in "AB"]))
    speech = torch.randn(16_000)
    given = loaded.animate(speech, identity="A", style=loaded.default_style("A")).vertices
    assert torch.equal(loaded.animate(speech, identity="A").vertices, given)
    broken = torch.load(tmp_path / "a.ckpt", weights_only=True)
    broken[STYLES_KEY]["A"] = ("x", torch.full((4,), torch.nan))
    torch.save(broken, tmp_path / "b.ckpt")
    with pytest.raises(FaceDiffError, match=r"b\.ckpt.*style of"):
        load_model(tmp_path / "b.ckpt")
    broken[STYLES_KEY] = {"A": ("x", torch.ones(1))}
    torch.save(broken, tmp_path / "b.ckpt")
    with pytest.raises(FaceDiffError, match=r"b\.ckpt: its styles of speakers have 1 numbers, those of its model 4"):
        load_model(tmp_path / "b.ckpt")


def test_words_decide_what_is_the_same_sentence() -> None:
    data = Vocaset(root=".")

    def says(name: str, text: str = "") -> str:
        clip = Vocaset.parse_name(name)
        assert clip is not None
        return data.words_of(Clip(clip.name, clip.identity, clip.sentence, {"text": text} if text else {}))

    one, other = "FaceTalk_170728_03272_TA", "FaceTalk_170904_00128_TA"
    assert says(f"{one}_sentence01") == says(f"{other}_sentence01")
    assert says(f"{one}_sentence25") != says(f"{other}_sentence25"), "unique to each speaker"
    assert says(f"{one}_sentence25", "Wash it, now!") == says(f"{other}_sentence03", "wash it now")
    assert says(f"{one}_sentence01", "Wash it.") != says(f"{other}_sentence01", "Leave it.")
