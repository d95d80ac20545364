"""Making a study: clips and trials are chosen, videos are drawn, and the page and the key are written.

Videos are a batch that can be stopped and continued (:mod:`facediff.utils.batch`); ``study.json`` is written last, so
that a folder with it is complete. Names of videos follow from what they show, so that an earlier study in the same
folder stays whole until the new one replaces it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, choices, counted
from facediff.render import Camera, Renderer, side_by_side, write_video
from facediff.study.definition import DATABASE, PAGE_FOLDER, STUDY_FILE, VIDEO_FOLDER, Study, Trial
from facediff.study.design import STILL, TRUTH, Design, Pairs, Showing, make_forms, make_pairs, make_schedules
from facediff.study.material import MotionFile, StudyAnimations, StudyClip, in_unit_of, read_sound
from facediff.study.page import write_page
from facediff.study.texts import Questionnaire, check_languages
from facediff.utils import ranges
from facediff.utils.batch import RECORDS, FileTask, Recipe, run_batch
from facediff.utils.checksums import sha256
from facediff.utils.files import check_folder_writable, locked, remove_partial
from facediff.utils.progress import progress_bar
from facediff.utils.ranges import Range
from facediff.version import __version__

LOCK = ".facediff-study.lock"
SECONDS_PER_PIXEL = 4e-8  # What drawing and encoding a pixel of a frame takes on one core

Count = Annotated[int, Range(0, 50)]


@dataclass(frozen=True)
class StudyOptions:
    """How a study is made.

    Attributes:
        clips: names of the clips; a seeded choice of all that every method has if None.
        max_clips: that are chosen at most, evenly among the speakers.
        design: ``latin``: every rater sees every clip once, with pairs that change from rater to rater; ``all``: every
            clip with every pair.
        pairs: the first method with each other one and the truth, or ``all`` with all.
        still: controls of the truth against a still face; none without a truth.
        same: controls of one animation on both sides.
        repeats: pairs that come a second time with their sides exchanged.
        questions: YAML file of questions, texts and the rule of exclusion; the paper's questions if None.
        languages: of the page; all that are bundled if None.
        seed: of the choice of clips, of the design and of the references.
        size: height and width of a face in pixels.
        view: camera.
        video: format of the videos.
    """

    clips: Sequence[str] | None = None
    max_clips: ranges.Samples = 12
    design: Design = "latin"
    pairs: Pairs = "first"
    still: Count = 3
    same: Count = 1
    repeats: Count = 1
    questions: Path | None = None
    languages: Sequence[str] | None = None
    seed: ranges.Seed = 0
    size: ranges.Pixels = 384
    view: str = "front"
    video: Literal["mp4", "webm"] = "mp4"

    def __post_init__(self) -> None:
        ranges.check_options(self)


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
    """A study whose files have been read and checked, before anything is written.

    Attributes:
        study: what it asks.
        clips: the clips by name.
        notes: what was left out, and why.
    """

    material: StudyAnimations
    options: StudyOptions
    study: Study
    clips: Mapping[str, StudyClip]
    notes: tuple[str, ...]
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
        asked = 5 * len(self.study.choices) * len(trials)
        return (asked + sum(self.clips[trial.clip].seconds for trial in trials)) / 60

    def make(
        self, output: Path, *, workers: int | None = None, scheduler: str | None = "", progress: bool = True
    ) -> int:
        """Draw the videos and write the page and the key; the number of videos that were drawn.

        What an earlier run has drawn of the same files and options is kept.

        Args:
            output: the study's folder.
            workers: videos at a time; as many as processors, or workers of a cluster, if None.
            scheduler: where they are drawn; see :func:`facediff.utils.jobs.run_tasks`.
            progress: whether a progress bar is shown.

        Raises:
            FaceDiffError: if the folder holds anything else or a study with answers, or a video cannot be drawn.
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
    """Refuse a folder that holds anything but this study, or an earlier one that nobody has answered."""
    check_folder_writable(output)
    if not output.exists():
        return
    inside = [*output.iterdir(), *(output / PAGE_FOLDER).glob("*")]
    # What a run leaves that is killed before its first video is recorded.
    begun = {output / LOCK, output / PAGE_FOLDER, output / PAGE_FOLDER / VIDEO_FOLDER}
    own = (output / STUDY_FILE).is_file() or (output / RECORDS).is_dir()
    if not own and any(path not in begun and ".partial-" not in path.name for path in inside):
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
    references: Path | None = None,
    identity: str = "own",
    speech: Path | None = None,
    mesh: Path | None = None,
    frame_rate: float | None = None,
    unit: str | None = None,
) -> StudyPlan:
    """Choose clips, trials and schedules, after reading and checking every file that is shown.

    Args:
        methods: each method's folder; the first is compared with the others and with the truth.
        options: how the study is made.
        truth: a corpus folder, a folder of animations, or ``puppet``; None for a study without truth.
        references: folder of animations of the same speakers, shown with questions of style.
        identity: whose style the predictions were given: ``own``, or an identity's name.
        speech: folder of recordings; the corpus's, or those that the animations hold, if None.
        mesh: what bare arrays lack: a file with the triangles.
        frame_rate: frames a second of bare arrays.
        unit: unit of length of bare arrays.
    """
    options = options or StudyOptions()
    if len(methods) + (truth is not None) < 2:
        raise FaceDiffError("methods: there is nothing to compare; give the folders of two methods, or one and --truth")
    languages = check_languages(options.languages)
    questionnaire = Questionnaire(options.questions, languages)
    material = StudyAnimations(
        methods,
        truth,
        references=references,
        identity=identity,
        speech=speech,
        mesh=mesh,
        frame_rate=frame_rate,
        unit=unit,
    )
    notes = [
        f"{name}: {counted(len(left), 'clip')} that others lack, left out: "
        f"{', '.join(left[:3])}{' …' if len(left) > 3 else ''}"
        for name, left in material.left_out.items()
        if left and name != TRUTH
    ]
    names = choose_clips(material, options)
    clips = {name: material.open(name) for name in names}
    questions = questionnaire.questions
    if any(question.reference for question in questions):
        rng = np.random.default_rng([options.seed, 2])
        references_by_clip = {name: material.reference(name, names, rng) for name in names}
        without = [name for name, reference in references_by_clip.items() if reference is None]
        if without and questionnaire.chosen:
            raise FaceDiffError(
                f"{without[0]}: has no reference, another clip of the same speaker, which a question needs; give them "
                f"with --style-references or --truth, or ask no question with reference: true"
            )
        if without:
            notes.append(f"style is not asked about: {without[0]} has no reference, another clip of the same speaker")
            questions = [question for question in questions if not question.reference]
        else:
            clips = {name: replace(clip, reference=references_by_clip[name]) for name, clip in clips.items()}
    still = options.still if truth is not None else 0
    if options.still and not still:
        notes.append("there are no controls against a still face, since no truth is given")
    conditions = [*material.methods, *([TRUTH] if truth is not None else [])]
    forms = make_forms(
        names,
        make_pairs(conditions, options.pairs),
        design=options.design,
        still=still,
        same=options.same,
        repeats=options.repeats,
        seed=options.seed,
    )
    showings, schedules = make_schedules(forms, options.seed)
    videos: dict[str, VideoTask] = {}
    trials = _trials(material, clips, showings, options, videos)
    study = Study(
        title=questionnaire.title,
        consent=questionnaire.consent,
        languages=tuple(languages),
        methods=tuple(material.methods),
        questions=tuple(questions),
        rule=questionnaire.rule,
        trials=tuple(trials),
        schedules=tuple(map(tuple, schedules)),
        seed=options.seed,
        remark=material.remark,
        details={
            "options": {name: _plain(value) for name, value in asdict(options).items()},
            "folders": {name: str(folder) for name, folder in methods.items()},
            "truth": None if truth is None else str(truth),
            "references": {name: clip.reference for name, clip in clips.items()},
        },
        version=__version__,
    )
    return StudyPlan(material, options, study, clips, tuple(notes), videos)


def choose_clips(material: StudyAnimations, options: StudyOptions) -> list[str]:
    """The clips that are asked for, or a seeded choice, evenly among the speakers."""
    if options.clips is not None:
        for name in options.clips:
            if name not in material.clips:
                raise FaceDiffError(f'--clips: not all have a clip "{name}": {choices(name, material.clips)}')
        return list(dict.fromkeys(options.clips))
    rng = np.random.default_rng([options.seed, 0])
    by_subject: dict[str, list[str]] = {}
    for index in rng.permutation(len(material.clips)):
        clip = material.clips[index]
        by_subject.setdefault(material.subject(clip), []).append(clip)
    queues = [by_subject[subject] for subject in sorted(by_subject)]
    turns = [queue[turn] for turn in range(max(map(len, queues))) for queue in queues if turn < len(queue)]
    return sorted(turns[: options.max_clips])


def _trials(
    material: StudyAnimations,
    clips: Mapping[str, StudyClip],
    showings: Sequence[Showing],
    options: StudyOptions,
    videos: dict[str, VideoTask],
) -> list[Trial]:
    """The trials; their videos are added to ``videos``, by name."""
    digests: dict[Path, str] = {}
    references: dict[str, str] = {}
    trials = []
    for showing in showings:
        clip = clips[showing.clip]
        task = _pair_task(material, clip, showing, options, digests)
        name = _video_name(task, options)
        videos.setdefault(name, task)
        reference = None
        if clip.reference is not None:
            if clip.reference not in references:
                shown = _reference_task(material, clip.reference, options, digests)
                references[clip.reference] = _video_name(shown, options)
                videos.setdefault(references[clip.reference], shown)
            reference = references[clip.reference]
        trial = hashlib.sha256(f"{options.seed}/{showing}/{name}".encode()).hexdigest()[:16]
        trials.append(Trial(trial, showing.kind, showing.clip, showing.left, showing.right, name, reference))
    return trials


def _pair_task(
    material: StudyAnimations, clip: StudyClip, showing: Showing, options: StudyOptions, digests: dict[Path, str]
) -> VideoTask:
    panels = tuple((clip.motion(condition), condition == STILL) for condition in (showing.left, showing.right))
    camera = Camera.framing(list(clip.templates), view=options.view)
    return _task(panels, camera, clip.colours, clip.sound, clip.frames, material.remark, options, digests)


def _reference_task(material: StudyAnimations, name: str, options: StudyOptions, digests: dict[Path, str]) -> VideoTask:
    motion = material.references[name]
    animation = motion.read()
    sound = material.sound_of(name, motion)
    if sound is not None and sound == motion.path and animation.speech is None:
        sound = None
    camera = Camera.framing([animation.template], view=options.view)
    frames = len(animation.vertices)
    return _task(((motion, False),), camera, animation.colours, sound, frames, material.remark, options, digests)


def _task(
    panels: tuple[tuple[MotionFile, bool], ...],
    camera: Camera,
    colours: npt.NDArray[np.uint8] | None,
    sound: Path | None,
    frames: int,
    remark: str,
    options: StudyOptions,
    digests: dict[Path, str],
) -> VideoTask:
    """A task without its output, whose name follows from the recipe."""
    files = [path for path in (*(motion.path for motion, _ in panels), sound) if path is not None]
    for path in files:
        digests.setdefault(path, sha256(path))
    facts = {
        "panels": [[motion.digest(), still, digests[motion.path]] for motion, still in panels],
        "camera": asdict(camera),
        "colours": None if colours is None else hashlib.sha256(colours.tobytes()).hexdigest(),
        "sound": None if sound is None else digests[sound],
        "frames": frames,
        "size": options.size,
        "remark": remark,
    }
    recipe = Recipe((json.dumps(facts, sort_keys=True),), {str(path): digests[path] for path in files})
    return VideoTask(
        source=panels[0][0].path,
        output=Path(),
        recipe=recipe,
        panels=panels,
        camera=camera,
        colours=colours,
        sound=sound,
        frames=frames,
        size=options.size,
        remark=remark,
    )


def _video_name(task: VideoTask, options: StudyOptions) -> str:
    """A name that says nothing about what is shown, and changes with it."""
    digest = hashlib.sha256(f"{options.seed}/{task.recipe.command[0]}".encode()).hexdigest()
    return f"{digest[:16]}.{options.video}"


def _plain(value: Any) -> Any:  # noqa: ANN401
    return str(value) if isinstance(value, Path) else value
