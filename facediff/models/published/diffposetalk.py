"""DiffPoseTalk: windows of FLAME's parameters by diffusion, in the style of a clip.

Sun et al.: "DiffPoseTalk: Speech-Driven Stylistic 3D Facial Animation and Head Pose Generation via Diffusion Models",
2024.

Diffusion over windows of FLAME's parameters, each of which continues the one before it; the style comes from a clip.
From top to bottom: the model, training, sampling, the authors' files. The network and the process stand in
``diffposetalk_network.py``; docs/methods.md lists the options for choices of the published code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.errors import OptionError, check_known
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.inference import BatchMotion, Progress
from facediff.models.layers import Heads, Layers, Share, Width, check_heads
from facediff.models.published.cards import AuthorFiles, Facts
from facediff.models.published.clip_style import read_table, style_contrast
from facediff.models.published.diffposetalk_network import (
    Condition,
    CosineProcess,
    Guidance,
    PoseDenoiser,
    Threshold,
    clamped,
    guided,
)
from facediff.models.published.diffusion import PosteriorSampler, seeded_noise
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.parametric import ParametricModel, statistics_of, window_at
from facediff.models.samplers import NoiseSource
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.spaces.layouts import layout
from facediff.utils import SAMPLE_RATE
from facediff.utils.arrays import open_array, read_arrays
from facediff.utils.hints import check_number
from facediff.utils.limits import FRAME_RATES, quoted
from facediff.utils.ranges import Range

WEIGHTS = {"velocity": 5.0, "smoothness": 0.5, "head": 0.05, "head_velocity": 5.0, "style": 0.1}
"""Of the squared errors of first differences, of the head once more and of its first differences; of the prediction's
squared second differences; and of the contrast of styles (NT-Xent), from which alone the style encoder learns."""


@registry.model.register("DiffPoseTalk")
class DiffPoseTalk(ParametricModel):
    """DiffPoseTalk: diffusion of expression and head pose in windows, with the style of a clip.

    Args:
        dim: channels of the Transformer.
        num_layers: its layers.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers; four times ``dim`` if None.
        dropout: in both Transformers, in training.
        window_frames: frames that are generated in one pass.
        context: frames before it that the network sees.
        diffusion_steps: noising steps, all of which sampling takes.
        head: generate the head's rotation; else the head stays at rest.
        shape_dim: coefficients of a person's shape that the network is conditioned on; 0 for none.
        conditions: what training drops and sampling may be guided by, ``audio`` before ``style``.
        guidance: how guided predictions are combined: ``incremental``, or ``independent``.
        audio_scale: scale of the guidance by speech.
        style_scale: scale of the guidance by style.
        options: see :class:`~facediff.models.published.parametric.ParametricModel`.

    Attributes:
        threshold: clamp every prediction to this quantile of its magnitudes, itself between the second and the third
            number; not at all if None.
        speech_context: encode the speech of all windows in one pass; else of each window by itself.
    """

    threshold: Threshold | None = None
    speech_context: bool = True
    samples: ClassVar[bool] = True
    encodes_whole_clips: ClassVar[bool] = False  # but windows that are cut anew in each step
    chosen: ClassVar[tuple[str, ...]] = (*ParametricModel.chosen, "scales", "guiding")
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        Wav2Vec2Encoder, source="facebook/hubert-base-ls960", frozen_layers=2, edges=False
    )

    def __init__(
        self,
        *,
        dim: Width = 512,
        num_layers: Layers = 8,
        num_heads: Heads = 8,
        feed_forward_dim: Width | None = None,
        dropout: Share = 0.1,
        window_frames: Annotated[int, Range(2, 10_000)] = 100,
        context: Annotated[int, Range(1, 10_000)] = 10,
        diffusion_steps: Annotated[int, Range(1, 10_000)] = 500,
        head: bool = True,
        shape_dim: Annotated[int, Range(0, 1000)] = 0,
        conditions: Sequence[Condition] = ("audio", "style"),
        guidance: Guidance = "incremental",
        audio_scale: Annotated[float, Range(0, 100)] = 1.15,
        style_scale: Annotated[float, Range(0, 100)] = 3.0,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(shape_dim=shape_dim, head=head, **options)
        check_heads(dim=dim, num_heads=num_heads, even=True)
        self.window_frames, self.context = window_frames, context
        self.guiding: tuple[Condition, ...] = tuple(name for name in ("audio", "style") if name in conditions)
        self.guidance: Guidance = guidance
        self.scales: dict[str, float] = {"audio": audio_scale, "style": style_scale}
        channels = len(self.modelled)
        self.audio_map = nn.Linear(self.audio_width, dim)
        self.start_audio = nn.Parameter(torch.randn(1, context, dim))
        self.start_motion = nn.Parameter(torch.randn(1, context, channels))
        self.no_audio = nn.Parameter(torch.randn(1, 1, dim))
        self.no_style = nn.Parameter(torch.randn(1, 1, self.style_dim))
        self.style_encoder = self.make_style_encoder(dropout=dropout)
        self.process = CosineProcess(diffusion_steps)
        self.network = PoseDenoiser(
            channels=channels,
            person_dim=shape_dim + self.style_dim,
            dim=dim,
            num_layers=num_layers,
            num_heads=num_heads,
            feed_forward_dim=feed_forward_dim or 4 * dim,
            window=window_frames,
            context=context,
            steps=diffusion_steps,
            dropout=dropout,
        )

    @classmethod
    def author_facts(cls, files: AuthorFiles, options: ImportOptions) -> Facts:
        """Speakers by their shapes, and the statistics of the training motion."""
        return faces_of(files, options)

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """Sizes, statistics, and options of training from the files."""
        stated, style_dim = files.arguments.get("start_motion_feat", {}), files.size("null_style_feat", 2)
        if str(stated.get("target", "sample")) != "sample" or str(stated.get("pad_mode", "zero")) != "zero":
            raise OptionError.naming(
                f"{files.source}: predicts {stated.get('target')} from speech filled up by {stated.get('pad_mode')}; "
                f"expected a model of clean motion (sample, zero)"
            )
        first = next((name for name in files.tensors if name.endswith("motion_proj.weight")), "")
        context = files.size("start_motion_feat", 1)
        options: dict[str, Any] = {
            "style_layers": files.count(first.replace("motion_proj.weight", "transformer.layers.")),
            "style_rows": read_table(files, "PE.pe", style_dim),
            "window_frames": files.size("denoising_net.PE", 1) - context - 1,
            "diffusion_steps": files.size("diffusion_sched.alphas", 0) - 1,
            "head": files.size("start_motion_feat", 2) >= 54,
            "shape_dim": files.size("denoising_net.person_proj.weight", 1) - style_dim,
        }
        for author_name, option, where in (
            ("n_heads", "num_heads", stated),
            ("n_heads", "style_heads", files.arguments.get(first, {})),
            ("cfg_mode", "guidance", stated),
        ):
            if where.get(author_name) is not None:
                options[option] = where[author_name]
        if isinstance(guiding := stated.get("guiding_conditions"), str):
            options["conditions"] = [name for name in ("audio", "style") if name in guiding.split(",")]
        files.tensors |= facts.details
        return options

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """As every model, without the tables of the noise process, which checkpoints of 1.x hold."""
        for name in ("alphas", "signal", "deviations"):
            checkpoint["state_dict"].pop(f"process.{name}", None)
        super().on_load_checkpoint(checkpoint)

    def has_sampler(self, name: str | None) -> bool:
        """No registered one: its windows are denoised in the authors' way."""
        return False

    def choose_guidance(self, scales: Mapping[str, float]) -> None:
        """Follow speech (``audio``) or ``style`` by other scales."""
        check_known("{guidance}", "condition", scales, self.guiding)
        self.scales = {**self.scales, **scales}

    # The style of a clip.

    def encode_style(
        self, reference: Float[Tensor, "batch frames points dims"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vectors of reference motions, of which as many frames as a window has are used."""
        motion = self.standardised(reference)[:, : self.window_frames]
        style: Tensor = self.style_encoder(motion, mask[:, : self.window_frames])
        return style

    # Training.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Errors of the predicted clean motion of two windows, the second of which continues the first."""
        motion = self.standardised(batch.motion)
        size, frames = self.window_frames, batch.frame_lengths
        style_vector = self.encode_style(batch.reference, batch.reference_mask)
        motion_style: Tensor = self.style_encoder(motion, batch.mask)
        terms = {"style": style_contrast(style_vector, motion_style)}
        features = self.encode_speech(batch, frames)
        first = self._randint(max(1, int(frames.max()) - size + 1), len(batch), generator) % frames.clamp_min(1)
        unheard, unknown = self.dropped(len(batch), generator)
        person = torch.where(unknown[:, None], self.no_style[0], style_vector.detach())
        person = torch.cat([self.shapes_of(batch), person], 1)
        before = (self.start_motion.expand(len(batch), -1, -1), self.start_audio.expand(len(batch), -1, -1))
        errors: list[dict[str, Tensor]] = []
        for number in range(2):
            clean, valid = window_at(motion, frames, first, size)
            speech, _ = window_at(features, frames, first, size)
            if number and not bool(valid.any()):
                break
            silent = torch.where(unheard[:, None, None], self.no_audio, speech)
            step = self._randint(self.process.steps, len(batch), generator)
            noise = torch.randn(clean.shape, device=self.device, generator=generator)
            noisy = self.process.add_noise(clean, noise, step)
            predicted = self.network(noisy, silent, person, before, step + 1, valid.to(clean))
            # The frames before a window are predicted too; those before the first one have no truth.
            past_and_clean = torch.cat([before[0], clean], 1) if number else clean
            loss_mask = F.pad(valid, (self.context, 0), value=True) if number else valid
            loss_mask = loss_mask & valid[:, :1]
            errors.append(
                self._errors(predicted[:, predicted.shape[1] - past_and_clean.shape[1] :], past_and_clean, loss_mask)
            )
            before, first = (clean[:, -self.context :], speech[:, -self.context :]), first + size
        terms |= {name: torch.stack([error[name] for error in errors]).mean() for name in errors[0]}
        terms["loss"] = terms["reconstruction"] + sum(
            (weight * terms[name] for name, weight in WEIGHTS.items()), start=torch.zeros((), device=self.device)
        )
        return terms

    def dropped(self, count: int, generator: torch.Generator | None) -> tuple[Bool[Tensor, " batch"], ...]:
        """From which clips training takes their speech, and from which their style.

        As the authors do: for incremental guidance by both, style from 45 % and speech from 10 % of them, among these;
        for independent guidance half of either; for guidance by one condition, 10 %.
        """
        drop, two_conditions = torch.rand(count, device=self.device, generator=generator), len(self.guiding) == 2
        if two_conditions and self.guidance == "incremental":
            return drop > 0.9, drop > 0.55
        share, second_draw = 0.5 if two_conditions else 0.1, torch.rand(count, device=self.device, generator=generator)
        return drop < share * ("audio" in self.guiding), second_draw < share * ("style" in self.guiding)

    def _randint(self, bound: int, count: int, generator: torch.Generator | None) -> Int[Tensor, " batch"]:
        return torch.randint(0, bound, (count,), device=self.device, generator=generator)

    def _errors(self, predicted: Tensor, clean: Tensor, valid: Bool[Tensor, "batch frames"]) -> dict[str, Tensor]:
        """Mean squared errors over the valid frames."""

        def mean(squares: Tensor, frames: Tensor) -> Tensor:
            return (squares * frames[..., None]).sum() / (frames.sum() * squares.shape[2]).clamp_min(1)

        pairs, triples = valid[:, 1:], valid[:, 2:]
        error = predicted - clean
        moved, bent = error.diff(dim=1), predicted.diff(dim=1).diff(dim=1)
        head = list(self.head_places)
        return {
            "reconstruction": mean(error.square(), valid),
            "velocity": mean(moved.square(), pairs),
            "smoothness": mean(bent.square(), triples),
            "head": mean(error[..., head].square(), valid),
            "head_velocity": mean(moved[..., head].square(), pairs),
        }

    # Speech.

    def encode_speech(self, batch: Batch, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames dim"]:
        """Speech of each clip's frames."""
        rows = [
            self.encode_wave(self.standard_speech(batch.audio[i, : int(batch.audio_lengths[i])]), int(frames[i]))
            for i in range(len(batch))
        ]
        return nn.utils.rnn.pad_sequence(rows, batch_first=True)

    @staticmethod
    def standard_speech(audio: Float[Tensor, " samples"]) -> Float[Tensor, " samples"]:
        """(x − mean)/(s + 1e-5) with the unbiased deviation s of the whole file, which is 0 of one sample."""
        return (audio - audio.mean()) / (audio.std(correction=min(1, len(audio) - 1)) + 1e-5)

    def encode_wave(self, wave: Float[Tensor, " samples"], frames: int) -> Float[Tensor, "frames dim"]:
        """Speech of so many frames that ``wave``, standardised already, lasts for."""
        encoder = self.audio_encoder
        if isinstance(encoder, Wav2Vec2Encoder):
            hidden = encoder.hidden_of(fitted(wave)[None], 2 * frames, max_steps=4 * frames)
            hidden = F.interpolate(hidden.transpose(1, 2), size=frames, mode="linear").transpose(1, 2)
        else:
            lengths = torch.tensor([len(wave)], device=wave.device)
            hidden = encoder.at_steps(wave[None], lengths, torch.tensor([frames], device=wave.device), "hidden")
        mapped: Tensor = self.audio_map(hidden)
        return mapped[0]

    # Sampling.

    def frames_of(self, samples: int) -> int:
        """Whole frames."""
        return int(samples / SAMPLE_RATE * self.frame_rate)

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """Windows one after the other; a clip's noise depends on its seed alone."""
        unstyled = isinstance(batch.style, Tensor) and not batch.style.shape[1]
        style, shapes = None if unstyled else self.style_of(batch), self.shapes_of(batch)
        rows = []
        for i, seed in enumerate(seeds):
            audio = batch.audio[i, : int(batch.audio_lengths[i])]
            draw = seeded_noise([self.window_frames], [seed], self.device)
            motion = self.sample(audio, shapes[i : i + 1], None if style is None else style[i : i + 1], draw, progress)
            rows.append(self.absolute(motion))
        motion = nn.utils.rnn.pad_sequence(rows, batch_first=True)
        return F.pad(motion, (0, 0, 0, 0, 0, max(0, int(frames.max()) - motion.shape[1])))[:, : int(frames.max())]

    def sample(
        self,
        audio: Float[Tensor, " samples"],
        shape: Float[Tensor, "1 shape_dim"],
        style: Float[Tensor, "1 style_dim"] | None,
        draw: NoiseSource,
        progress: Progress | None = None,
    ) -> Float[Tensor, "frames channels"]:
        """The reverse process of all windows of a recording.

        Args:
            audio: speech at 16 kHz.
            shape: standardised coefficients of the person's shape.
            style: as :meth:`encode_style` gives it; None for no style.
            draw: noise in the order in which the published code draws it: the start, which all windows share, then one
                for every step of every window but its last.
            progress: wraps the iteration over windows.

        Returns:
            standardised motion of the channels that the network generates.
        """
        size, unit = self.window_frames, SAMPLE_RATE / self.frame_rate
        audio = self.standard_speech(audio)
        windows = max(1, math.ceil(self.frames_of(len(audio)) / size))
        padding = round(unit * size) * windows - len(audio)
        if padding > 0:
            audio = F.pad(audio, (0, padding))
        filled = max(0, math.ceil(padding / unit))
        features = self.encode_wave(audio, size * windows) if self.speech_context else None
        start = draw(audio.new_empty(1, size, len(self.modelled)))
        before: tuple[Tensor, Tensor] = (self.start_motion, self.start_audio)
        parts = []
        for number in progress(range(windows)) if progress is not None else range(windows):
            first = number * size
            if features is None:
                speech = self.encode_wave(audio[round(first * unit) : round((first + size) * unit)], size)
            else:
                speech = features[first : first + size]
            real = audio.new_ones(1, size)
            if number == windows - 1 and filled:
                real[:, size - min(size, filled) :] = 0
            motion = self.sample_window(speech[None], shape, style, before, start, real, draw)
            before = (motion[:, -self.context :], speech[None, -self.context :])
            parts.append(motion[0])
        return torch.cat(parts)[: size * windows - filled]

    def sample_window(
        self,
        speech: Float[Tensor, "1 window dim"],
        shape: Float[Tensor, "1 shape_dim"],
        style: Float[Tensor, "1 style_dim"] | None,
        before: tuple[Tensor, Tensor],
        start: Float[Tensor, "1 window channels"],
        real: Float[Tensor, "1 window"],
        draw: NoiseSource,
    ) -> Float[Tensor, "1 window channels"]:
        """The reverse process of one window, guided by those conditions that :attr:`guiding` names."""
        style = self.no_style[0] if style is None else style
        silent = self.no_audio.expand_as(speech) if "audio" in self.guiding else speech
        neutral = self.no_style[0] if "style" in self.guiding else style
        # Without any condition first, then one more in each branch; or, independently, each one by itself.
        conditions, styles = [silent], [neutral]
        for name in self.guiding:
            conditions.append(silent if name == "style" and self.guidance == "independent" else speech)
            styles.append(style if name == "style" else neutral)
        count = len(conditions)
        audio = torch.cat(conditions)
        person = torch.cat([torch.cat([shape, one], 1) for one in styles])
        wide = (before[0].expand(count, -1, -1), before[1].expand(count, -1, -1))
        scales = [self.scales[name] for name in self.guiding]

        def denoise(noisy: Tensor, step: int) -> Tensor:
            steps = torch.full((count,), step + 1, device=noisy.device)  # the network counts clean motion as 0
            predicted = self.network(noisy.expand(count, -1, -1), audio, person, wide, steps, real.expand(count, -1))
            if self.threshold is not None:
                predicted = clamped(predicted, self.window_frames, self.threshold)
            return guided(predicted[:, self.context :].split(1), scales, self.guidance)

        return PosteriorSampler(self.process).run(denoise, start, noise=draw)


def fitted(wave: Float[Tensor, " samples"]) -> Float[Tensor, " padded"]:
    """Speech with its ends mirrored, so that HuBERT gives exactly 50 steps a second: 320·n + 80 samples."""
    padding = 320 * max(1, len(wave) // 320) + 80 - len(wave)
    side = math.ceil(padding / 2)
    if side < 0:
        return wave
    padded = wave[None]
    # In two halves, as the authors do: a reflection can be no longer than the speech.
    for _ in range(2):
        mode = "reflect" if side // 2 < padded.shape[1] else "replicate"
        padded = F.pad(padded, (side // 2, side // 2), mode=mode)
    return F.pad(padded, (side % 2, side % 2), mode="replicate")[0]


# The authors' files.

STATISTICS = tuple(f"{key}_{name}" for key in ("exp", "pose", "shape") for name in ("mean", "std"))


def faces_of(files: AuthorFiles, options: ImportOptions) -> Facts:
    """One speaker, or the speakers of the given shapes, and the statistics that standardise shapes and motion."""
    count = files.size("denoising_net.person_proj.weight", 1) - files.size("null_style_feat", 2)
    stated: dict[str, Any] = {}
    for arguments in files.arguments.values():
        stated |= {name: arguments[name] for name in ("fps", "rot_repr") if arguments.get(name) is not None}
    rate = check_number(files.source, "args.fps", stated.get("fps", 25), *FRAME_RATES)
    if (rotations := stated.get("rot_repr", "aa")) != "aa":
        raise OptionError.naming(
            f"{files.source}: args.rot_repr is {quoted(rotations)}; expected aa, rotations as vectors along their axes"
        )
    statistics, templates = options.statistics, options.templates
    if statistics is None:
        raise OptionError.naming(
            f"{{statistics}}: {files.source} lacks the statistics of its training motion; give its authors' "
            f"stats_train.npz"
        )
    if not isinstance(statistics, Mapping):
        statistics = read_arrays(Path(statistics), STATISTICS, remedy="expected stats_train.npz of DiffPoseTalk")
    motion, deviation = statistics_of(statistics, ("exp", "pose"))
    mean_shape, shape_deviation = statistics_of(statistics, ("shape",))
    if templates is None:
        shapes: dict[str, Any] = {"speaker": np.zeros(count)}
    elif isinstance(templates, Mapping):
        shapes = dict(templates)
    else:
        path = Path(templates)
        shapes = {path.stem: open_array(path) if path.suffix == ".npy" else read_arrays(path, ("shape",))["shape"]}
    rows = {str(name): np.asarray(value, np.float32).reshape(-1)[:count] for name, value in shapes.items()}
    if len(motion) != 56 or len(mean_shape) != count or any(len(row) != count for row in rows.values()):
        raise OptionError.naming(
            f"{{statistics}} and {{templates}}: have {len(motion)} numbers of motion and {len(mean_shape)} of shape, "
            f"and a speaker {min(map(len, rows.values()))}; expected 56 (exp 50, pose 6) and {count}"
        )
    details = {
        "motion_mean": motion,
        "motion_std": deviation,
        "shapes": (torch.from_numpy(np.stack([*rows.values()])) - mean_shape) / shape_deviation,
    }
    return Facts(
        "HDTF_TFHP",
        rate,
        list(rows),
        dict.fromkeys(rows, torch.zeros(56, 1)),
        layout(files.card.layout),
        details=details,
    )
