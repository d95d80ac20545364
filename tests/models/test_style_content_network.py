"""The second method against NumPy (float64): content, style, speech branch; and the terms of its objective.

The spiral convolutions and the decoder have theirs in test_mesh_encoders and test_style_content_model.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, collate
from facediff.models import StyleContentDisentanglement
from facediff.models.style_content.losses import pair_up, relative_distance
from facediff.models.style_content.network import WindowedTransformer
from facediff.pipelines.export_model import quiet
from tests.fakes.style_content import make
from tests.fakes.tiny import VERTICES, Tiny

Array = np.ndarray
SCALE = 100.0
CLOSE = {"rtol": 2e-3, "atol": 2e-5}
"""The model computes in float32."""


def ready(tiny: Tiny, **options: object) -> StyleContentDisentanglement:
    """A model whose weights are all random, so that no term vanishes, with the corpus's assets."""
    model = make(**options)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    model.adopt(tiny.assets().with_motion_scale(SCALE))
    model.attach_mesh()
    model.alignment_allowed = lambda: True  # type: ignore[method-assign]
    return model


def double(tensor: torch.Tensor) -> Array:
    return tensor.detach().double().numpy()


@pytest.mark.parametrize("scale", ["clip", "free"])
def test_content_is_a_map_of_each_frame_and_may_lose_mean_and_spread(tiny: Tiny, scale: str) -> None:
    model = ready(tiny, content_scale=scale)
    motion, lengths = torch.randn(2, 9, VERTICES, 3), (9, 6)
    mask = torch.arange(9)[None] < torch.tensor(lengths)[:, None]
    made = double(model.network.content(motion, mask))
    for row, length in enumerate(lengths):
        content = double(model.network.content_encoder(motion[row : row + 1]))[0, :length]
        if scale == "clip":
            content = (content - content.mean(0)) / np.sqrt(content.var(0) + 1e-5)
        np.testing.assert_allclose(made[row, :length], content, **CLOSE)
        assert not made[row, length:].any()


ERF = np.vectorize(math.erf)


def norm(x: Array, w: dict[str, Array], name: str) -> Array:
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * w[f"{name}.weight"] + w[f"{name}.bias"]


def linear(x: Array, w: dict[str, Array], name: str) -> Array:
    return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]


def layer(x: Array, context: Array, w: dict[str, Array], name: str, heads: int) -> Array:
    """Pre-norm attention and a feed-forward part, each added to what it got."""
    query = linear(norm(x, w, f"{name}.norm"), w, f"{name}.attention.query")
    key, value = np.split(linear(norm(context, w, f"{name}.norm"), w, f"{name}.attention.key_value"), 2, -1)
    mixed = []
    for q, k, v in zip(*(np.split(part, heads, -1) for part in (query, key, value)), strict=True):
        scores = np.exp(q @ k.T / math.sqrt(q.shape[1]))
        mixed.append(scores / scores.sum(1, keepdims=True) @ v)
    x = x + linear(np.concatenate(mixed, -1), w, f"{name}.attention.out")
    hidden = linear(norm(x, w, f"{name}.feed_forward.0"), w, f"{name}.feed_forward.1.0")
    hidden = 0.5 * hidden * (1 + ERF(hidden / math.sqrt(2)))
    return x + linear(hidden, w, f"{name}.feed_forward.1.3")


@pytest.mark.parametrize("query", ["encoded", "input"])
@pytest.mark.parametrize(
    ("window", "ratio", "steps", "frames"), [(7, 1.0, 10, 10), (8, 5 / 3, 17, 10), (32, 5 / 3, 20, 12)]
)
def test_the_speech_branch_asks_with_the_middle_step(
    window: int, ratio: float, steps: int, frames: int, query: str
) -> None:
    """For every frame the W features around its centre, zeros past the ends, encoded; the middle one is the query."""
    torch.manual_seed(1)
    part = WindowedTransformer(in_dim=6, dim=8, out_dim=5, window=window, num_heads=2, num_layers=2, query=query)  # type: ignore[arg-type]
    with torch.no_grad():
        for parameter in part.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    features = torch.randn(1, steps, 6)
    w = {name: double(value) for name, value in part.state_dict().items()}
    made = double(part(features, frames, ratio))[0]
    for frame in range(frames):
        middle = min(math.floor((frame + 0.5) * ratio), steps - 1)
        source = np.zeros((window, 6))
        for place in range(window):
            step = middle - window // 2 + place
            if 0 <= step < steps:
                source[place] = double(features)[0, step]
        x = embedded = linear(source, w, "embed") + w["positions"]
        for number in range(2):
            x = layer(x, x, w, f"layers.{number}", 2)
        asking = x if query == "encoded" else embedded
        answer = layer(asking[window // 2 : window // 2 + 1], x, w, "query", 2)
        expected = linear(norm(answer, w, "out.0"), w, "out.1")[0]
        np.testing.assert_allclose(made[frame], expected, rtol=1e-4, atol=1e-4)


def test_windows_of_any_number_of_clips_become_a_graph() -> None:
    """The exporter must not take the number of clips that it was shown for a constant."""

    class Windows(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.part = WindowedTransformer(in_dim=6, dim=8, out_dim=5, window=3, num_heads=2, num_layers=1)

        def forward(self, features: Tensor, lengths: Tensor) -> Tensor:
            return self.part.windows(features, features.shape[1] // 2, 2.0, lengths)

    module, any_size = Windows().eval(), torch.export.Dim.DYNAMIC
    example, axes = (torch.randn(2, 8, 6), torch.tensor([8, 6])), ({0: any_size, 1: any_size}, {0: any_size})
    with quiet():
        graph = torch.export.export(module, example, dynamic_shapes=axes).module()
    other = torch.randn(3, 10, 6), torch.tensor([8, 6, 4])
    torch.testing.assert_close(graph(*other), module(*other))


@pytest.mark.parametrize("rate", [None, 25.0, 50.0, 60.0, 12.5])
def test_speech_is_encoded_at_its_own_rate(tiny: Tiny, rate: float | None) -> None:
    """The audio encoder is asked for ``speech_rate`` steps a second, the windows lie as many apart as fit a frame."""
    model, batch = ready(tiny, speech_rate=rate), clips(tiny, "A_e01", "B_e03")
    network, ratio = model.network, (rate or 25.0) / 25.0
    steps = [round(frames * ratio) for frames in batch.frame_lengths.tolist()]
    assert model.network.speech_content.window == round(0.64 * (rate or 25.0))
    with torch.no_grad():
        features = network.audio_encoder(batch.audio, batch.audio_lengths, torch.tensor(steps))
        expected = network.speech_content(features, batch.motion.shape[1], ratio)
        made = network.content_of_speech(batch)
    assert made.shape == (2, batch.motion.shape[1], 8)
    assert torch.equal(made[batch.mask], expected[batch.mask])
    before, after = model.context_frames()
    window, half = network.speech_content.window, network.speech_content.window // 2
    assert (before, after) == (8 + math.ceil(half / ratio), math.ceil((window - 1 - half) / ratio))


def test_kept_features_of_speech_stand_for_the_speech(tiny: Tiny, ctc_source: Path) -> None:
    """Where the batch brings features, no speech is heard."""
    model = ready(tiny, audio_encoder=partial(registry.audio_encoder.ctc, source=str(ctc_source)))
    batch, network = clips(tiny, "A_e01", "B_e03"), model.network
    features, lengths = network.audio_encoder.frozen_features(batch.audio, batch.audio_lengths)
    kept = replace(batch, features=features, feature_lengths=lengths)
    with torch.no_grad():
        heard = network.content_of_speech(batch)
        network.audio_encoder.frozen_features = None  # type: ignore[method-assign, assignment]
        assert torch.equal(network.content_of_speech(kept), heard)
        changed = network.content_of_speech(replace(kept, features=features.roll(1, 1)))
    assert not torch.allclose(changed, heard, atol=1e-3)


def test_the_style_of_windows_is_of_the_frames_that_count(tiny: Tiny) -> None:
    """Windows may begin anywhere in what was read, and be of unequal length where a clip is shorter than one."""
    model, batch = ready(tiny), clips(tiny, "A_e01", "B_e02", "A_e04")
    lengths = batch.frame_lengths.tolist()
    windows = [(3, 11), (0, 5), (lengths[2] - 6, lengths[2])]
    motion = batch.motion * SCALE
    with torch.no_grad():
        made = model.style_of_window(replace(batch, window=torch.tensor(windows)), motion)
        for row, (first, end) in enumerate(windows):
            part = motion[row : row + 1, first:end]
            alone = model.network.style(part, torch.ones(part.shape[:2], dtype=torch.bool))
            torch.testing.assert_close(made[row], alone[0], rtol=1e-4, atol=1e-5)
        whole = model.style_of_window(batch, motion)
        torch.testing.assert_close(whole, model.network.style(motion, batch.mask))


def test_windows_are_aligned_where_the_data_set_says_so(tiny: Tiny) -> None:
    """−1 is a frame without a partner; a clip that is its own partner, and frames around a window, do not count."""
    batch = clips(tiny, "A_e01", "B_e01", "A_e02", "A_e03", "B_e04")
    frames = batch.motion.shape[1]
    places = torch.full((5, frames), -1)
    places[0, 2:6], places[1, 1:5], places[2, 0:3], places[4, 0:3] = 3, 4, 1, 2
    windows = torch.tensor([(3, 9), (0, 4), (0, 8), (0, 8), (0, 8)])
    batch = replace(batch, partner_frames=places, window=windows)
    pairing = pair_up(batch, ready(tiny).alignments)
    assert pairing.partner.tolist() == [1, 0, 2, 3, 4], "two sentences of one person have nothing to swap"
    found = [row.nonzero().flatten().tolist() for row in pairing.aligned]
    assert found == [[3, 4, 5], [1, 2, 3], [], [], []]
    assert pairing.frames.tolist() == places.clamp_min(0).tolist()
    assert not pair_up(batch, None).aligned.any()


@pytest.mark.parametrize(("ratio", "frames"), [(1.0, None), (0.5, None), (2.0, 4), (1.0, 6), (1.0, 12)])
def test_windows_of_speech_are_as_many_as_frames(ratio: float, frames: int | None) -> None:
    """As many as features where no number is given; the last feature stands for those that rounding lost."""
    part = WindowedTransformer(in_dim=3, dim=8, out_dim=4, window=4, num_heads=2, num_layers=0)
    features = torch.randn(2, 9, 3)
    made = part.windows(features, frames, ratio)
    count = 9 if frames is None else frames
    assert made.shape == (2, count, 4, 3)
    padded = np.pad(double(features), ((0, 0), (2, 1), (0, 0)))
    for frame in range(count):
        middle = min(math.floor((frame + 0.5) * ratio), 8)
        np.testing.assert_array_equal(double(made[:, frame]), padded[:, middle : middle + 4])
    shorter = part.windows(features, frames, ratio, torch.tensor([9, 3]))
    for frame in range(count):
        middle = min(math.floor((frame + 0.5) * ratio), 8 if frames is None and ratio == 1 else 2)  # its own last one
        np.testing.assert_array_equal(double(shorter[1, frame]), padded[1, middle : middle + 4])


# The objective.


def clips(data: Tiny, *names: str) -> Batch:
    dataset = data.dataset("train")
    order = [clip.name for clip in dataset.clips]
    return collate([dataset[order.index(name)] for name in names])


WHOLE_CLIPS = {
    **{"recording_content": 0.18262, "identity_style": 2.0197, "speech_content": 2.7451, "reconstruction": 0.35498},
    **{"swap": 8.1377, "swap_dynamics": 0.40058, "cycle": 0.35303, "speech_reconstruction": 0.35468},
    **{"speech_swap": 10.292, "speech_swap_dynamics": 0.64298, "speech_cycle": 0.35319, "loss": 128.18},
}
"""Terms of two pairs, one of which says the same; to 2e-7 those of the formulas in NumPy, float64."""
WINDOWS = {
    **{"recording_content": 0.0092679, "identity_style": 0.0028548, "speech_content": 0.33824},
    **{"reconstruction": 0.44874, "swap": 0.73265, "swap_dynamics": 0.71401, "cycle": 0.45988},
    **{"speech_reconstruction": 0.44838, "speech_swap": 0.73186, "speech_swap_dynamics": 0.57832},
    **{"speech_cycle": 0.45971, "loss": 11.054},
}
"""The same of aligned windows in the published setting."""


def test_terms_of_whole_clips_stay_as_they_are(tiny: Tiny) -> None:
    torch.manual_seed(0)
    model = ready(tiny)
    with torch.no_grad():
        made = model.losses(clips(tiny, "A_e01", "B_e01", "A_e02", "B_e03"))
    assert {name: float(value) for name, value in made.items()} == pytest.approx(WHOLE_CLIPS, rel=1e-3)


def test_speech_is_decoded_with_another_clips_style_unless_told_otherwise(tiny: Tiny) -> None:
    model, batch, styles = ready(tiny), clips(tiny, "A_e01", "B_e01", "A_e02", "B_e03"), []
    branch = model.branch_losses
    model.branch_losses = lambda *given: (styles.append(given[4]), branch(*given))[1]
    for chosen in ("other_clip", "own"):
        model.options.speech_style = chosen
        model.losses(batch)
    assert torch.equal(styles[1], model.network.style(batch.reference * SCALE, batch.reference_mask))
    assert torch.equal(styles[3], model.style_of_window(batch, batch.motion * SCALE))


def test_contents_that_never_change_are_no_distance_apart() -> None:
    still = torch.ones(1, 4, 3)
    assert relative_distance(still, still, torch.ones(1, 4, dtype=torch.bool)) == 0


def test_what_comes_back_from_a_swap_follows_what_went_in(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    """No gradient goes through the content and the style that swapped motion is to give back."""
    from facediff.models.style_content import model as module

    model, batch, targets = ready(tiny), clips(tiny, "A_e02", "B_e03"), []

    def distance(values: torch.Tensor, target: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
        targets.append((values.requires_grad, target.requires_grad))
        return relative_distance(values, target, counted)

    monkeypatch.setattr(module, "relative_distance", distance)
    content = torch.randn(2, batch.motion.shape[1], 8, requires_grad=True)
    style = torch.randn(2, 4, requires_grad=True)
    pairing = pair_up(batch, model.alignments)
    model.branch_losses(batch, batch.motion * SCALE, pairing, content, style, style)
    assert targets == [(True, False), (True, False)]


@pytest.mark.parametrize(("rate", "before", "after"), [(30.0, 10, 9), (25.0, 8, 8)])
def test_windows_have_the_frames_that_their_first_frame_listens_to(
    tiny: Tiny, rate: float, before: int, after: int
) -> None:
    """Of 32 steps at 50 a second 16 lie before the middle, ⌈16 · rate / 50⌉ frames, and 15 after it."""
    model = make(speech_rate=50.0, frame_rate=rate)
    network, ratio, frame = model.network.eval(), 50.0 / rate, 40
    assert model.context_frames() == (network.decoder.past_frames + before, after)
    features = torch.randn(1, round(60 * ratio), network.speech_content.embed.in_features, requires_grad=True)
    content, style = network.speech_content(features, 60, ratio), torch.randn(1, 4)
    motion = network.decoder(content, style, torch.ones(1, 60, dtype=torch.bool))
    (heard,) = torch.autograd.grad(motion[0, frame].square().sum(), features)
    steps = heard[0].abs().sum(-1).nonzero()
    assert (int(steps.min() / ratio), int(steps.max() / ratio)) == (frame - 8 - before, frame + after)


PUBLISHED: dict[str, object] = {
    "content_scale": "free",
    "content_pull": "squared",
    "style_pull": "squared",
    "speech_style": "own",
    "identity_style_weight": 1.0,
    "swap_dynamics_weight": 0.0,
    "speech_rate": 50.0,
    "window_context": True,
    "aligned_windows": True,
}


def test_terms_of_aligned_windows_stay_as_they_are(tiny_root: Path) -> None:
    """Windows of 8 frames with the frames around them; no loss counts a frame outside."""
    torch.manual_seed(0)
    data = Tiny(root=str(tiny_root), window=8, batch_size=4)
    model = ready(data, **PUBLISHED)
    data.pair_sentences, data.aligner, data.window_context = True, model.alignments, model.context_frames()
    assert data.window_context == (16, 8), "half of 32 steps at 50 a second on either side; taps 5, 3 and 3 before"
    batch = next(iter(data.train_dataloader()))
    assert batch.motion.shape[1] > 8
    with torch.no_grad():
        made = model.losses(batch)
    assert {name: float(value) for name, value in made.items()} == pytest.approx(WINDOWS, rel=1e-3)
