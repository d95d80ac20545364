"""Recurrent nodes of the ONNX format, computed frame by frame as the format's specification of GRU and LSTM says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor


def recurrent_node(
    name: str, inputs: Sequence[Tensor], attributes: Mapping[str, Any], *, dtype: torch.dtype, shape: Sequence[int]
) -> Tensor:
    """What ``torch.onnx.ops.symbolic`` stands for: all states, (frames, directions, batch, size)."""
    x, weights, recurrent, biases = inputs
    forms = {"forward": [False], "reverse": [True], "bidirectional": [False, True]}
    made = []
    for end, reverse in enumerate(forms[attributes["direction"]]):
        own, back, bias = weights[end], recurrent[end], biases[end].chunk(2)
        hidden = cell = x.new_zeros(x.shape[1], attributes["hidden_size"])
        states = []
        for frame in x.flip(0) if reverse else x:
            fed, kept = frame @ own.T + bias[0], hidden @ back.T + bias[1]
            if name == "LSTM":  # input, output, forget, cell
                entry, output, forget, new = (fed + kept).chunk(4, -1)
                cell = forget.sigmoid() * cell + entry.sigmoid() * new.tanh()
                hidden = output.sigmoid() * cell.tanh()
            else:  # update, reset, hidden
                update, reset = (fed + kept).chunk(3, -1)[:2]
                update, reset = update.sigmoid(), reset.sigmoid()
                if attributes.get("linear_before_reset", 0) == 1:
                    new = fed.chunk(3, -1)[2] + reset * kept.chunk(3, -1)[2]
                else:
                    new = fed.chunk(3, -1)[2] + (reset * hidden) @ back.chunk(3)[2].T + bias[1].chunk(3)[2]
                hidden = (1 - update) * new.tanh() + update * hidden
            states.append(hidden)
        made.append(torch.stack(states[::-1] if reverse else states))
    result = torch.stack(made, 1)
    assert result.dtype == dtype
    assert result.shape == tuple(shape)
    return result
