"""The published methods as graphs; see :mod:`facediff.models.graphs`.

Their audio encoders know no padding, so graphs take clips of one length; their windows go over into one another
in the motion. A training identity is their style.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.models.graphs import (
    BATCH,
    FRAMES,
    Axes,
    Graph,
    Graphs,
    SamplingLoop,
    Speech,
    StyleSource,
    results_of,
    speech_graph,
)
from facediff.models.published.diffspeaker import step_shares

if TYPE_CHECKING:
    from facediff.models.published.base import DirectModel, PublishedModel
    from facediff.models.published.diffspeaker import DiffSpeaker
    from facediff.models.published.facediffuser import FaceDiffuser


def whole_model(model: PublishedModel, parts: list[Graph], sampling: SamplingLoop | None = None) -> Graphs:
    """What is said of a published method besides its graphs."""
    style: StyleSource = "identity" if model.own_styles() else "none"
    longest = None if model.long_speech == "extend" else model.table_frames
    return Graphs(
        parts=parts,
        equal_lengths=True,
        blending="motion",
        clock=model.clock,
        style=style,
        epsilon=float(getattr(model.audio_encoder, "epsilon", 1e-7)),
        longest=longest or 0,
        sampling=sampling,
    )


class DirectMotion(nn.Module):
    """Features of speech to offsets from the template."""

    def __init__(self, model: DirectModel) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, features: Float[Tensor, "batch frames *width"], identity: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """In the unit of the corpus; the identity is an index, or −1."""
        model = self.model
        made = model.decode(features, model.weights_of(identity), None)
        return made.view(*made.shape[:2], model.n_vertices, 3) / model.scale


def direct_graphs(model: DirectModel) -> Graphs:
    """A method that makes all frames at once."""

    def hear(heard: Speech, frames: Int[Tensor, " batch"], _: int) -> Tensor:
        return model.hear(heard, frames)

    speech = speech_graph(model, hear, lambda frames: model.heard_steps * frames)
    features = results_of(speech)
    inputs: dict[str, Any] = {"features": features, "identity": zeros(len(features))}
    motion = Graph("motion", DirectMotion(model), inputs, {"features": FRAMES, "identity": BATCH}, ("offsets",))
    return whole_model(model, [speech, motion])


# FaceDiffuser.


class DiffuserStep(nn.Module):
    """Noisy motion to clean motion at one step, and the features that the last map makes motion of."""

    def __init__(self, model: FaceDiffuser) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        features: Float[Tensor, "batch frames dim"],
        identity: Int[Tensor, " batch"],
        template: Float[Tensor, "batch vertices 3"],
        state: Float[Tensor, "batch frames state"],
        step: Int[Tensor, " batch"],
    ) -> tuple[Tensor, Tensor]:
        """Where vertices are noised with the face, the template is a part of what is predicted."""
        model, network = self.model, self.model.network
        space = model.space(model.rest(template))
        made = network(space.mapped(state), step, features, network.style(model.weights_of(identity)))
        return space.clean(made), made


class DiffuserStart(nn.Module):
    """Unit noise to the motion that sampling starts from where its first steps are skipped."""

    def __init__(self, model: FaceDiffuser, step: int) -> None:
        super().__init__()
        self.model = model
        self.share = model.posterior.noise_share(step)

    def forward(self, noise: Float[Tensor, "batch frames state"]) -> Float[Tensor, "batch frames state"]:
        """Noised zeros."""
        space = self.model.space(torch.zeros(1, 1, 3 * self.model.n_vertices))
        return space.noise(lambda like: like, noise) * self.share


class LastMap(nn.Module):
    """The network's last features to offsets from the template."""

    def __init__(self, model: FaceDiffuser) -> None:
        super().__init__()
        self.model = model

    def forward(self, sample: Float[Tensor, "batch frames dim"]) -> Float[Tensor, "batch frames vertices 3"]:
        """In the unit of the corpus."""
        made = self.model.network.motion_out(sample)
        return made.view(*made.shape[:2], self.model.n_vertices, 3) / self.model.scale


def facediffuser_graphs(model: FaceDiffuser) -> Graphs:
    """FaceDiffuser over all of its steps, with fresh noise in each but the last."""
    speech = heard_graph(model, 2)
    features, space = results_of(speech), model.space(torch.zeros(1, 1, 3 * model.n_vertices))
    batch, frames, dim = features.shape
    step = Graph(
        "step",
        DiffuserStep(model),
        {**conditions_of(features, model), "state": torch.zeros(batch, frames, space.width), "step": zeros(batch)},
        {**CONDITIONS, "state": FRAMES, "step": BATCH},
        ("prediction", "kept"),
    )
    last = Graph("motion", LastMap(model), {"sample": features}, {"sample": FRAMES}, ("offsets",))
    visited = list(range(model.steps - model.skip_steps - 1, -1, -1))
    table = []
    for each in visited:
        of_clean, of_noisy, of_noise = model.posterior.shares(each) if each else (1.0, 0.0, 0.0)
        table.append([of_noisy, of_clean, 0.0, 0.0, of_noise])
    parts = [speech, step, last]
    if model.skip_steps:
        noise = {"noise": torch.zeros(batch, frames, space.width)}
        parts.append(Graph("start", DiffuserStart(model, visited[0]), noise, {"noise": FRAMES}, ("state",)))
    results_of(step)  # what follows from the weights alone is computed here, not in the graph
    root = None
    if model.sampling_space == "folded":
        with torch.no_grad():
            root = space.noise(lambda like: like, torch.eye(space.width))
    loop = SamplingLoop(
        state=space.width,
        drawn=space.width,
        kept=dim,
        sampler="ddpm",
        steps=visited,
        table=table,
        last_step=-1,
        decoded="kept",
        noise=root,
        noise_of="seed",
    )
    return whole_model(model, parts, loop)


# DiffSpeaker.


class SpeakerStep(nn.Module):
    """Noisy motion to clean motion at one step.

    In the folded space, the result is a sum of maps of what the network gave, of a bias and of the first noise, each
    with a factor that the sampler makes. So a frame of the state is: noisy motion as the network sees it, the sum of
    the network's features, the bias's factor, the first noise's factor.
    """

    def __init__(self, model: DiffSpeaker) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        features: Float[Tensor, "batch frames dim"],
        identity: Int[Tensor, " batch"],
        state: Float[Tensor, "batch frames state"],
        step: Int[Tensor, " batch"],
    ) -> tuple[Tensor, Tensor]:
        """The prediction, and the features that it is made of."""
        model, network, space = self.model, self.model.network, self.model.space()
        conditions = network.conditions(features, model.weights_of(identity), None)
        made = network(space.mapped(state[..., : space.width]), step, conditions)
        if model.sampling_space == "vertices":
            return space.clean(made), made
        ones = torch.ones_like(made[..., :1])
        return torch.cat([space.clean(made), made, ones, torch.zeros_like(ones)], -1), made


class SpeakerStart(nn.Module):
    """Unit noise on the vertices to the folded state that sampling starts from."""

    def __init__(self, model: DiffSpeaker) -> None:
        super().__init__()
        self.model = model

    def forward(self, noise: Float[Tensor, "batch frames coordinates"]) -> Float[Tensor, "batch frames state"]:
        """Noise alone: of features and bias there is nothing yet."""
        state = self.model.space().of(noise)
        ones = torch.ones_like(state[..., :1])
        return torch.cat([state, torch.zeros_like(state), torch.zeros_like(ones), ones], -1)


class SpeakerMotion(nn.Module):
    """The end of sampling to offsets from the template, smoothed where the model does so."""

    def __init__(self, model: DiffSpeaker) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        sample: Float[Tensor, "batch frames state"],
        noise: Float[Tensor, "batch frames coordinates"] | None = None,
    ) -> Float[Tensor, "batch frames vertices 3"]:
        """In the unit of the corpus; ``noise`` is what sampling started from, if anything is left of it."""
        model, last = self.model, self.model.network.motion_out
        made = sample
        if model.sampling_space == "folded":
            features = sample[..., model.dim : -2]
            made = nn.functional.linear(features, last.weight) + sample[..., -2:-1] * last.bias
            made = made if noise is None else made + sample[..., -1:] * noise
        motion = made.view(*made.shape[:2], model.n_vertices, 3) / model.scale
        return smoothed_whole(motion) if model.smooth else motion


def smoothed_whole(motion: Float[Tensor, "batch frames vertices 3"]) -> Float[Tensor, "batch frames vertices 3"]:
    """As :func:`facediff.models.published.diffspeaker.smoothed`, of clips without padding and of any length."""
    places, last = torch.arange(motion.shape[1]), motion.shape[1] - 1
    before, after = motion[:, (places - 1).clamp_min(0)], motion[:, (places + 1).clamp_max(last)]
    inner = ((places > 0) & (places < last))[:, None, None]
    return torch.where(inner, (before + motion + after) / 3, motion)


def diffspeaker_graphs(model: DiffSpeaker) -> Graphs:
    """DiffSpeaker with its present scheduler; its noise is drawn once, on the vertices."""
    speech = heard_graph(model, 1)
    features = results_of(speech)
    batch, frames, dim = features.shape
    folded, coordinates = model.sampling_space == "folded", 3 * model.n_vertices
    width = 2 * dim + 2 if folded else coordinates
    given = conditions_of(features, model)
    del given["template"]
    state, noise = torch.zeros(batch, frames, width), torch.zeros(batch, frames, coordinates)
    step = Graph(
        "step",
        SpeakerStep(model),
        {**given, "state": state, "step": zeros(batch)},
        {**{name: CONDITIONS[name] for name in given}, "state": FRAMES, "step": BATCH},
        ("prediction", "kept"),
    )
    steps = step_shares(model.signal, model.sampling_steps, model.scheduler)
    last = {"sample": state}
    if folded and all(of_noisy for _, _, of_noisy in steps):
        last["noise"] = noise
    parts = [speech, step, Graph("motion", SpeakerMotion(model), last, dict.fromkeys(last, FRAMES), ("offsets",))]
    if folded:
        parts.append(Graph("start", SpeakerStart(model), {"noise": noise}, {"noise": FRAMES}, ("state",)))
    results_of(step)  # what follows from the weights alone is computed here, not in the graph
    loop = SamplingLoop(
        state=width,
        drawn=coordinates,
        kept=dim,
        sampler=f"{model.scheduler} DDIM" if model.scheduler == "published" else "ddim",
        steps=[number for number, _, _ in steps],
        table=[[of_noisy, of_clean, 0.0, 0.0, 0.0] for _, of_clean, of_noisy in steps],
        last_step=-1,
        decoded="sample",
        noise=None,
        noise_of="seed",
    )
    return whole_model(model, parts, loop)


# What both have.


CONDITIONS: dict[str, Axes] = {"features": FRAMES, "identity": BATCH, "template": BATCH}


def zeros(batch: int) -> Int[Tensor, " batch"]:
    """Indices."""
    return torch.zeros(batch, dtype=torch.long)


def conditions_of(features: Tensor, model: PublishedModel) -> dict[str, Tensor]:
    """Example values of what every step is given."""
    batch = features.shape[0]
    return {"features": features, "identity": zeros(batch), "template": torch.zeros(batch, model.n_vertices, 3)}


def heard_graph(model: FaceDiffuser | DiffSpeaker, steps: int) -> Graph:
    """Speech in the network's width, of so many steps of the audio encoder a frame."""

    def hear(heard: Speech, frames: Int[Tensor, " batch"], _: int) -> Tensor:
        made: Tensor = model.network.audio_map(model.hear(heard, frames))
        return made

    return speech_graph(model, hear, lambda frames: steps * frames)
