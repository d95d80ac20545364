"""The second method against NumPy (float64): content, style, speech branch, and every term of its objective.

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
from facediff.speech.cepstra import align_features, cepstra
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


# The objective, written out from its formulas: the networks are called, everything between them is NumPy.


class Objective:
    """The terms of a batch, in float64."""

    def __init__(self, model: StyleContentDisentanglement, batch: Batch) -> None:
        self.model, self.network, self.batch = model, model.network, batch
        self.truth = double(batch.motion) * SCALE
        self.counted = double(batch.window_mask).astype(bool)
        pairing = pair_up(batch, model.alignments)
        self.partner, self.places = pairing.partner.tolist(), pairing.frames.numpy()
        self.aligned = pairing.aligned.numpy()

    def content(self, motion: Array) -> Array:
        return double(self.network.content(torch.tensor(motion).float(), self.batch.mask))

    def style(self, motion: Array) -> Array:
        """Of the frames that count, one clip at a time."""
        rows = [torch.tensor(motion[i][self.counted[i]][None]).float() for i in range(len(motion))]
        return np.stack(
            [double(self.network.style(row, torch.ones(row.shape[:2], dtype=torch.bool)))[0] for row in rows]
        )

    def decode(self, content: Array, style: Array) -> Array:
        flat = self.network.decoder(torch.tensor(content).float(), torch.tensor(style).float(), self.batch.mask)
        return double(flat).reshape(*content.shape[:2], VERTICES, 3)

    def compare(self, motion: Array, truth: Array, frames: Array, vertices: Array) -> float:
        """Position 1, velocity 5, gap between the inner lips 1."""
        positions, velocities, gaps = [], [], []
        rest, pairs = double(self.batch.template) * SCALE, double(self.model.assets.inner_lip_pairs).astype(int)
        for i in range(len(motion)):
            gap = []
            for each in (motion[i] + rest[i], truth[i] + rest[i]):
                gap.append(np.sqrt(((each[:, pairs[:, 0]] - each[:, pairs[:, 1]]) ** 2).sum(-1) + 1e-6))
            for t in np.flatnonzero(frames[i]):
                error = motion[i, t, vertices] - truth[i, t, vertices]
                positions.append((error**2).mean())
                gaps.append(((gap[0][t] - gap[1][t]) ** 2).mean())
                if t and frames[i, t - 1]:
                    before = motion[i, t - 1, vertices] - truth[i, t - 1, vertices]
                    velocities.append(((error - before) ** 2).mean())
        means = [float(np.mean(values)) if values else 0.0 for values in (positions, velocities, gaps)]
        return means[0] + 5 * means[1] + means[2]

    def relative(self, values: Array, others: Array) -> float:
        """2 ‖a − b‖² / (var a + var b), means over frames and channels; (frames, channels) each."""
        if len(values) < 2:
            return 0.0
        spread = values.var(0).mean() + others.var(0).mean()
        return float(2 * ((values - others) ** 2).mean() / (spread + 1e-6))

    def of_partner(self, values: Array) -> Array:
        return np.stack([values[self.partner[i], self.places[i]] for i in range(len(values))])

    def branch(self, content: Array, own: Array, style: Array) -> dict[str, float]:
        everything = np.arange(VERTICES)
        lower = np.setdiff1d(everything, double(self.model.assets.regions["upper_face"]).astype(int))
        terms = {"reconstruction": self.compare(self.decode(content, own), self.truth, self.counted, everything)}
        # Swapped: the content of i with the style of its partner j, who said it so.
        swapped = self.decode(content, style[self.partner])
        terms["swap"] = self.compare(swapped, self.of_partner(self.truth), self.aligned, lower)
        again, style_again = self.content(swapped), self.style(swapped)
        free = [i for i in range(len(content)) if self.partner[i] != i and not self.aligned[i].any()]
        if free:
            chosen = [(again[i][self.counted[i]], content[i][self.counted[i]]) for i in free]
            terms["swap"] += self.relative(*(np.concatenate(each) for each in zip(*chosen, strict=True)))
            terms["swap"] += self.relative(style_again[free], style[self.partner][free])
        # Twice swapped: back to what it was.
        back = self.decode(again, style_again[self.partner])
        terms["cycle"] = self.compare(back, self.truth, self.counted, everything)
        return terms

    def terms(self, *, squared: bool, own_style: bool) -> dict[str, float]:
        batch, count = self.batch, len(self.batch)
        content, style = self.content(self.truth), self.style(self.truth)
        spoken = double(self.network.content_of_speech(batch))
        references = double(batch.reference) * SCALE
        usual = double(self.network.style(torch.tensor(references).float(), batch.reference_mask))

        def pull(values: Array, others: Array, frames: Array) -> float:
            if squared:
                return float(((values - others)[frames] ** 2).mean()) if frames.any() else 0.0
            return self.relative(values[frames], others[frames])

        styles, names = np.concatenate([style, usual]), batch.identity_names * 2
        apart = [
            ((styles[i] - styles[k]) ** 2).mean()
            for i in range(2 * count)
            for k in range(i + 1, 2 * count)
            if names[i] == names[k]
        ]
        found = {
            "recording_content": pull(content, self.of_partner(content), self.aligned),
            "speech_content": pull(content, spoken, self.counted),
            **({"identity_style": float(np.mean(apart))} if squared else {}),
        }
        found |= self.branch(content, style, style)
        speech = self.branch(spoken, style if own_style else usual, style)
        return found | {f"speech_{name}": value for name, value in speech.items()}


def clips(data: Tiny, *names: str) -> Batch:
    dataset = data.dataset("train")
    order = [clip.name for clip in dataset.clips]
    return collate([dataset[order.index(name)] for name in names])


def test_every_term_of_whole_clips_is_its_formula(tiny: Tiny) -> None:
    """Two pairs: one that says the same, one that does not."""
    model, batch = ready(tiny), clips(tiny, "A_e01", "B_e01", "A_e02", "B_e03")
    with torch.no_grad():
        made = model.losses(batch)
    expected = Objective(model, batch).terms(squared=False, own_style=False)
    assert expected["swap"] > 0
    for name, value in expected.items():
        assert float(made[name]) == pytest.approx(value, rel=2e-3, abs=1e-6), name
    weights = {"reconstruction": 1, "swap": 3, "cycle": 1, "swap_dynamics": 3}
    weights |= {f"speech_{name}": 2 * weight for name, weight in weights.items()}
    weights |= {"recording_content": 5, "identity_style": 10, "speech_content": 5}
    total = sum(weight * float(made[name]) for name, weight in weights.items())
    assert float(made["loss"]) == pytest.approx(total, rel=1e-5)


def test_speech_is_decoded_with_another_clips_style(tiny: Tiny) -> None:
    """Unless told to take the clip's own. The style is made to count, so that the two differ by more than rounding."""
    batch, apart = clips(tiny, "A_e01", "B_e01", "A_e02", "B_e03"), []
    for chosen in ("other_clip", "own"):
        model = ready(tiny, speech_style=chosen)
        plain = model.network.style
        model.network.style = lambda *motion, plain=plain: 20 * plain(*motion)
        with torch.no_grad():
            made = float(model.losses(batch)["speech_reconstruction"])
        expected = Objective(model, batch).terms(squared=False, own_style=chosen == "own")["speech_reconstruction"]
        assert made == pytest.approx(expected, rel=2e-3)
        apart.append(made)
    assert abs(apart[0] / apart[1] - 1) > 0.01


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


def test_every_term_of_aligned_windows_is_its_formula(tiny_root: Path) -> None:
    """Windows of 8 frames with the frames around them, in the published setting; no loss counts a frame outside."""
    data = Tiny(root=str(tiny_root), window=8, batch_size=4)
    model = ready(data, **PUBLISHED)
    data.pair_sentences, data.aligner, data.window_context = True, model.alignments, model.context_frames()
    assert data.window_context == (16, 8), "half of 32 steps at 50 a second on either side; taps 5, 3 and 3 before"
    samples = next(iter(data.train_dataloader()))
    batch = samples if isinstance(samples, Batch) else collate(samples)
    assert batch.window is not None
    assert batch.partner_frames is not None
    assert batch.motion.shape[1] > 8
    with torch.no_grad():
        made = model.losses(batch)
    expected = Objective(model, batch).terms(squared=True, own_style=True)
    assert expected["recording_content"] > 0
    for name, value in expected.items():
        assert float(made[name]) == pytest.approx(value, rel=2e-3, abs=1e-6), name
    weights = {"reconstruction": 1, "swap": 3, "cycle": 1}
    weights |= {f"speech_{name}": 2 * weight for name, weight in weights.items()}
    weights |= {"recording_content": 5, "identity_style": 1, "speech_content": 5}
    total = sum(weight * float(made[name]) for name, weight in weights.items())
    assert float(made["loss"]) == pytest.approx(total, rel=1e-5)


def test_partner_frames_are_those_of_the_whole_clips(tiny_root: Path) -> None:
    """A window's partner frames, put back into the clips, are the alignment that the whole clips have."""
    data = Tiny(root=str(tiny_root), window=8)
    data.pair_sentences, data.aligner, data.window_context = True, make().alignments, (3, 2)
    dataset = data.dataset("train", training=True)
    order = [clip.name for clip in dataset.clips]
    pick = partial(replace, next(iter(data._loader("train", training=True).sampler))[0])  # type: ignore[call-overload]
    for seed in range(5):
        one, other = dataset.pair(
            pick(index=order.index("A_e04"), seed=seed), pick(index=order.index("B_e04"), seed=seed + 9)
        )
        whole = {clip.name: data.corpus.read_motion(clip) for clip in dataset.clips}
        for mine, theirs in ((one, other), (other, one)):
            begins = [
                next(
                    t for t in range(len(whole[s.name])) if torch.equal(whole[s.name][t : t + len(s.motion)], s.motion)
                )
                for s in (mine, theirs)
            ]
            audio = [
                data.corpus.read_audio(c, 0, len(whole[c.name]))
                for s in (mine, theirs)
                for c in dataset.clips
                if c.name == s.name
            ]
            features = [
                cepstra(a.numpy(), len(whole[s.name]), 25.0) for a, s in zip(audio, (mine, theirs), strict=True)
            ]
            path = align_features(*features)[begins[0] : begins[0] + len(mine.motion)] - begins[1]
            path[(path < 0) | (path >= len(theirs.motion))] = -1
            assert mine.partner_frames is not None
            np.testing.assert_array_equal(mine.partner_frames, path)
            assert mine.window is not None
            assert mine.window[1] - mine.window[0] == 8
