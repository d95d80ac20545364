"""Callbacks that tell what training epochs and previews cost, for ``rendering.py preview``."""

import time
from contextlib import AbstractContextManager, nullcontext

from lightning.pytorch import Callback, LightningModule, Trainer

from facediff.callbacks import SamplingPreview

Cost = tuple[float, float]


def now() -> Cost:
    """Seconds on the wall and of the process."""
    return time.perf_counter(), time.process_time()


def since(start: Cost) -> Cost:
    """What has passed since then."""
    wall, process = now()
    return wall - start[0], process - start[1]


class Clock(Callback):
    """Keeps what every epoch cost."""

    def __init__(self) -> None:
        self.costs: list[Cost] = []
        self._start = now()

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start."""
        self._start = now()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop."""
        self.costs.append(since(self._start))


class TimedPreview(SamplingPreview):
    """Keeps what every preview cost."""

    costs: list[Cost]

    def _preview(
        self,
        trainer: Trainer,
        model: LightningModule,
        epochs: int,
        weights: AbstractContextManager[None] = nullcontext(),  # noqa: B008 - holds nothing
    ) -> None:
        start = now()
        super()._preview(trainer, model, epochs, weights)
        self.costs = [*getattr(self, "costs", []), since(start)]


class ShippedPreview(TimedPreview):
    """A second one, with the options of a shipped config."""
