"""The options of a live performance that are not the model's; importing them costs nothing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from facediff.animation.options import CheckedOptions
from facediff.errors import FaceDiffError, refuse_idle
from facediff.registry import receiver
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.live.sources import SpeechSource


@dataclass(frozen=True)
class LiveOptions(CheckedOptions):
    """Performance (where the speech comes from, and where the frames go).

    Attributes:
        microphone: sound device by its number or a part of its name, in place of SPEECH (default: the system's)
        rate: sample rate of samples on standard input
        to: where the frames go: scheme://host:port, a scheme alone, or scheme:file; may be repeated (docs/live.md, and
            `facediff components receiver`)
        shapes: blendshapes for receivers that take weights: folder of meshes, .glb with targets, or "puppet" (built in;
            the default for the model that comes with facediff)
        sound: where the speech is played, delayed to match: off, or receivers (the page in the browser) (default:
            receivers for a recording, else off)
        seconds: end after so much speech
        quiet: report at the end only
        speech: a recording; ``-`` for standard input; None for a microphone
    """

    microphone: Annotated[str | None, Option(metavar="DEVICE", bare="default")] = None
    rate: Annotated[ranges.SampleRate, Option(metavar="HZ")] = 16_000
    to: Annotated[list[str] | None, Option(metavar="ADDRESS")] = None
    shapes: Annotated[Path | None, Option(metavar="SHAPES", reads=True)] = None
    sound: Literal["off", "receivers"] | None = None
    seconds: Annotated[ranges.Duration | None, Option(metavar="S")] = None
    quiet: bool = False
    speech: Annotated[str | None, Option(hidden=True)] = None

    def check(self) -> None:
        """Refuse options that contradict each other."""
        if (self.speech is None) == (self.microphone is None):
            problem = "missing" if self.speech is None else "comes from one place"
            raise FaceDiffError(
                f"speech: {problem}; give a recording, - for samples on standard input, or --microphone"
            )
        refuse_idle("is for samples on standard input", rate=self.speech != "-" and self.rate != 16_000)
        if not self.to:
            raise FaceDiffError(f"--to: missing; give a receiver, one of {', '.join(receiver.names())}")

    @property
    def plays(self) -> bool:
        """Whether receivers play the speech; not by default that of a microphone, which playing would feed back."""
        return self.speech not in (None, "-") if self.sound is None else self.sound == "receivers"

    def source(self) -> SpeechSource:
        """Where the speech comes from."""
        from facediff.live.sources import Microphone, Pcm, Played

        if self.microphone is not None:
            return Microphone(self.microphone)
        return Pcm(self.rate) if self.speech == "-" else Played(Path(str(self.speech)))
