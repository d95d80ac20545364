"""Making a study: clips and trials are chosen, videos are drawn, and the page and the key are written.

Videos are a batch that can be stopped and continued (:mod:`facediff.utils.batch`); ``study.json`` is written last, so
that a folder with it is complete. Names of videos are hashes of their content, so that an earlier study in the same
folder stays complete until the new one replaces it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, check_known, counted
from facediff.render import Camera, Renderer, side_by_side, write_video
from facediff.study.definition import DATABASE, PAGE_FOLDER, STUDY_FILE, VIDEO_FOLDER, Study, Trial
from facediff.study.design import STILL, TRUTH, Showing, make_forms, make_pairs, make_schedules
from facediff.study.material import MotionFile, StudyAnimations, StudyClip, in_unit_of, read_sound
from facediff.study.options import StudyOptions
from facediff.study.page import write_page
from facediff.study.texts import Questionnaire, check_languages
from facediff.utils.batch import RECORDS, FileTask, Recipe, run_batch
from facediff.utils.checksums import sha256
from facediff.utils.files import check_folder_writable, locked, remove_partial
from facediff.utils.progress import progress_bar
from facediff.version import __version__

LOCK = ".facediff-study.lock"
SECONDS_PER_PIXEL = 4e-8  # Drawing and encoding a pixel of a frame on one core


@dataclass(frozen=True)
class VideoTask(FileTask):
    """A video to draw: one face, or two side by side."""

    panels: tuple[tuple[MotionFile, bool], ...] = ()  # motion, and whether the face stays still
    camera: Camera | None = None
    colours: npt.NDArray[np.uint8] | None = None
    sound: Path | None = None
    frames: int | None = None  # all if None
    size: int = 384
    remark: str = ""


def draw(task: VideoTask) -> int:
    """Draw a video, whole or not at all; the number of its frames."""
    first = task.panels[0][0].read()
    animations = [in_unit_of(first, motion.read()) for motion, _ in task.panels]
    frames = task.frames or len(first.vertices)
    motions = [
        np.repeat(animation.template[None], frames, axis=0) if still else animation.vertices[:frames]
        for animation, (_, still) in zip(animations, task.panels, strict=True)
    ]
    renderers = [
        Renderer(
            animation.triangles,
            template=animation.template,
            size=task.size,
            camera=task.camera,
            colours=task.colours,
        )
        for animation in animations
    ]
    sound, rate = None, None
    if task.sound is not None:
        sound, rate = read_sound(task.sound, frames / first.frame_rate)
    pictures = side_by_side(renderers, motions, [""] * len(motions), footer=task.remark or None)
    return write_video(task.output, pictures, first.frame_rate, sound, rate)


@dataclass(frozen=True)
class StudyPlan:
    """A study after its files have been read and checked, before anything is written."""

    options: StudyOptions
    study: Study
    clips: Mapping[str, StudyClip]
    notes: tuple[str, ...]  # clips and questions that were left out, with the reasons
    videos: Mapping[str, VideoTask] = field(repr=False)

    @cached_property
    def seconds(self) -> float:
        """Roughly how long drawing takes on one core."""
        frames = sum(len(task.panels) * (task.frames or 100) for task in self.videos.values())
        return SECONDS_PER_PIXEL * self.options.size**2 * frames

    @property
    def minutes(self) -> float:
        """Minutes that a rater takes, if every video is seen once and every answer takes five seconds."""
        trials = self.study.trials_of(0)
        answering = 5 * len(self.study.choices) * len(trials)
        return (answering + sum(self.clips[trial.clip].seconds for trial in trials)) / 60

    def make(
        self, output: Path, *, workers: int | None = None, scheduler: str | None = "", progress: bool = True
    ) -> int:
        """Draw the videos and write the page and the key; the number of videos that were drawn.

        Videos of an earlier run with the same files and options are kept; ``workers`` and ``scheduler`` are as for
        :func:`facediff.utils.jobs.run_tasks`.
        """
        check_output(output, self.study)
        folder = output / PAGE_FOLDER / VIDEO_FOLDER
        tasks = [replace(task, output=folder / name, records=output) for name, task in self.videos.items()]
        with locked(output / LOCK, "facediff study make"):
            check_output(output, self.study)
            to_do = []
            for task in tasks:
                if task.change() or task.earlier_problem() != "":
                    remove_partial(folder, task.output.stem)
                    to_do.append(task)
            problems: list[str] = []
            outcomes = run_batch(
                draw,
                to_do,
                workers=workers,
                scheduler=scheduler,
                writes=output,
                reads=[task.source for task in to_do],
                record=VideoTask.record,
            )
            bar = progress_bar("drawing videos", len(to_do), shown=progress and bool(to_do))
            with bar as step, closing(outcomes):
                for _, outcome in outcomes:
                    problems += [outcome.problem] if outcome.problem else []
                    step()
            if problems:
                more = f" ({len(problems) - 1} more videos failed)" if len(problems) > 1 else ""
                raise FaceDiffError(
                    f"{problems[0]}{more}; put it right and run the same command again, which continues"
                )
            write_page(output / PAGE_FOLDER, self.study)
            self.study.write(output)
            for old in sorted(folder.iterdir()):
                if old.name not in self.videos and old.suffix in (".mp4", ".webm"):
                    old.unlink(missing_ok=True)
        return len(to_do)


def check_output(output: Path, study: Study) -> None:
    """Refuse a folder with other content than this study, or an earlier one without answers."""
    check_folder_writable(output)
    if not output.exists():
        return
    inside = [*output.iterdir(), *(output / PAGE_FOLDER).glob("*")]
    # A run that is killed before its first video is recorded leaves these.
    leftovers = {output / LOCK, output / PAGE_FOLDER, output / PAGE_FOLDER / VIDEO_FOLDER}
    is_study = (output / STUDY_FILE).is_file() or (output / RECORDS).is_dir()
    if not is_study and any(path not in leftovers and ".partial-" not in path.name for path in inside):
        raise FaceDiffError(f"{output}: is not empty, and holds no study; choose a new folder")
    if (output / DATABASE).exists():
        from facediff.study.store import count_raters, study_of

        stored = study_of(output / DATABASE)
        if stored not in (None, study.id) and count_raters(output / DATABASE):
            raise FaceDiffError(
                f"{output}: holds answers to another study, which this one would replace; choose a new folder"
            )


def plan_study(
    methods: Mapping[str, Path],
    options: StudyOptions | None = None,
    *,
    truth: Path | None = None,
    **sources: Any,  # noqa: ANN401 - passed on
) -> StudyPlan:
    """Choose clips, trials and schedules, after reading and checking every file.

    The first method is compared with the others and with the truth; ``sources`` are further arguments of
    :class:`StudyAnimations`.
    """
    options = options or StudyOptions()
    if len(methods) + (truth is not None) < 2:
        raise FaceDiffError("methods: there is nothing to compare; give the folders of two methods, or one and --truth")
    languages = check_languages(options.languages)
    questionnaire = Questionnaire(options.questions, languages)
    material = StudyAnimations(methods, truth, **sources)
    notes = [
        f"{name}: {counted(len(left), 'clip')} that others lack, left out: "
        f"{', '.join(left[:3])}{' …' if len(left) > 3 else ''}"
        for name, left in material.left_out.items()
        if left and name != TRUTH
    ]
    names = choose_clips(material, options)
    references = choose_references(material, names, questionnaire, options.seed)
    clips = {name: replace(material.open(name), reference=references.get(name)) for name in names}
    questions = [question for question in questionnaire.questions if references or not question.reference]
    if len(questions) < len(questionnaire.questions):
        notes.append("style is not asked about: a clip has no reference, another clip of the same speaker")
    still = options.still_controls if truth is not None else 0
    if options.still_controls and not still:
        notes.append("there are no controls against a still face, since no truth is given")
    forms = make_forms(
        names,
        make_pairs([*methods, *([TRUTH] if truth is not None else [])], options.pairs),
        design=options.design,
        still=still,
        same=options.same_controls,
        repeats=options.repeats,
        seed=options.seed,
    )
    showings, schedules = make_schedules(forms, options.seed)
    videos = Videos(material, options)
    study = Study(
        title=questionnaire.title,
        consent=questionnaire.consent,
        languages=tuple(languages),
        methods=tuple(methods),
        questions=tuple(questions),
        rule=questionnaire.rule,
        trials=tuple(videos.trial(showing, clips[showing.clip]) for showing in showings),
        schedules=tuple(map(tuple, schedules)),
        seed=options.seed,
        remark=material.remark,
        details={
            "options": {name: str(v) if isinstance(v, Path) else v for name, v in asdict(options).items()},
            "folders": {name: str(folder) for name, folder in methods.items()},
            "truth": None if truth is None else str(truth),
            "references": {name: clip.reference for name, clip in clips.items()},
        },
        version=__version__,
    )
    return StudyPlan(options, study, clips, tuple(notes), videos.tasks)


def choose_references(
    material: StudyAnimations, names: Sequence[str], questionnaire: Questionnaire, seed: int
) -> dict[str, str]:
    """A reference for each clip; empty if no question needs one, or if one is missing and style need not be asked."""
    if not any(question.reference for question in questionnaire.questions):
        return {}
    rng = np.random.default_rng([seed, 2])
    references = {name: material.reference(name, names, rng) for name in names}
    without = next((name for name, reference in references.items() if reference is None), None)
    if without is not None and questionnaire.named:
        raise FaceDiffError(
            f"{without}: has no reference, another clip of the same speaker, which a question needs; give them "
            f"with --style-references or --truth, or ask no question with reference: true"
        )
    return {} if without is not None else {name: str(reference) for name, reference in references.items()}


def choose_clips(material: StudyAnimations, options: StudyOptions) -> list[str]:
    """The clips of the options, or a seeded choice, evenly among the speakers."""
    if options.clips is not None:
        check_known("--clips", "common clip", options.clips, material.clips)
        return list(dict.fromkeys(options.clips))
    rng = np.random.default_rng([options.seed, 0])
    by_subject: dict[str, list[str]] = {}
    for index in rng.permutation(len(material.clips)):
        clip = material.clips[index]
        by_subject.setdefault(material.subject(clip), []).append(clip)
    queues = [by_subject[subject] for subject in sorted(by_subject)]
    turns = [queue[turn] for turn in range(max(map(len, queues))) for queue in queues if turn < len(queue)]
    return sorted(turns[: options.max_clips])


class Videos:
    """The videos of a study, each once; their names are hashes of their content, and reveal nothing.

    Attributes:
        tasks: by name.
    """

    def __init__(self, material: StudyAnimations, options: StudyOptions) -> None:
        self.material, self.options = material, options
        self.tasks: dict[str, VideoTask] = {}
        self._digest = cache(sha256)

    def trial(self, showing: Showing, clip: StudyClip) -> Trial:
        """A trial of a clip, with its video and its reference's."""
        panels = tuple((clip.motion(condition), condition == STILL) for condition in (showing.left, showing.right))
        camera = Camera.framing(list(clip.templates), view=self.options.view)
        name = self._add(panels, camera, clip.colours, clip.sound, clip.frames)
        reference = None if clip.reference is None else self._reference(clip.reference)
        trial = hashlib.sha256(f"{self.options.seed}/{showing}/{name}".encode()).hexdigest()[:16]
        return Trial(trial, showing.kind, showing.clip, showing.left, showing.right, name, reference)

    def _reference(self, clip: str) -> str:
        motion = self.material.references[clip]
        animation = motion.read()
        sound = self.material.sound_of(clip, motion)
        if sound == motion.path and animation.speech is None:
            sound = None
        camera = Camera.framing([animation.template], view=self.options.view)
        return self._add(((motion, False),), camera, animation.colours, sound, len(animation.vertices))

    def _add(
        self,
        panels: tuple[tuple[MotionFile, bool], ...],
        camera: Camera,
        colours: npt.NDArray[np.uint8] | None,
        sound: Path | None,
        frames: int,
    ) -> str:
        """A task without its output, named by the recipe."""
        files = {path: self._digest(path) for path in (*(motion.path for motion, _ in panels), sound) if path}
        facts = {
            "panels": [[motion.digest(), still, files[motion.path]] for motion, still in panels],
            "camera": asdict(camera),
            "colours": None if colours is None else hashlib.sha256(colours.tobytes()).hexdigest(),
            "sound": None if sound is None else files[sound],
            "frames": frames,
            "size": self.options.size,
            "remark": self.material.remark,
        }
        text = json.dumps(facts, sort_keys=True)
        name = f"{hashlib.sha256(f'{self.options.seed}/{text}'.encode()).hexdigest()[:16]}.{self.options.video}"
        recipe = Recipe((text,), {str(path): digest for path, digest in files.items()})
        if name not in self.tasks:
            self.tasks[name] = VideoTask(
                source=panels[0][0].path,
                output=Path(),
                recipe=recipe,
                panels=panels,
                camera=camera,
                colours=colours,
                sound=sound,
                frames=frames,
                size=self.options.size,
                remark=self.material.remark,
            )
        return name
