"""A live performance from the first check to the report at its end, with any model."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from facediff.errors import FaceDiffError, printable
from facediff.live.frames import OPTION, Performance, open_receiver
from facediff.live.loop import LiveSummary, Loop, Solver
from facediff.live.model import LiveModel
from facediff.live.options import LiveOptions

Report = Callable[[str], None]


def perform(options: LiveOptions, open_model: Callable[[], LiveModel], report: Report) -> LiveSummary:
    """Perform from the first check to the report at the end."""
    options.check()
    # What fails quickly comes first: a model takes seconds to open.
    receivers = [open_receiver(text) for text in options.to or []]
    weighted = next((receiver.name for receiver in receivers if receiver.needs_weights), None)
    source = options.source()
    model = open_model()
    if weighted is not None and options.shapes is None and not model.weights:
        raise FaceDiffError(
            f"{OPTION} {weighted}: sends weights of blendshapes; give --shapes: a folder of meshes, a .glb, or puppet "
            f"for the built-in face"
        )
    unsolved = weighted is None or options.shapes is None
    names, solve = (model.weights, None) if unsolved else solver(Path(str(options.shapes)), model)
    performance = Performance(
        frame_rate=model.frame_rate,
        neutral=model.neutral,
        faces=model.faces,
        unit=model.unit,
        shapes=names,
        colours=model.colours,
        speech=options.plays,
        metadata=dict(model.metadata),
    )
    model.warm_up()
    with ExitStack() as stack:
        for receiver in receivers:
            stack.callback(receiver.close)
            receiver.open(performance)
        if not options.quiet:
            lag = max(0.0, model.look_ahead - 1 / model.frame_rate)
            report(
                f"ready; {source.name}; {model.frame_rate:g} frames a second, each {lag:.2f} s after its speech and "
                f"the time that computing takes; Ctrl-C ends it"
            )
        loop = Loop(
            model,
            source,
            receivers,
            hearing=options.plays,
            solve=solve,
            seconds=options.seconds,
            report=report,
            every=None if options.quiet else 5.0,
        )
        summary = loop.run()
    for sentence in summary.sentences():
        report(sentence)
    return summary


def solver(shapes: Path, model: LiveModel) -> tuple[tuple[str, ...], Solver]:
    """Names of a set of blendshapes, and the solver of their weights for a frame."""
    from facediff.editing.live_weights import FrameSolver
    from facediff.editing.shapes import read_shapes

    shape_set = read_shapes(shapes, model.neutral, model.unit)
    frame_solver = FrameSolver(shape_set, model.frame_rate, faces=model.faces if len(model.faces) else None, regions={})
    return shape_set.names, lambda offsets: frame_solver.solve(offsets).astype("float32")


def print_report(sentence: str) -> None:
    """Print to standard error, since standard output may be a receiver's."""
    print(f"facediff live: {printable(sentence)}", file=sys.stderr, flush=True)
