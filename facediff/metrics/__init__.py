"""Metrics of speech-driven 3D facial animation, each a definition with named options.

The same three letters mean different numbers in different projects: a :class:`Protocol` is a named setting of the
options and describes its numbers in words. Needs torch and torchmetrics only.

>>> import torch
>>> from facediff.metrics import Region, protocol
>>> lips, brows = Region.from_indices("mouth", [0, 1]), Region.from_indices("brows", [2, 3])
>>> metrics = protocol("paper").build(lips, brows)
>>> metrics.update(torch.ones(1, 5, 4, 3), torch.zeros(1, 5, 4, 3))
>>> {name: round(score.item(), 4) for name, score in metrics.compute().items()}
{'mve': 1.7321, 'lve': 3.0, 'fdd': 0.0}
>>> print(metrics.summary())
protocol paper: lips mouth (2 vertices, 83b97b85), upper brows (2 vertices, 46584c88); frames 5, sequences 1

Every metric is a torchmetrics class, a function made from it, and a name in the registry, both in snake case; the
class's docstring has the formula, its source, its unit, and its choices. docs/metrics.md lists them.

Lengths or masks tell the padding, which is never read. NaN and infinity are refused with the clip's name.
Sums are float64 for any input, and processes with unequal numbers of sequences agree with a single one. The options
that all metrics share are described in :class:`ExactMetric`, :class:`SequenceMetric` and its :meth:`update`.

A new metric is a :class:`SequenceMetric` that defines :meth:`clip_value`, registered with
``@facediff.registry.metric.register``.
"""

from facediff.metrics.base import Clip as Clip
from facediff.metrics.base import Coverage as Coverage
from facediff.metrics.base import ExactMetric as ExactMetric
from facediff.metrics.base import LipMetric as LipMetric
from facediff.metrics.base import SequenceMetric as SequenceMetric
from facediff.metrics.base import align as align
from facediff.metrics.base import describe_column as describe_column
from facediff.metrics.base import functional as functional
from facediff.metrics.by_name import NEEDS as NEEDS
from facediff.metrics.by_name import Context as Context
from facediff.metrics.by_name import Request as Request
from facediff.metrics.by_name import feed as feed
from facediff.metrics.by_name import parse as parse
from facediff.metrics.channels import ChannelDynamicsDeviation as ChannelDynamicsDeviation
from facediff.metrics.channels import ChannelVariance as ChannelVariance
from facediff.metrics.channels import FramePairDistance as FramePairDistance
from facediff.metrics.channels import FrechetDistance as FrechetDistance
from facediff.metrics.channels import ResidualPartnerCorrelation as ResidualPartnerCorrelation
from facediff.metrics.channels import ShannonIndex as ShannonIndex
from facediff.metrics.channels import StepDistance as StepDistance
from facediff.metrics.channels import channel_dynamics_deviation as channel_dynamics_deviation
from facediff.metrics.channels import channel_variance as channel_variance
from facediff.metrics.channels import frame_pair_distance as frame_pair_distance
from facediff.metrics.channels import frechet_distance as frechet_distance
from facediff.metrics.channels import residual_partner_correlation as residual_partner_correlation
from facediff.metrics.channels import shannon_index as shannon_index
from facediff.metrics.channels import split_frames as split_frames
from facediff.metrics.channels import step_distance as step_distance
from facediff.metrics.eyes import BlinkRate as BlinkRate
from facediff.metrics.eyes import BlinkRateRatio as BlinkRateRatio
from facediff.metrics.eyes import EyelidDrift as EyelidDrift
from facediff.metrics.eyes import blink_rate as blink_rate
from facediff.metrics.eyes import blink_rate_ratio as blink_rate_ratio
from facediff.metrics.eyes import eyelid_drift as eyelid_drift
from facediff.metrics.generation import DifferenceRatio as DifferenceRatio
from facediff.metrics.generation import EnergyScore as EnergyScore
from facediff.metrics.generation import FrameStep as FrameStep
from facediff.metrics.generation import MotionLiveliness as MotionLiveliness
from facediff.metrics.generation import RatioMetric as RatioMetric
from facediff.metrics.generation import SpectrumDistance as SpectrumDistance
from facediff.metrics.generation import SpreadErrorRatio as SpreadErrorRatio
from facediff.metrics.generation import difference_ratio as difference_ratio
from facediff.metrics.generation import energy_score as energy_score
from facediff.metrics.generation import frame_step as frame_step
from facediff.metrics.generation import motion_liveliness as motion_liveliness
from facediff.metrics.generation import spectrum_distance as spectrum_distance
from facediff.metrics.generation import spread_error_ratio as spread_error_ratio
from facediff.metrics.mouth import BilabialClosureRate as BilabialClosureRate
from facediff.metrics.mouth import Closures as Closures
from facediff.metrics.mouth import LipOpeningCorrelation as LipOpeningCorrelation
from facediff.metrics.mouth import LipSpeedCorrelation as LipSpeedCorrelation
from facediff.metrics.mouth import MouthOpeningDifference as MouthOpeningDifference
from facediff.metrics.mouth import OpeningMetric as OpeningMetric
from facediff.metrics.mouth import bilabial_closure_rate as bilabial_closure_rate
from facediff.metrics.mouth import lip_opening_correlation as lip_opening_correlation
from facediff.metrics.mouth import lip_speed_correlation as lip_speed_correlation
from facediff.metrics.mouth import mouth_opening_difference as mouth_opening_difference
from facediff.metrics.protocols import PROTOCOLS as PROTOCOLS
from facediff.metrics.protocols import Protocol as Protocol
from facediff.metrics.protocols import ProtocolMetrics as ProtocolMetrics
from facediff.metrics.protocols import Summary as Summary
from facediff.metrics.protocols import protocol as protocol
from facediff.metrics.regions import TOPOLOGIES as TOPOLOGIES
from facediff.metrics.regions import EyelidPairs as EyelidPairs
from facediff.metrics.regions import LipPairs as LipPairs
from facediff.metrics.regions import Region as Region
from facediff.metrics.regions import Topology as Topology
from facediff.metrics.regions import as_region as as_region
from facediff.metrics.samples import CoverageError as CoverageError
from facediff.metrics.samples import IdentityDiversity as IdentityDiversity
from facediff.metrics.samples import MeanEstimateError as MeanEstimateError
from facediff.metrics.samples import SampleDiversity as SampleDiversity
from facediff.metrics.samples import SamplesMetric as SamplesMetric
from facediff.metrics.samples import coverage_error as coverage_error
from facediff.metrics.samples import identity_diversity as identity_diversity
from facediff.metrics.samples import mean_estimate_error as mean_estimate_error
from facediff.metrics.samples import sample_diversity as sample_diversity
from facediff.metrics.speech import ClipSpeechLipCorrelation as ClipSpeechLipCorrelation
from facediff.metrics.speech import clip_speech_lip_correlation as clip_speech_lip_correlation
from facediff.metrics.speech import speech_intensity as speech_intensity
from facediff.metrics.speed import RealTimeFactor as RealTimeFactor
from facediff.metrics.speed import device_name as device_name
from facediff.metrics.speed import real_time_factor as real_time_factor
from facediff.metrics.style import NearestSpeakerAccuracy as NearestSpeakerAccuracy
from facediff.metrics.style import SpeakerGallery as SpeakerGallery
from facediff.metrics.style import nearest_speaker_accuracy as nearest_speaker_accuracy
from facediff.metrics.timing import LipWarpingDistance as LipWarpingDistance
from facediff.metrics.timing import TemporalMisalignment as TemporalMisalignment
from facediff.metrics.timing import lip_warping_distance as lip_warping_distance
from facediff.metrics.timing import temporal_misalignment as temporal_misalignment
from facediff.metrics.timing import warp as warp
from facediff.metrics.vertex_errors import FaceDynamicsDeviation as FaceDynamicsDeviation
from facediff.metrics.vertex_errors import LipVertexError as LipVertexError
from facediff.metrics.vertex_errors import MeanVertexError as MeanVertexError
from facediff.metrics.vertex_errors import VertexError as VertexError
from facediff.metrics.vertex_errors import face_dynamics_deviation as face_dynamics_deviation
from facediff.metrics.vertex_errors import lip_vertex_error as lip_vertex_error
from facediff.metrics.vertex_errors import mean_vertex_error as mean_vertex_error
