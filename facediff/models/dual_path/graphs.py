"""A dual-path model as graphs: audio encoder, one denoising step, last map; see :mod:`facediff.models.graphs`."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from facediff.errors import FaceDiffError
from facediff.models.dual_path.conditioning import Conditions
from facediff.models.dual_path.generation import Generation
from facediff.models.folding import unchanged
from facediff.models.graphs import (
    BATCH,
    FRAMES,
    Graph,
    Graphs,
    ModelPart,
    SamplingLoop,
    results_of,
    speech_graph,
    style_graphs,
    update_table,
)
from facediff.registry import name_of


class StepGraph(ModelPart[Generation]):
    """Noisy motion to clean motion at one step, under speech, identity and style."""

    def forward(
        self,
        features: Float[Tensor, "batch frames dim"],
        mask: Bool[Tensor, "batch frames"],
        identity: Int[Tensor, " batch"],
        style: Float[Tensor, "batch style_dim"],
        state: Float[Tensor, "batch frames state"],
        step: Int[Tensor, " batch"],
        before: Float[Tensor, "batch frames kept"],
        share: Float[Tensor, "batch frames"],
    ) -> tuple[Tensor, Tensor]:
        """The prediction, and the features that the next window of long speech takes as ``before``.

        Args:
            features: of the speech.
            mask: True on valid frames.
            identity: indices, −1 for unknown.
            style: style vectors.
            state: the noisy motion.
            step: counted from 0.
            before: features of the window before, in the frames that this one shares with it.
            share: of this window in each frame, 1 where nothing is shared.
        """
        network, joined = self.model.network, list[Tensor]()
        dynamic = network.style_from_speech(style, features, mask)
        tokens = network.style_tokens(torch.cat([network.identity_encoder(identity), dynamic], dim=-1))

        # Two windows of long speech are joined within the denoising step, so that both go on from one motion. The graph
        # hands out the joined features, since the next window's graph runs later and elsewhere.
        def blend(latest: Tensor) -> Tensor:
            joined.append(torch.lerp(before, latest, share[..., None]))
            return joined[0]

        denoiser = self.model.denoiser(Conditions(features, tokens, mask), blend)
        return denoiser.denoise(state, step), joined[0]


class SampleGraph(ModelPart[Generation]):
    """The end of sampling to offsets from the template."""

    def __init__(self, model: Generation, decoded: Literal["sample", "kept"]) -> None:
        super().__init__(model)
        self.decoded = decoded

    def forward(self, sample: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames points dims"]:
        """In the unit of the corpus."""
        model = self.model
        scaled = model.network.clean_motion(sample) if self.decoded == "kept" else sample
        return model.motion_space.decode(scaled) / model.scale


def graphs_of(model: Generation) -> Graphs:
    """A dual-path model with its present sampler as graphs and numbers."""
    if model.network.template_token is not None:
        raise FaceDiffError("template_token: a model that sees the neutral face cannot be exported; train one without")
    network, sampler = model.network, model.sampler
    with model.choosing():
        model.choose_low_latency()
        quick = model.sampler
    preconditioned = model.motion_space.preconditioning is not None
    folded = model.folds  # such a sampler goes on in the network's width
    # Example sizes: neither is 1, which the exporter would take for a constant instead of a size that may change.
    batch, frames, width = 2, 50, network.coordinates
    dim = network.embed.out_features
    state = dim if folded else width
    handover = width if preconditioned else dim
    encoder = network.audio_encoder
    speech = speech_graph(model, lambda batch, frames, _: encoder(batch.audio, batch.audio_lengths, frames))
    style = network.style_dim
    mask = torch.ones(batch, frames, dtype=torch.bool)
    step = Graph(
        "step",
        StepGraph(model),
        {
            "features": torch.zeros(batch, frames, dim),
            "mask": mask,
            "identity": torch.zeros(batch, dtype=torch.long),
            "style": torch.ones(batch, style),  # the last asks for what the speech says, so that its map is made
            "state": torch.zeros(batch, frames, state),
            "step": torch.zeros(batch, dtype=torch.long),
            "before": torch.zeros(batch, frames, handover),
            "share": torch.ones(batch, frames),
        },
        {
            **dict.fromkeys(("features", "mask", "state", "before", "share"), FRAMES),
            **dict.fromkeys(("identity", "style", "step"), BATCH),
        },
        ("prediction", "kept"),
    )
    results_of(step)  # what follows from the weights alone is computed here, not in the graph
    root = None
    with torch.no_grad():
        if folded:  # else noise is used as it is, and the unit matrix of all coordinates would take gigabytes
            nothing = Conditions(step.inputs["features"], step.inputs["features"][:, :1], mask)
            root = model.denoiser(nothing, unchanged).noise(torch.eye(state)[None])[0]
    decoded: Literal["sample", "kept"] = "kept" if folded else "sample"
    last = Graph(
        "motion",
        SampleGraph(model, decoded),
        {"sample": torch.zeros(batch, frames, handover if folded else state)},
        {"sample": FRAMES},
        ("offsets",),
    )
    return Graphs(
        parts=[speech, step, last, *style_graphs(model, style)],
        equal_lengths=not (encoder.takes_padding and network.decoder.graph_takes_padding),
        blending="steps",
        clock=model.clock,
        style="reference",
        sampling=SamplingLoop(
            state=state,
            drawn=state,
            kept=handover,
            sampler=name_of(type(sampler)),
            steps=list(sampler.timesteps),
            table=update_table(sampler),
            last_step=model.process.steps - 1,
            decoded=decoded,
            noise=root,
            noise_of="clip",
            quick_steps=list(quick.timesteps),
            quick_table=update_table(quick),
        ),
    )
