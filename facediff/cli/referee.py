"""``facediff benchmark referee``: models of every kind on one face, scored against the phonemes of its speech."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.cli.options import FrameRate, OutputFolder, named_folders
from facediff.cli.process import tell
from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.hub import BUNDLED, check_animating_source, model_or_bundled
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.benchmark.referee import Judgement
    from facediff.pipelines.candidates import Candidate
    from facediff.synthetic.spoken_set import SpokenClip

FRAME_RATE = 25.0  # of the reference


def referee(
    models: Annotated[list[str] | None, Option(metavar="MODEL", reads=True)] = None,
    *,
    output: OutputFolder = Path("referee"),
    motion: Annotated[list[str] | None, Option(metavar="NAME=FOLDER", reads=True)] = None,
    layout: Annotated[str | None, Option(metavar="LAYOUT")] = None,
    frame_rate: FrameRate = None,
    flame: Annotated[Path | None, Option(metavar="MODEL", reads=True)] = None,
    languages: Annotated[Sequence[str] | None, Option(metavar="CODE,…")] = None,
    voices: Annotated[ranges.Samples, Option(metavar="N")] = 2,
    sentences: Annotated[ranges.Samples, Option(metavar="N")] = 3,
    write_speech: Annotated[Path | None, Option(metavar="FOLDER", writes="folder")] = None,
) -> int:
    """Compare models on one face and the same speech with known phonemes.

    MODEL is NAME=PATH or PATH of a checkpoint, a model folder, an exported folder or a folder of Audio2Face-3D;
    puppet, or none, is the model that comes with facediff. Closures, timing, jitter, blinks,
    head, languages, cost and licence are reported.
    Exit status: 0 all scored, 1 some models could not be scored, 2 something to put right.

    For example:
      facediff benchmark referee lam.ckpt unitalker.ckpt Audio2Face-3D-v2.3-Mark -o referee
      facediff benchmark referee --write-speech speech
      facediff benchmark referee puppet.ckpt --motion theirs=out --layout arkit

    Args:
        models: models to compare; see above
        output: folder for the report
        motion: folder of motion that another program made of the speech of --write-speech, called as the recordings;
            repeatable
        layout: layout of .npy and .npz in parameters, such as arkit or flame_artalk (docs/parameters.md)
        frame_rate: frames a second of motion without a stated rate
        flame: your FLAME model file, which shows FLAME's coefficients on the face; without it, only their jaw is scored
        languages: codes of the languages: en, de, es, fr, it, cmn (default: all)
        voices: voices of each language, as far as they are installed
        sentences: sentences of each voice
        write_speech: write the speech for models that run elsewhere, and do nothing else
    """
    from facediff.synthetic.spoken_set import LANGUAGES, reference, spoken_set, write_spoken_set

    if write_speech is None:
        import facediff.benchmark.referee  # noqa: F401 - a missing package is named before any synthesis

    codes = [*LANGUAGES] if languages is None else list(languages)
    clips = spoken_set(codes, voices, sentences)
    if write_speech is not None:
        write_spoken_set(clips, write_speech)
        tell(f"written: {len(clips)} recordings in {write_speech / 'wav'}; call motion as they are called")
        return 0
    from facediff.benchmark.referee import Judgement, judge
    from facediff.benchmark.referee_report import RefereeReport, text, write_report
    from facediff.benchmark.results import code_of
    from facediff.metrics import device_name

    candidates = candidates_of(models or [], motion or [], layout, frame_rate)
    rows = []
    for number, candidate in enumerate(candidates, 1):
        rows.append(judged(candidate, clips, flame))
        state = rows[-1].problem or f"{rows[-1].seconds or 0:.2g} processor seconds for a second"
        tell(f"[{number}/{len(candidates)}] {candidate.name}: {state}")
    if all(row.problem for row in rows):
        raise FaceDiffError(f"no model could be scored, the first: {rows[0].name}: {rows[0].problem}")
    options = [*(models or []), *(f"--motion={word}" for word in motion or [])]
    options += [f"--flame={flame}"] if flame is not None else []
    options += [f"--languages={','.join(codes)}", f"--voices={voices}", f"--sentences={sentences}"]
    command = shlex.join(["facediff", "benchmark", "referee", *options])
    truth = judge(clips, {clip.name: reference(clip, FRAME_RATE) for clip in clips}, FRAME_RATE, None)
    standard = Judgement("reference", truth, frame_rate=FRAME_RATE)
    report = RefereeReport(clips, standard, rows, command, code_of(), device_name("cpu"))
    files = write_report(report, output)
    tell(*text(report).split("\n"), *(f"written: {path}" for path in files))
    return int(any(row.problem for row in rows))


def judged(candidate: Candidate, clips: Sequence[SpokenClip], flame: Path | None) -> Judgement:
    """The row of a model, which animates in a process of its own."""
    from facediff.benchmark.referee import Judgement, judge
    from facediff.pipelines.candidates import perform
    from facediff.utils.workers import WorkerDied, in_own_process

    motion = in_own_process(partial(perform, clips=clips, flame=flame), candidate)
    if isinstance(motion, WorkerDied):
        return Judgement(candidate.name, problem="killed its process, perhaps for lack of memory")
    if isinstance(motion, str):
        return Judgement(candidate.name, problem=motion)
    scores = judge(clips, motion.clips, motion.frame_rate, motion.jaw)
    facts = {"put on the face": motion.way, "licence": motion.licence, "commercial use": motion.commercial_use}
    return Judgement(candidate.name, scores, facts, motion.seconds, motion.memory, motion.frame_rate)


def candidates_of(
    models: Sequence[str], motion: Sequence[str], layout: str | None, frame_rate: float | None
) -> list[Candidate]:
    """The models to compare."""
    from facediff.pipelines.candidates import Candidate

    candidates: list[Candidate] = []
    for word in models:
        name, equals, path = word.partition("=")
        if not equals or Path(word).exists():
            name, path = Path(word).stem if Path(word).suffix == ".ckpt" else Path(word).name, word
        path = str(model_or_bundled(Path(path)))
        check_animating_source(path)
        candidates.append(Candidate(name, path))
    for name, folder in named_folders(motion).items():
        candidates.append(Candidate(name, motion=folder, layout=layout, frame_rate=frame_rate))
    if not candidates:
        candidates = [Candidate("puppet", str(BUNDLED))]
    names = [candidate.name for candidate in candidates]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise FaceDiffError(f"{repeated}: is the name of two models; name them with NAME=PATH")
    return candidates
