"""Metrics of speech-driven 3D facial animation, each a definition with named options.

The same three letters mean different numbers in different projects: a `Protocol` is a named setting of the
options and says in words what its numbers are. Needs torch and torchmetrics only.

>>> import torch
>>> from facediff.metrics import Region, protocol
>>> lips, brows = Region.from_indices("mouth", [0, 1]), Region.from_indices("brows", [2, 3])
>>> metrics = protocol("paper").build(lips, brows)
>>> metrics.update(torch.ones(1, 5, 4, 3), torch.zeros(1, 5, 4, 3))
>>> {name: round(score.item(), 4) for name, score in metrics.compute().items()}
{'mve': 1.7321, 'lve': 3.0, 'fdd': 0.0}
>>> print(metrics.summary())
protocol paper: lips mouth (2 vertices, 83b97b85), upper brows (2 vertices, 46584c88); frames 5, sequences 1
"""

from facediff.metrics.base import Coverage, SequenceMetric
from facediff.metrics.face_dynamics import FaceDynamicsDeviation
from facediff.metrics.functional import face_dynamics_deviation, lip_vertex_error, mean_vertex_error
from facediff.metrics.protocol_metrics import ProtocolMetrics, Summary
from facediff.metrics.protocols import PROTOCOLS, Protocol, protocol
from facediff.metrics.regions import Region
from facediff.metrics.vertex_errors import LipVertexError, MeanVertexError, VertexError

__all__ = [
    "PROTOCOLS",
    "Coverage",
    "FaceDynamicsDeviation",
    "LipVertexError",
    "MeanVertexError",
    "Protocol",
    "ProtocolMetrics",
    "Region",
    "SequenceMetric",
    "Summary",
    "VertexError",
    "face_dynamics_deviation",
    "lip_vertex_error",
    "mean_vertex_error",
    "protocol",
]
