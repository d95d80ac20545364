"""CodeTalker, after the paper of that name (2023).

Xing, Xia, Zhang, Cun, Wang, Wong: "CodeTalker: Speech-Driven 3D Facial Animation with Discrete Motion Prior". Two
stages of one model: a prior, which learns to write motion in a table of codes (``motion_prior.py``), and a predictor,
FaceFormer's decoder, which finds the codes that speech asks for. docs/methods.md lists the options
for choices of the published code.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, Reference
from facediff.errors import ArgumentError, FaceDiffError, damaged
from facediff.models.audio_encoders import AudioEncoder, AudioEncoderFactory, Lengths, Waves
from facediff.models.base import AnimationModel
from facediff.models.checkpoint_content import IMPORTED
from facediff.models.inference import BatchMotion, Motion, Progress, Style
from facediff.models.layers import Frames, Heads, Layers, Width, frame_mask
from facediff.models.published.autoregressive import AutoregressiveModel, Continuation, SpeechDecoder
from facediff.models.published.base import TRAINED_NETWORK, SpeakerTable, masked_mean
from facediff.models.published.motion_prior import MotionPrior, perplexity
from facediff.models.squared_errors import mean_squared_error
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from facediff.models.published.cards import AuthorFiles, Facts

Stage = Literal["prior", "predictor"]
"""The trained part: the autoencoder of motion, or the predictor of its codes from speech."""

History = Literal["true", "own"]
"""Which frames the predictor continues in training: the true ones, or those that it makes itself."""

COMMITMENT = 0.25
"""Weight with which tokens are drawn to their codes."""

RECIPE = "configs/experiment/puppet_codetalker_prior.yaml"


@registry.model.register("CodeTalker")
class CodeTalker(AutoregressiveModel):
    """CodeTalker: an autoregressive Transformer over the codes of a discrete prior of motion.

    Train it twice: with ``stage=prior``, then with ``stage=predictor`` and ``prior`` the first run's checkpoint; the
    second run's holds both. A prior alone takes no speech: a test of it scores how well it reconstructs motion.

    Args:
        stage: ``prior`` is the autoencoder alone; ``predictor`` trains what finds its codes, and leaves it as it is.
        prior: checkpoint that gives the prior of a new predictor; its sizes must be this model's.
        dim: channels of the predictor; 1024 if None.
        num_layers: its layers; 12 at 25 frames a second (BIWI) and 6 otherwise if None.
        prior_dim: channels of the prior's two halves.
        prior_layers: Transformer layers of each half.
        prior_heads: their attention heads.
        prior_feed_forward_dim: channels of their feed-forward layers.
        tokens: codes of a frame; 8 at 25 frames a second and 16 otherwise if None.
        token_dim: channels of a code; an equal part of ``prior_dim`` if None.
        codes: rows of the table of codes.
        leak: slope of the prior's activation below zero.
        corrected: correct the published slips: the prior adds to each frame its own position, and not frame 0's;
            it divides scores by the root of a head's width, and not of the whole layer's; and the second frame
            follows a still face, and not the first frame's codes decoded alone, which is one constant face for any
            speech.
        history: which frames the predictor continues in training: the ``true`` ones as published, which lets it learn
            to continue motion without regard to the speech; or its ``own``, generated from a face that does not move,
            and then again from its own output, in one to three passes.
        options: of the other methods with this decoder, see :class:`AutoregressiveModel`, and of every model.
    """

    network: Predictor

    # wav2vec 2.0 base as transformers had it in 2021.
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="facebook/wav2vec2-base-960h", epsilon=1e-5
    )

    def __init__(
        self,
        *,
        stage: Stage = "predictor",
        prior: str | None = None,
        dim: Width | None = None,
        num_layers: Layers | None = None,
        prior_dim: Width = 1024,
        prior_layers: Layers = 6,
        prior_heads: Heads = 8,
        prior_feed_forward_dim: Width = 1536,
        tokens: Annotated[int, Range(1, 4096)] | None = None,
        token_dim: Width | None = None,
        codes: Annotated[int, Range(1, 1_000_000)] = 256,
        leak: Annotated[float, Range(0, 1)] = 0.2,
        corrected: bool = False,
        history: History = "true",
        **options: Any,  # noqa: ANN401
    ) -> None:
        if stage == "prior":
            options.update(audio_encoder=NoSpeech, audio_dim=1)
        super().__init__(dim=dim or 1024, **options)
        self.stage: Stage = stage
        self.prior_file = prior
        self.history: History = history
        self.corrected = corrected
        # VOCASET's predictor has 6 layers and 16 tokens of 64 channels a frame, BIWI's 12 layers and 8 tokens of 128;
        # the product is 1024 both times. BIWI's prior alone has linear maps around its tokens, and no bias in its last
        # map.
        self.decoder_options["num_layers"] = num_layers or (12 if self.pairs else 6)
        tokens = tokens or (8 if self.pairs else 16)
        if prior_dim % prior_heads or prior_dim % 2 or (token_dim is None and prior_dim % tokens):
            raise ArgumentError(
                {"prior_dim": prior_dim, "prior_heads": prior_heads, "tokens": tokens},
                "prior_dim must be even, and a multiple of prior_heads and tokens",
            )
        self.prior_options: dict[str, Any] = {
            "dim": prior_dim,
            "num_layers": prior_layers,
            "num_heads": prior_heads,
            "hidden_dim": prior_feed_forward_dim,
            "tokens": tokens,
            "token_dim": token_dim or prior_dim // tokens,
            "codes": codes,
            "token_maps": self.pairs,
            "out_bias": not self.pairs,
            "leak": leak,
            "corrected": corrected,
        }
        self.prior = MotionPrior(coordinates=self.coordinates, **self.prior_options)
        self._lacks_prior = stage == "predictor"
        if stage == "prior":
            self.windows = type(self.windows)(above=math.inf)
            self.unseen_identity = "style_only"  # the reconstruction does not depend on the speaker
            return
        # The second stage speaks a language that is fixed: were the prior trained along, the codes that are its targets
        # would move with the prediction.
        self.prior.requires_grad_(False)
        self.network = Predictor(
            audio_width=self.audio_width,
            coordinates=self.coordinates,
            width=self.prior.width,
            n_identities=len(self.identities),
            decoder=self.decoder_options,
        )

    def keep_hyperparameters(self, arguments: dict[str, Any]) -> None:
        """Save the arguments as every model does, without the prior's file: the checkpoint holds the prior itself."""
        deaf = {"audio_encoder": NoSpeech, "audio_dim": 1} if self.stage == "prior" else {}
        super().keep_hyperparameters({**arguments, **deaf, "prior": None})

    # The prior of a predictor.

    @property
    def lacks_prior(self) -> bool:
        """Whether this is a predictor that was given no trained prior yet."""
        return self._lacks_prior and IMPORTED not in self.provenance

    def check_training(self, *, resumed: bool) -> None:
        """Take the prior of a new predictor, before a run writes anything; it is asked for if there is none."""
        if resumed:
            self.prior_file = None  # the checkpoint holds the prior
        elif self.lacks_prior:
            self.take_prior(self.prior_file)

    def setup(self, stage: str) -> None:
        """Take the prior's weights and its scale of motion, where a predictor has none."""
        if stage == "fit" and self.prior_file is not None:
            self.check_training(resumed=False)
        super().setup(stage)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take the assets from the checkpoint; its weights hold the prior."""
        super().on_load_checkpoint(checkpoint)
        self._lacks_prior = False

    def on_fit_start(self) -> None:
        """Refuse to train a predictor on a prior that was never trained; a checkpoint has been loaded by now."""
        super().on_fit_start()
        if self.lacks_prior:
            self.take_prior(None)

    def take_prior(self, path: str | None) -> None:
        """Take the prior of another checkpoint of CodeTalker, with its scale of motion and its licences.

        Args:
            path: a checkpoint of either stage, a model folder, or a name of the Hugging Face hub.
        """
        from facediff.models.base import load_model
        from facediff.utils.licences import merged

        if path is None:
            raise FaceDiffError(
                f"--model.prior: is missing, and CodeTalker's predictor learns to speak a trained prior's codes; train "
                f"one with --model.stage=prior ({RECIPE}) and give its checkpoint"
            )
        with damaged("--model.prior", "give a checkpoint of CodeTalker"):
            trained = load_model(path)
        model_facts = self.prior_facts()
        trained_facts = trained.prior_facts() if isinstance(trained, CodeTalker) else {}
        if differing := [name for name in model_facts if model_facts[name] != trained_facts.get(name)]:
            raise FaceDiffError(
                f"--model.prior {path}: is of {type(trained).__name__} with {differing[0]} "
                f"{trained_facts.get(differing[0])}, and this model has {model_facts[differing[0]]}; "
                f"expected a checkpoint of CodeTalker's prior, trained with the same options"
            )
        assert isinstance(trained, CodeTalker)  # noqa: S101 - else all options differ
        self.prior.load_state_dict(trained.prior.state_dict())
        self.licences = merged(self.licences, trained.licences)
        # The codes stand for motion as it was scaled when they were learnt.
        self._assets = replace(trained.assets, identities=self.identities)
        self._lacks_prior = False

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """The prior, which a file of the second stage may hold by itself, with its layers counted as here."""
        if inner := files.beginning("autoencoder."):
            for prefix in ("encoder.", "decoder.", "quantize."):
                files.ignore(prefix, "the file of the second stage holds a prior of its own")
            for name in inner:
                files.tensors[name.removeprefix("autoencoder.")] = files.tensors.pop(name)
        if "quantize.embedding.weight" not in files.tensors:
            raise FaceDiffError(
                f"{files.source}: is CodeTalker's second stage without the first, whose prior it needs; give both "
                f"files, such as vocaset_stage1.pth.tar and vocaset_stage2.pth.tar"
            )
        for name in list(files.tensors):
            # The authors number attention (even) and feed-forward layers (odd) in one list.
            if match := re.fullmatch(r"(\w+\.\w+_transformer\.net\.)(\d+)\.(.+)", name):
                part = ("attention", "hidden")[int(match[2]) % 2]
                files.tensors[f"{match[1]}{int(match[2]) // 2}.{part}.{match[3]}"] = files.tensors.pop(name)
        width = files.size("encoder.vertice_mapping.0.weight", 0)
        maps = "encoder.encoder_linear_embedding_post.net.weight"
        width = files.size(maps, 0) if maps in files.tensors else width
        return {"tokens": width // files.size("quantize.embedding.weight", 1)}

    def prior_facts(self) -> dict[str, object]:
        """What two models must agree on to have the same prior, by the names of the options."""
        facts = {"n_vertices": self.n_vertices, "frame_rate": self.frame_rate, "motion_scale": self.motion_scaling}
        names = {"dim": "prior_dim", "num_layers": "prior_layers"}
        return facts | {names.get(name, name): value for name, value in self.prior_options.items()}

    # Training.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The published terms of either stage."""
        frames = batch.frame_lengths if self.stage == "prior" else self.trained_frames(batch)
        truth = self.scaled_truth(batch, frames)
        if self.stage == "prior":
            return self.prior_losses(truth, frames)
        return self.predictor_losses(batch, truth, frames, generator)

    def prior_losses(self, truth: Tensor, frames: Int[Tensor, " batch"]) -> dict[str, Tensor]:
        """The mean absolute error of motion, and both squared distances between tokens and codes."""
        tokens = self.prior.encode_clips(truth, frames)
        codes = self.prior.quantise(tokens)
        error = masked_mean((self.prior.decode_clips(codes.values, frames) - truth).abs(), frames)
        # The two halves of the VQ-VAE objective (van den Oord et al. 2017, eq. 3). Each stops the other's gradient:
        # without it a token and its code would run towards each other at one rate, and the table, which many clips
        # share, would follow single clips.
        committed = masked_mean((codes.entries.detach() - tokens).square(), frames)
        moved = masked_mean((codes.entries - tokens.detach()).square(), frames)
        quantisation = COMMITMENT * committed + moved
        numbers = codes.numbers[frame_mask(frames, codes.numbers.shape[1])].flatten()
        return {
            "reconstruction": error,
            "quantisation": quantisation,
            "perplexity": perplexity(numbers, len(self.prior.codebook)),
            "loss": error + quantisation,
        }

    def predictor_losses(
        self, batch: Batch, truth: Tensor, frames: Int[Tensor, " batch"], generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """The squared error of motion, and the distance of features from true motion's codes, in parallel."""
        self.check_length(frames, batch.names)
        style, memory = self.conditions(batch, frames)
        before = truth
        if self.history == "own":
            before = torch.zeros_like(truth)
            with torch.no_grad():
                # A random number of passes, so that the predictor meets the face at rest as well as its own motion. No
                # gradient goes through them, since each would keep the graph of a decoding of all codes.
                for _ in range(int(torch.randint(3, (), generator=generator, device=truth.device))):
                    before = self.motion_of(self.network.in_parallel(style, memory, before), frames)
        features = self.network.in_parallel(style, memory, before)
        with torch.no_grad():
            # The target of the features is the code itself, not the token that it replaced: later steps decode
            # codes.
            true_codes = self.prior.quantise(self.prior.encode_clips(truth, frames)).entries
        error = mean_squared_error(self.motion_of(features, frames), truth, frames)
        distance = mean_squared_error(features, true_codes, frames)
        return {"reconstruction": error, "features": distance, "loss": error + distance}

    def motion_of(self, features: Tensor, frames: Int[Tensor, " batch"]) -> Tensor:
        """Motion (B, T, 3V) of the codes nearest to features."""
        return self.prior.decode_clips(self.prior.quantise(features).values, frames)

    # Inference.

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """Frame by frame; nothing is random."""
        self.check_length(frames, batch.names)
        style, memory = self.conditions(batch, frames)
        state, token = Continuation(self.network.decoder, memory), style[:, None]
        values: list[Tensor] = []
        # The predictor's keys, values and codes of earlier frames stay as they are. The prior attends to all frames and
        # normalises over them, so its output for earlier ones changes with every frame: it decodes all codes again, but
        # in its last layer and map the newest frame alone. The frames that are fed back are not the result's.
        for frame in (progress or iter)(range(int(frames.max()))):
            if frame:
                token = self.following(self.prior.decode_last(torch.cat(values, 1)), frame - 1, style)
            values.append(self.prior.quantise(self.network.out(state.step(token))).values)
        motion = self.prior.decode_clips(torch.cat(values, 1), frames)
        return self.offsets_of(motion)

    def following(self, motion: Float[Tensor, "batch coordinates"], frame: int, style: Tensor) -> Tensor:
        """The token of the frame after ``frame``."""
        # The published code decodes the first frame twice over, since PyTorch's normalisation refuses a single frame.
        # Ours takes one; the result is the same.
        if frame == 0 and self.corrected:
            motion = torch.zeros_like(motion)
        return (self.network.motion_in(motion) + style)[:, None]

    # A prior alone.

    @property
    def animates(self) -> bool:
        """Whether there is a predictor."""
        return self.stage == "predictor"

    def clip_of(
        self,
        audio: Float[Tensor, " samples"],
        identity: str,
        style: Reference | Style | None,
        condition: str | None = None,
        frames: int | None = None,
    ) -> Batch:
        """As every model; a prior alone is refused."""
        if not self.animates:
            raise FaceDiffError(
                "this checkpoint is CodeTalker's prior alone, which reconstructs motion and takes no speech; train the "
                "predictor with model.stage=predictor and --model.prior, and animate with its checkpoint"
            )
        return super().clip_of(audio, identity, style, condition, frames)

    def generate_clips(self, batch: Batch, *, seed: int = 0, progress: Progress | None = None) -> BatchMotion:
        """The motion that the speech asks for; of a prior alone, the clips' own motion as it reconstructs it."""
        if self.stage == "predictor":
            return super().generate_clips(batch, seed=seed, progress=progress)
        frames = batch.frame_lengths
        tokens = self.prior.encode_clips((batch.motion * self.scale).flatten(2), frames)
        motion = self.prior.decode_clips(self.prior.quantise(tokens).values, frames)
        return self.offsets_of(motion)

    def generate_samples(self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None) -> Motion:
        """One motion for all seeds."""
        if self.stage == "predictor":
            return super().generate_samples(clip, seeds, progress=progress)
        return AnimationModel.generate_samples(self, clip, seeds, progress=progress)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """As every model; a prior alone is not tested with other speech, since it takes none."""
        if self.stage == "prior":
            batch = replace(batch, decoy_audio=None)
        super().test_step(batch, batch_idx, dataloader_idx)


class NoSpeech(AudioEncoder):
    """Stands in for the audio encoder of a model that takes no speech."""

    def __init__(self, *, dim: Width) -> None:
        super().__init__()

    def forward(self, audio: Waves, audio_lengths: Lengths, frame_lengths: Lengths) -> Frames:
        """No features."""
        return audio.new_zeros(len(audio), int(frame_lengths.max()), 1)


class Predictor(SpeechDecoder):
    """Features of speech, a speaker's row and earlier motion to features of codes."""

    def __init__(
        self, *, audio_width: int, coordinates: int, width: int, n_identities: int, decoder: dict[str, Any]
    ) -> None:
        super().__init__(audio_width, coordinates, decoder)
        dim = int(decoder["dim"])
        self.out = nn.Linear(dim, width, bias=False)
        self.style = SpeakerTable(n_identities, dim, "embedding")
        # Training starts from one code for all frames, the one nearest to zero, and not from random faces.
        nn.init.zeros_(self.out.weight)

    def in_parallel(
        self, style: Float[Tensor, "batch dim"], memory: Float[Tensor, "batch steps dim"], motion: Tensor
    ) -> Float[Tensor, "batch frames width"]:
        """Features of every frame from motion (B, T, 3V) of the frame before it, zero before the first."""
        return self.out(self.after_motion(style, memory, motion))
