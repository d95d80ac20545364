"""The command of a live performance, whatever animates: its options, and what happens from first to last."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from facediff.errors import FaceDiffError, printable
from facediff.live.frames import OPTION, Performance, Receiver, open_receivers
from facediff.live.loop import LiveSummary, Loop, Solver
from facediff.live.model import LiveModel, runtime_model, usual_gate
from facediff.live.sound import SoundOut
from facediff.live.sources import USUAL, Microphone, Pcm, Played, SpeechSource
from facediff.registry import receiver
from facediff.speech.voice_activity import QUICK_GATE, USUAL_GATE, read_gate
from facediff.utils import ranges

OFF, OUT, RECEIVERS = "off", "out", "receivers"
"""Where speech is played: nowhere, on a sound device (``out:NAME`` for one by its name), by receivers that can."""

Report = Callable[[str], None]


@dataclass(frozen=True)
class LiveOptions:
    """A live performance: the options of ``facediff live``, which explains them.

    Raises:
        FaceDiffError: if a number is out of range, or options contradict each other.
    """

    model: Path
    speech: str | None = None
    microphone: str | None = None
    rate: ranges.SampleRate = 16_000
    to: Sequence[str] = field(default_factory=tuple)
    identity: str | None = None
    condition: str | None = None
    style: str | None = None
    seed: ranges.Seed = 0
    expressivity: str | None = None
    voice_gate: str = USUAL_GATE
    window: ranges.Window | None = None
    overlap: ranges.Window | None = None
    shapes: Path | None = None
    sound: str | None = None
    seconds: ranges.Duration | None = None
    threads: ranges.Threads = 0
    quiet: bool = False

    def __post_init__(self) -> None:
        ranges.check_fields(self)
        if (self.speech is None) == (self.microphone is None):
            raise FaceDiffError(
                "speech: comes from one place; give a recording, - for samples on standard input, or --microphone"
            )
        if self.speech != "-" and self.rate != 16_000:
            raise FaceDiffError("--rate: is for samples on standard input; omit it")
        if not self.to:
            raise FaceDiffError(f"{OPTION}: missing; give a receiver, one of {', '.join(receiver.names())}")
        if self.sound is not None and self.sound.partition(":")[0] not in (OFF, OUT, RECEIVERS):
            raise FaceDiffError(f"--sound {self.sound}: expected {OFF}, {OUT}, {OUT}:DEVICE or {RECEIVERS}")
        if self.voice_gate != USUAL_GATE:
            read_gate(self.voice_gate)

    @property
    def low_latency(self) -> bool:
        """Whether frames are made one by one; whoever chooses windows wants something else."""
        return self.window is None and self.overlap is None

    @property
    def plays(self) -> str:
        """Where speech is played. A microphone is heard in the room already, and would hear itself."""
        usual = RECEIVERS if self.speech not in (None, "-") else OFF
        return usual if self.sound is None else self.sound

    def source(self) -> SpeechSource:
        """Where the speech comes from."""
        if self.microphone is not None:
            return Microphone(self.microphone)
        return Pcm(self.rate) if self.speech == "-" else Played(Path(str(self.speech)))

    def gate(self, look_ahead: float) -> str:
        """The voice gate for windows that wait for so many seconds of speech."""
        if self.voice_gate != USUAL_GATE:
            return self.voice_gate
        return QUICK_GATE if self.low_latency else usual_gate(look_ahead)

    def expressivity_of_all(self) -> float:
        """Expressivity as one number, which is what an exported model takes."""
        if self.expressivity is None:
            return 1.0
        return ranges.EXPRESSIVITY.read("--expressivity", self.expressivity)


def exported_model(options: LiveOptions) -> LiveModel:
    """The folder of ``facediff export-model`` that the options name.

    Raises:
        FaceDiffError: naming the file or the option.
    """
    from facediff.runtime import RuntimeModel

    expressivity = options.expressivity_of_all()
    model = RuntimeModel.open(options.model, threads=options.threads)
    if options.low_latency:
        model.choose_low_latency()
    else:
        model.windows = model.windows.chosen(options.window, options.overlap)
    return runtime_model(
        model,
        gate=read_gate(options.gate(model.windows.look_ahead)),
        identity=options.identity,
        condition=options.condition,
        style=options.style,
        seed=options.seed,
        expressivity=expressivity,
    )


def perform(options: LiveOptions, open_model: Callable[[LiveOptions], LiveModel], report: Report) -> LiveSummary:
    """Perform from the first check to the report at the end.

    Args:
        options: the choices.
        open_model: opens the model that they name.
        report: prints a sentence.

    Raises:
        FaceDiffError: if something cannot work at all. Nothing of the other sides is an error once it has begun.
    """
    # What fails at once comes first: a model takes seconds to open.
    receivers = open_receivers(options.to)
    sound = None
    if options.plays.partition(":")[0] == OUT:
        sound = SoundOut(options.plays.partition(":")[2] or USUAL)
    if options.shapes is not None:
        from facediff.editing.shapes import check_shapes

        check_shapes(options.shapes)
    wanting = [receiver.name for receiver in receivers if receiver.needs_weights]
    if wanting and options.shapes is None:
        raise FaceDiffError(
            f"{OPTION} {wanting[0]}: sends weights of blendshapes; give --shapes: a folder of meshes, a .glb, or "
            f"puppet for the built-in face"
        )
    source = options.source()
    model = open_model(options)
    names, solve = ((), None) if options.shapes is None or not wanting else solver(options.shapes, model)
    everyone = [*receivers, *([] if sound is None else [sound])]
    performance = Performance(
        frame_rate=model.frame_rate,
        neutral=model.neutral,
        faces=model.faces,
        unit=model.unit,
        shapes=names,
        colours=model.colours,
        speech=options.plays == RECEIVERS,
        metadata=dict(model.metadata),
    )
    model.warm_up()
    with opened(everyone, performance):
        tell = (lambda _: None) if options.quiet else report
        tell(
            f"ready; {source.name}; {model.frame_rate:g} frames a second, each {model.lag:.2f} s after its speech and "
            f"the time that computing takes; Ctrl-C ends it"
        )
        loop = Loop(
            model,
            source,
            everyone,
            hearing=receivers if options.plays == RECEIVERS else [] if sound is None else [sound],
            solve=solve,
            seconds=options.seconds,
            report=report,
            every=None if options.quiet else 5.0,
        )
        if sound is not None:
            sound.follow(loop.clock, loop.pacer)
        summary = loop.run()
    for sentence in summary.sentences():
        report(sentence)
    return summary


def solver(shapes: Path, model: LiveModel) -> tuple[tuple[str, ...], Solver]:
    """Names of a set of blendshapes, and what finds their weights for a frame.

    Raises:
        FaceDiffError: if the shapes do not fit the face.
    """
    from facediff.editing.live_weights import FrameSolver
    from facediff.editing.shapes import read_shapes

    shape_set = read_shapes(shapes, model.neutral, model.unit)
    frame_solver = FrameSolver(
        shape_set, model.frame_rate, faces=model.faces if len(model.faces) else None, regions={}, unit=model.unit
    )
    return shape_set.names, lambda offsets: frame_solver.solve(offsets).astype("float32")


@contextmanager
def opened(receivers: Sequence[Receiver], performance: Performance) -> Iterator[None]:
    """Receivers that are open for as long as the context lasts, and all closed after it."""
    begun: list[Receiver] = []
    try:
        for opening in receivers:
            begun.append(opening)
            opening.open(performance)
        yield
    finally:
        for closing in reversed(begun):
            closing.close()


def reporter(program: str) -> Report:
    """Prints sentences to standard error, since standard output may be a receiver's."""

    def report(sentence: str) -> None:
        print(f"{program}: {printable(sentence)}", file=sys.stderr, flush=True)

    return report
