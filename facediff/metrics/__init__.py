"""Metrics of speech-driven 3D facial animation, each a definition with named options.

The same three letters mean different numbers in different projects: a `Protocol` is a named setting of the
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
class's docstring has the formula, its source, its unit, and what about it is a choice:

- distance from the truth: `MeanVertexError`, `LipVertexError`, `UpperFaceVertexError`
- amount of movement: `FaceDynamicsDeviation`
- the mouth: `MouthOpeningDifference`, `BilabialClosureRate`
- timing: `LipWarpingDistance` (lip DTW), `TemporalMisalignment` (MTM), `LipOpeningCorrelation` and
  `LipSpeedCorrelation` (lip PCC)
- loudness: `ClipSpeechLipCorrelation` and `FrameSpeechLipCorrelation` (SLCC)
- several samples: `MeanEstimateError`, `CoverageError`, `SampleDiversity`
- several identities: `IdentityDiversity`, `StyleRetrievalAccuracy`
- speed: `RealTimeFactor`

Lengths or masks say what is padding, which is never read. NaN and infinity are refused with the clip's name.
Sums are float64 whatever comes in, and processes with unequal numbers of sequences get what one would. The options
that all metrics share are those of `facediff.metrics.base.SequenceOptions` and `BatchOptions`.

A new metric is a `SequenceMetric` that defines `clip_value`, registered with ``@facediff.registry.metric.register``.
"""

from facediff.metrics.base import Clip, Coverage, ExactMetric, LipMetric, SequenceMetric, align, functional
from facediff.metrics.by_name import NEEDS, Context, Request, feed, parse
from facediff.metrics.mouth import (
    BilabialClosureRate,
    Closures,
    LipOpeningCorrelation,
    LipSpeedCorrelation,
    MouthOpeningDifference,
    OpeningMetric,
    bilabial_closure_rate,
    lip_opening_correlation,
    lip_speed_correlation,
    mouth_opening_difference,
)
from facediff.metrics.protocols import PROTOCOLS, Protocol, ProtocolMetrics, Summary, protocol
from facediff.metrics.regions import TOPOLOGIES, LipPairs, Region, Topology, as_region
from facediff.metrics.samples import (
    CoverageError,
    IdentityDiversity,
    MeanEstimateError,
    SampleDiversity,
    SamplesMetric,
    coverage_error,
    identity_diversity,
    mean_estimate_error,
    sample_diversity,
)
from facediff.metrics.speech import (
    ClipSpeechLipCorrelation,
    FrameSpeechLipCorrelation,
    SpeechLipMetric,
    clip_speech_lip_correlation,
    frame_speech_lip_correlation,
    speech_intensity,
)
from facediff.metrics.speed import RealTimeFactor, device_name, real_time_factor
from facediff.metrics.style import StyleRetrievalAccuracy, style_retrieval_accuracy
from facediff.metrics.timing import (
    LipWarpingDistance,
    TemporalMisalignment,
    lip_warping_distance,
    temporal_misalignment,
    warp,
)
from facediff.metrics.vertex_errors import (
    FaceDynamicsDeviation,
    LipVertexError,
    MeanVertexError,
    UpperFaceVertexError,
    VertexError,
    face_dynamics_deviation,
    lip_vertex_error,
    mean_vertex_error,
    upper_face_vertex_error,
)

__all__ = [
    "NEEDS",
    "PROTOCOLS",
    "TOPOLOGIES",
    "BilabialClosureRate",
    "Clip",
    "ClipSpeechLipCorrelation",
    "Closures",
    "Context",
    "Coverage",
    "CoverageError",
    "ExactMetric",
    "FaceDynamicsDeviation",
    "FrameSpeechLipCorrelation",
    "IdentityDiversity",
    "LipMetric",
    "LipOpeningCorrelation",
    "LipPairs",
    "LipSpeedCorrelation",
    "LipVertexError",
    "LipWarpingDistance",
    "MeanEstimateError",
    "MeanVertexError",
    "MouthOpeningDifference",
    "OpeningMetric",
    "Protocol",
    "ProtocolMetrics",
    "RealTimeFactor",
    "Region",
    "Request",
    "SampleDiversity",
    "SamplesMetric",
    "SequenceMetric",
    "SpeechLipMetric",
    "StyleRetrievalAccuracy",
    "Summary",
    "TemporalMisalignment",
    "Topology",
    "UpperFaceVertexError",
    "VertexError",
    "align",
    "as_region",
    "bilabial_closure_rate",
    "clip_speech_lip_correlation",
    "coverage_error",
    "device_name",
    "face_dynamics_deviation",
    "feed",
    "frame_speech_lip_correlation",
    "functional",
    "identity_diversity",
    "lip_opening_correlation",
    "lip_speed_correlation",
    "lip_vertex_error",
    "lip_warping_distance",
    "mean_estimate_error",
    "mean_vertex_error",
    "mouth_opening_difference",
    "parse",
    "protocol",
    "real_time_factor",
    "sample_diversity",
    "speech_intensity",
    "style_retrieval_accuracy",
    "temporal_misalignment",
    "upper_face_vertex_error",
    "warp",
]
