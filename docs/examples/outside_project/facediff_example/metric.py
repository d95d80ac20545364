"""Metrics of another package, chosen by name in `facediff evaluate` and `facediff test`."""

import torch
from torch import Tensor

from facediff.metrics import Clip, LipMetric


class LipRange(LipMetric):
    """Lip range: how much further the lips of the truth move from their first frame than those of the prediction.

    Per sequence the mean over lip vertices of max_t ‖g[t] − g[0]‖ − max_t ‖p[t] − p[0]‖, in the vertices' unit; then
    the mean over sequences.
    """

    words = "in each sequence how much further {region} move in the truth; mean over sequences [unit]"

    def clip_value(self, clip: Clip) -> Tensor:
        """The difference of one sequence."""
        truth, prediction = (motion[:, self.indices].double() for motion in (clip.truth, clip.prediction))
        return torch.stack([(x - x[0]).norm(dim=-1).amax(0).mean() for x in (truth, prediction)]).diff().neg()[0]
