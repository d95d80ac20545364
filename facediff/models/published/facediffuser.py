"""FaceDiffuser (Stan, Haque, Yumak: "FaceDiffuser: Speech-Driven 3D Facial Animation Synthesis Using Diffusion", 2023).

Diffusion over the vertices themselves, with HuBERT's features and recurrent layers. From top to bottom: the model, its
network, the sampling loop in the width of the network, the authors' checkpoints. docs/methods/facediffuser.md says what
of the published code is an option here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch
from facediff.errors import ArgumentError
from facediff.models.audio_encoders import AudioEncoderFactory, StepRule
from facediff.models.inference import BatchMotion, ClipNoise, Progress
from facediff.models.layers import Layers, Share, Width
from facediff.models.published.base import PublishedModel, SpeakerTable, masked_mean
from facediff.models.published.importing import Found, Recogniser, Request, Weights, recogniser
from facediff.models.samplers import NoiseProcess
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.utils import SAMPLE_RATE
from facediff.utils.ranges import Range
