"""The training and sampling recipe around the paper's method: every rule here is ours, with the figures in the manual.

Where the training steps lie (:func:`log_snr_weights`), how loud the noise is (:func:`noise_scale_for`), how a small
number of sampling steps ends (:func:`last_noise_for`, :func:`spread_for`), and which style an identity has without a
reference. docs/generation.md shows what each is worth; docs/method.md lists the options.
"""

from __future__ import annotations

import math
from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils.data import DataLoader

from facediff import registry
from facediff.data import Batch, Reference, SpeechMotionDataModule, collate
from facediff.errors import ArgumentError, FaceDiffError
from facediff.models.base import AnimationModel
from facediff.models.dual_path.conditioning import Conditions
from facediff.models.dual_path.network import DualPathNetwork
from facediff.models.dual_path.options import DualPathOptions, NumericScale
from facediff.models.inference import Expressivity, Style
from facediff.models.invented_speakers import InventedSpeakers
from facediff.models.mesh_encoders import ComponentMeshEncoder
from facediff.models.motion_space import ComponentMotion, MotionSpace, Projection
from facediff.models.samplers import NoiseProcess, Sampler
from facediff.speech.windows import LOW_LATENCY_AHEAD, LOW_LATENCY_STEPS
from facediff.utils import ranges
from facediff.utils.hints import check_number, defaults, mismatch

NOISE_SCALE_KEY = "facediff_noise_scale"
PRINCIPAL = 64
"""Components by which the noise scale is measured."""


def log_snr_weights(process: NoiseProcess, hidden: Float[Tensor, " steps"]) -> Float[Tensor, " steps"]:
    """Probabilities of the steps that spread a training over the levels of noise at which motion is decided.

    Where neighbouring frames tell a noisy one, speech is needed in the noisiest few per cent of the steps alone,
    and there a sampler takes half of its steps. Of the draws, 85 % are uniform in ln SNR, from where noise leaves
    a two-hundredth of the motion open to where it leaves 70 %; the others are uniform over all steps.
    """
    signal = process.signal.cpu().double()
    level = (signal / (1 - signal)).log()
    # A step stands for the levels up to half way to its neighbours.
    middle = (level[:-1] + level[1:]) / 2
    borders = torch.cat([level[:1], middle, level[-1:]])
    first, last = (int((hidden < share).sum()) for share in SPREAD)
    top, bottom = level[min(first, process.steps - 1)], level[min(last, process.steps - 1)]
    width = (borders[:-1].clamp(bottom, top) - borders[1:].clamp(bottom, top)).clamp_min(0)
    even = torch.full_like(width, 1 / process.steps)
    total = width.sum()
    return (even if total == 0 else 0.85 * width / total + 0.15 * even).float()


SPREAD = (0.005, 0.7)
"""Shares of the motion that noise leaves open, between which training steps are uniform in ln SNR."""


def noise_scale_for(
    variances: Float[Tensor, " components"], importance: Float[Tensor, " components"] | None = None
) -> float:
    """The scale at which half of the motion's variance shows through the noise of the schedule's middle.

    Where ᾱ = ½, a principal component of variance λ that is noised at the scale b shows the share b²λ / (b²λ + 1) of
    its variance in a single frame. With less hidden, a model learns to read its input and not the speech.

    Args:
        variances: of the principal components, as they are noised at the scale 1.
        importance: what each contributes to the variance of the motion; ``variances`` if None.
    """
    variances = variances.double()
    weights = variances if importance is None else importance.double()
    shares = weights / weights.sum()
    # Bisection, since the share is monotonous in b but has no inverse in closed form for several components.
    low, high = -60.0, 60.0  # of ln b²; the share that shows rises with it
    for _ in range(100):
        middle = (low + high) / 2
        signal = math.exp(middle) * variances
        low, high = (middle, high) if float((shares * signal / (signal + 1)).sum()) < 0.5 else (low, middle)
    return math.exp(middle / 2)


MANY_STEPS = 10
"""So many steps go to the last noise in every model: the rules below are from sweeps up to it."""


def last_noise_for(first_noise: float, last_noise: float, share: float) -> float:
    """The noise at which a path of fewer steps ends best.

    A step at little noise adds details of a sample, and only where the steps before it have got near: two
    steps, one at full noise and one at the last noise of ten, give the mean motion with a leak of noise.
    The path in ln SNR is shortened by the square root of the share of steps, near the best ends of sweeps with two to
    five steps, around which scores are flat; docs/generation.md has figures.

    Args:
        first_noise: from which steps are spread evenly in ln SNR.
        last_noise: at which the usual number of steps ends.
        share: of the steps that go to the last noise.

    >>> [round(last_noise_for(2000.0, 10.0, steps / 10)) for steps in (2, 3, 5, 10, 20)]
    [187, 110, 47, 10, 10]
    """
    if share >= 1:
        return last_noise
    return float(first_noise * (last_noise / first_noise) ** math.sqrt(max(0.0, share)))


def spread_for(first_noise: float, last_noise: float, share: float) -> float:
    """The :attr:`Sampler.spread` that lets few steps vary as much as the usual number.

    A path that ends at more noise shows less of the variance that the conditions leave open: by 1 + 8 (noise − usual
    noise) / first noise, within 8 % of a sweep with two to eight steps of the bundled model (docs/generation.md). The
    factor is the root of it, since it counts twice.

    >>> [round(spread_for(2000.0, 10.0, steps / 10), 2) for steps in (2, 3, 5, 10, 20)]
    [1.31, 1.18, 1.07, 1.0, 1.0]
    """
    return math.sqrt(1 + 8 * (last_noise_for(first_noise, last_noise, share) - last_noise) / first_noise)


class DualPathRecipe(AnimationModel):
    """Measurements before a dual-path training, conditions that are hidden in it, and the settings of sampling."""

    low_latency_steps = LOW_LATENCY_STEPS
    network: DualPathNetwork
    options: DualPathOptions
    motion_space: MotionSpace
    process: NoiseProcess
    sampler: Sampler
    invented_speakers: InventedSpeakers | None
    _trained_steps: int  # of the sampler that the model was made with
    _sampler_options: dict[str, Any] | None = None  # of the sampler chosen since; None for the model's own
    _step_weights: Tensor | None = None  # follow from the motion space, known when training begins

    def conditions(self, batch: Batch, animated: slice | Tensor = slice(None)) -> Conditions:
        """Everything that is computed once per clip; in training, identity and style are hidden now and then.

        Args:
            batch: the clips.
            animated: the frames that are animated, of speech that is encoded with more around them.
        """
        identity, style = self.hide(len(batch)) if self.training else (None, None)
        # Index −1 stands for an unseen speaker. Clips that are shown under it teach the model to take the person from
        # the style alone.
        identities = batch.identity if identity is None else batch.identity.masked_fill(identity, -1)
        return self.network.conditions(batch, identities, self.style_of(batch), style, animated)

    def hide(self, clips: int) -> list[Bool[Tensor, " batch"] | None]:
        """Which training clips have a hidden identity, and which a hidden style; None if no clip does."""
        shares = (self.options.identity_dropout, self.options.style_dropout)
        return [torch.rand(clips, device=self.device) < share if share else None for share in shares]

    def step_weights(self) -> Float[Tensor, " steps"] | None:
        """Probabilities of the training steps; None where they are uniform, as in the paper."""
        scales, weights = self.motion_space.preconditioning, self._step_weights
        if self.options.timestep_sampling == "uniform" or scales is None:
            return None
        if weights is None or not self.training:
            weights = log_snr_weights(self.process, scales.hidden().cpu()).to(self.device)
            # Not from validation: weight averages are swapped in there, with tables that may not be known yet.
            self._step_weights = weights if self.training else None
        return weights

    def scaled(self, motion: Tensor) -> Tensor:
        """Offsets in the network's unit and precision; components of training motion are in that unit already."""
        return motion if motion.dim() == 3 else motion.to(self.dtype) * self.scale

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """Also measure how much of the training motion noise hides."""
        shapes = super().measure(data, PRINCIPAL if self.options.noise_scale == "auto" else at_least)
        space, covariance = self.motion_space, None
        if space.prior_frames > 1 and isinstance(space, ComponentMotion):
            project = space.components.projection(float(self.scale))
            covariance = data.covariance_over_time(project, space.prior_frames)
        if self.options.noise_scale == "auto" and shapes is not None:
            # Shapes are as long as their standard deviations, so their squared lengths are the components' variances.
            variances = shapes[:PRINCIPAL].square().sum(1)
            noised = space.noised_variances(variances)
            if covariance is not None and isinstance(space, ComponentMotion):
                # Neighbouring frames reveal part of a noisy frame.
                noised, variances = space.modes(covariance)
            self.rescale_noise(noise_scale_for(noised, variances))
        space.fit(self.process.signal, covariance)
        if (token := self.network.template_token) is not None:
            faces = self.assets.templates
            token.measure(torch.stack([faces[identity] for identity in self.identities if identity in faces]))
        return shapes

    def scale_like(self, reference_model: DualPathRecipe, data: SpeechMotionDataModule) -> None:
        """Give the largest movement the size that it has in another face's model.

        Unit variance of a coordinate says little: 60 weights are smaller as a whole than the coordinates of 6 000
        vertices by a factor of 20, and the same noise would hide another share of them.
        """
        space, reference = self.motion_space, reference_model.motion_space
        scale = self.assets.motion_scale
        if scale is None or not isinstance(space, ComponentMotion) or not isinstance(reference, ComponentMotion):
            return
        ratio = float(reference.components.deviations[0] / space.components.deviations[0])
        self.adopt(self.assets.with_motion_scale(scale * ratio))
        self.measure(data)

    def motion_weights(self, data: SpeechMotionDataModule) -> Float[Tensor, "points dims"]:
        """The motion space's weights of regions, of those that the corpus lists."""
        weighted = self.weighted_assets
        weights, regions = super().motion_weights(data), dict(weighted.regions)
        if not weighted.space.is_vertices:
            regions["eyelids"] = torch.tensor(weighted.space.region("eyes"), dtype=torch.long)
        elif "eyelids" in self.motion_space.region_weights and (pairs := data.eyelid_pairs()) is not None:
            regions["eyelids"] = pairs.flatten()
        # The last of them counts where regions overlap: eyelids lie in the upper face.
        for region, weight in self.motion_space.region_weights.items():
            if region in regions:
                weights[regions[region]] = weight
        return weights

    def training_projection(self) -> Projection | None:
        """Principal components, where no part of the model needs the vertices.

        Otherwise a batch of 8 clips of 6 000 vertices is read, padded, scaled and projected twice: 0.3 s of a step of
        0.8 s on one processor.
        """
        modules = [part for part in (self.motion_space, self.network.mesh_encoder) if part is not None]
        components = [part.components for part in modules if isinstance(part, ComponentMotion | ComponentMeshEncoder)]
        if self.invented_speakers is not None or len(components) < len(modules):
            return None
        return max(components, key=lambda module: module.count).projection(self.scale)

    def rescale_noise(self, scale: float) -> None:
        """Noise motion at another scale from now on."""
        self.process = NoiseProcess(self.process.steps, self.process.schedule, scale)
        options = self._sampler_options
        options = self.hparams["sampler"]["init_args"] if options is None else options
        self.sampler = type(self.sampler)(process=self.process, **options)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the measured noise scale."""
        super().on_save_checkpoint(checkpoint)
        checkpoint[NOISE_SCALE_KEY] = self.process.scale

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the noise scale from the checkpoint."""
        super().on_load_checkpoint(checkpoint)
        if self.options.noise_scale == "auto":
            scale = checkpoint.get(NOISE_SCALE_KEY, 1.0)
            if mismatch(NumericScale, scale) is not None:
                raise FaceDiffError(f"its {NOISE_SCALE_KEY} is {str(scale)[:40]}; the file is damaged")
            self.rescale_noise(float(scale))

    def choose_sampler(self, name: str | None = None, steps: int | None = None) -> None:
        """Sample in another way from now on; checkpoints keep the sampler that the model was made with.

        A sampler chosen by name keeps the spacing and the last noise that the model was made with, where as many steps
        have that much noise; its other options are its own. Where both ends of the path are set, as ``first_noise``
        and ``last_noise``, fewer steps end at more noise (:func:`last_noise_for`), and
        their samples are taken further from the mean (:func:`spread_for`).
        """
        sampler = registry.sampler.get(name) if name is not None else type(self.sampler)
        trained: dict[str, Any] = self.hparams["sampler"]["init_args"]
        options = dict(trained if self._sampler_options is None else self._sampler_options)
        if name is not None:
            shared = {"spacing", "last_noise", "first_noise"} & trained.keys() & defaults(sampler).keys()
            options = {key: trained[key] for key in sorted(shared)}
        options |= {} if steps is None else {"steps": steps}
        count = options.get("steps", defaults(sampler).get("steps"))
        if count is not None and options.get("first_noise") and options.get("last_noise"):
            share = count / min(self._trained_steps, MANY_STEPS)
            options["last_noise"] = last_noise_for(trained["first_noise"], trained["last_noise"], share)
            if "spread" in defaults(sampler) and self.motion_space.preconditioning is not None:
                spread = spread_for(trained["first_noise"], trained["last_noise"], share)
                options["spread"] = min(2.0, spread * trained.get("spread", 1.0))
        try:
            self.sampler = sampler(process=self.process, **options)
        except ArgumentError:
            if name is None:
                raise
            # A thousand steps of ddpm go to the clean end: fewer of the process have the last noise of ten.
            options = {} if steps is None else {"steps": steps}
            self.sampler = sampler(process=self.process, **options)
        self._sampler_options = options

    def choose_low_latency(self) -> None:
        """Frame by frame, and in :attr:`low_latency_steps` denoising steps of the present sampler at most."""
        self.windows = LOW_LATENCY_AHEAD
        self.choose_sampler(steps=min(self.low_latency_steps, self.sampler.steps))

    def choose_expressivity(self, expressivity: Expressivity) -> None:
        """Go from the mean prediction (0) to a sample (1) or beyond; checkpoints keep the original value."""
        # One number for each vertex lets the lips follow the mean while the brows are sampled.
        numbers = expressivity.flatten().tolist() if isinstance(expressivity, Tensor) else [expressivity]
        if isinstance(expressivity, Tensor) and expressivity.shape != (self.n_vertices,):
            raise FaceDiffError(
                f"expressivity: has the shape {tuple(expressivity.shape)}; expected one number, or one for each of "
                f"{self.n_vertices} vertices"
            )
        for number in numbers:
            check_number("expressivity", "a number", number, ranges.EXPRESSIVITY.least, ranges.EXPRESSIVITY.most)
        self.expressivity = expressivity

    def default_style(self, identity: str) -> Reference | Style:
        """The style predicted from the speech, by a model that was trained to.

        A stored reference would carry its mood into all speech. With ``style_from_speech``, the usual style of an
        identity of the training, or else the style of its reference, is changed as the speech asks; with
        ``style_dropout`` alone, the model knows the motion of an identity of the training without a reference.
        """
        no_style, speech_style = self.network.no_style, self.network.speech_style
        if speech_style is not None and speech_style.ready and identity not in self.person_styles:
            index = self.assets.identity_index(identity)
            if index >= 0 and (mean := speech_style.usual(index)) is not None:
                return Style(identity, torch.cat([mean, mean.new_ones(1)]).cpu())
            reference = cast(Reference, super().default_style(identity))  # all other styles are of person_styles
            motion = reference.motion.float()[None].to(self.device)
            with torch.no_grad():
                vector = self.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=self.device))
            return Style(reference.clip, torch.cat([vector[0, :-1], vector.new_ones(1)]).cpu())
        if no_style is None or identity not in self.assets.identities or identity in self.person_styles:
            return super().default_style(identity)
        return Style(identity, nn.functional.pad(no_style.detach(), (0, self.network.style_dim - len(no_style))).cpu())

    @torch.no_grad()
    def fit_to_features(self, data: SpeechMotionDataModule) -> dict[str, Tensor]:
        """Fit the style from speech again, to each training clip's own style.

        Training gathers it on the way, from encoders that still change and styles of other clips in the same mood. As
        there, a style counts by its distance from the mean of its identity's clips so far, itself included: in one pass
        over n clips of an identity, the changes are too small by H_n / n of them on average, H_n = 1 + 1/2 + … + 1/n.
        """
        network, speech_style = self.eval().network, self.network.speech_style
        if speech_style is None:
            return {}
        speech_style.forget()
        for batch in DataLoader(data.dataset("train"), batch_size=8, collate_fn=collate):
            batch = batch.to(self.device)
            features = network.audio_encoder(batch.audio, batch.audio_lengths, batch.frame_lengths)
            style = network.dynamic_style(self.scaled(batch.motion), batch.mask)
            speech_style.update(features, batch.mask, style, batch.identity, memory=1.0)
        return {f"network.speech_style.{name}": sums.clone() for name, sums in speech_style.named_buffers()}
