"""``facediff figure``: the figures of a paper, one command each."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError, choices

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.data import SpeechMotionDataModule
    from facediff.evaluation.figures import Material
    from facediff.mesh.mesh import Mesh

    Module = type[SpeechMotionDataModule]
    from facediff.evaluation.figures import Paper, Phoneme


# What lies beside the files that ``facediff figure`` draws: templates, mesh, frame rate, sound.

PUPPET = Path("puppet")
"""Stands for the built-in corpus where it lies in the user's cache folder."""


def named_folders(words: Sequence[str], name_of: Callable[[Path], str]) -> dict[str, Path]:
    """Folders by name, from words NAME=FOLDER or FOLDER.

    Args:
        words: what the user gave.
        name_of: names a folder that was given without a name.

    Raises:
        FaceDiffError: if a word is neither, or two folders have one name.
    """
    found: dict[str, Path] = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not equals or Path(word).exists():
            name, folder = name_of(Path(word)), word
        if not name or not folder:
            raise FaceDiffError(f"{word}: expected NAME=FOLDER")
        if name in found:
            raise FaceDiffError(f'{word}: there is already one called "{name}"; name it with NAME=FOLDER')
        found[name] = Path(folder)
    return found


def gather(args: argparse.Namespace) -> Material:
    """Find truth, methods and what is known about their mesh.

    Raises:
        FaceDiffError: if a folder or a file is missing, damaged, or does not fit the others.
    """
    from facediff.data.corpus import read_manifest, read_templates
    from facediff.evaluation import DEFAULT_PATTERNS, TRUTH_PATTERN
    from facediff.evaluation.figures import Material, find_clips
    from facediff.evaluation.files import find_truths

    methods = named_folders([args.predictions, *args.method], lambda path: path.resolve().name)
    truth, corpus = find_truths(_truth_folder(args.truth))
    if not truth.is_dir():
        raise FaceDiffError(f"{args.truth}: no such folder; expected a corpus, a folder of .npy files, or puppet")
    manifest = read_manifest(corpus) if corpus else {}
    module = _recognise(args.topology, corpus or truth, manifest)
    templates_file = args.templates or (corpus / "templates.pkl" if corpus else None)
    if templates_file is not None and args.templates is None and not templates_file.is_file():
        templates_file = None
    n_vertices = module.n_vertices if module else _count_vertices(templates_file, truth)
    templates = {} if templates_file is None else read_templates(templates_file, n_vertices)
    mesh = _find_mesh(args.mesh, corpus or truth, module, n_vertices)
    rate, stride = _rates(args, manifest, module)
    truths, found = find_clips(
        methods,
        truth,
        subjects=list(templates),
        patterns=args.pattern or DEFAULT_PATTERNS,
        truth_pattern=args.truth_pattern or TRUTH_PATTERN,
        identity=args.identity,
    )
    return Material(
        truths,
        found,
        n_vertices,
        rate,
        stride,
        args.unit or str(manifest.get("unit") or getattr(module, "unit", "")),
        templates,
        None if mesh is None else mesh.faces,
        None if mesh is None else mesh.vertices,
        None if mesh is None else mesh.colours,
        corpus,
        f"{module.corpus_name}: synthetic corpus" if module and module.synthetic else "",
    )


def read_sound(given: Path | None, material: Material, clip: str) -> npt.NDArray[np.float32] | None:
    """Speech (S,) of a clip at 16 kHz: the file given, else the corpus's; None if there is none.

    Raises:
        FaceDiffError: if the file given is missing or unreadable.
    """
    from facediff.data.audio import read_speech

    path = given
    if path is None and material.corpus is not None:
        path = material.corpus / "wav" / f"{material.truths[clip].path.stem}.wav"
        path = path if path.is_file() else None
    return None if path is None else read_speech(path)


def _truth_folder(truth: Path) -> Path:
    if truth != PUPPET or truth.is_dir():
        return truth
    from facediff.data.puppet import cache_root

    root = cache_root(0)
    if not root.is_dir():
        raise FaceDiffError(f"{root}: the built-in corpus is not there yet; `facediff demo` makes it")
    return root


def _recognise(name: str | None, root: Path, manifest: dict[str, Any]) -> Module | None:
    """The data module whose topology this is; None if that cannot be told."""
    import os
    import sys

    import facediff.data  # noqa: F401 - the data modules are known once they are imported
    from facediff.data.check.layouts import by_name, list_folder, recognise
    from facediff.data.corpus import MOTION_FOLDERS

    folder = list_folder(root, MOTION_FOLDERS)
    if name is not None:
        if "." in name:
            sys.path.append(os.getcwd())  # a data module of one's own may lie in the working folder
        return by_name(name, folder.n_vertices())
    if not folder.motions or isinstance(manifest.get("person"), str):
        return None
    module = recognise(folder, manifest.get("corpus"), folder.n_vertices())
    return module if module is not None and module.n_vertices == folder.n_vertices() else None


def _count_vertices(templates_file: Path | None, truth: Path) -> int:
    """Vertices of the mesh where no data module tells: as the templates have it, else the first readable truth."""
    from facediff.evaluation.files import count_vertices

    if templates_file is None and not any(truth.glob("**/*.npy")):
        raise FaceDiffError(f"{truth}: holds no .npy file; expected files of vertices (frames, 3V) or (frames, V, 3)")
    return count_vertices(None, templates_file, truth)


def _find_mesh(given: Path | None, root: Path, module: Module | None, n_vertices: int) -> Mesh | None:
    """The mesh given, else the one that lies in the corpus folder, else the built-in corpus's own; None without one."""
    from facediff.mesh.mesh import SUFFIXES, read_mesh

    if given is not None:
        mesh = read_mesh(given)
        if len(mesh.vertices) != n_vertices:
            raise FaceDiffError(f"{given}: has {len(mesh.vertices)} vertices, the motion {n_vertices}; give its mesh")
        return mesh
    places = [root, root / "templates"]
    files = [place / file for file in (module.mesh_files if module else ()) for place in places]
    files += [file for place in places for file in sorted(place.glob("*")) if file.suffix.lower() in SUFFIXES]
    for file in files:
        if file.is_file() and len((mesh := read_mesh(file)).vertices) == n_vertices:
            return mesh
    if module is not None and module.corpus_name == "puppet":
        from facediff.mesh.mesh import Mesh
        from facediff.synthetic.face import build_face

        face = build_face()
        return Mesh(face.vertices, face.faces.astype("int32"), face.colours)
    return None


def _rates(args: argparse.Namespace, manifest: dict[str, Any], module: Module | None) -> tuple[float | None, int]:
    """Frames a second of the predictions, and every how many-th frame of the truth belongs to them."""
    said = manifest.get("frame_rate") or (module and (module.stored_frame_rate or module.frame_rate))
    stored = float(said) if isinstance(said, int | float) else None
    rate = args.frame_rate if args.frame_rate is not None else module.frame_rate if module else stored
    if rate is not None and not 0 < rate < 10_000:
        raise FaceDiffError(f"--frame-rate {rate:g}: expected frames a second, e.g. 25")
    if args.truth_stride is not None:
        if args.truth_stride < 1:
            raise FaceDiffError(f"--truth-stride {args.truth_stride}: expected a number from 1")
        return rate, args.truth_stride
    if rate is None or stored is None:
        return rate, 1
    stride = round(stored / rate)
    if stride < 1 or abs(stride * rate - stored) > 1e-6:
        raise FaceDiffError(
            f"the truth has {stored:g} frames a second, no whole multiple of the predictions' {rate:g}; say what is "
            f"so with --frame-rate and --truth-stride"
        )
    return rate, stride


EPILOG = """\
PREDICTIONS are folders of .npy files of absolute vertices, (frames, V, 3) or (frames, 3V). TRUTH is a corpus folder
(its vertices_npy, wav, templates.pkl, regions, phonemes and mesh are used), any folder of .npy files, or `puppet`, the
built-in corpus. Exit status: 0 drawn, 2 something to put right."""
NOTES = 3
"""Notes that are printed at most."""


def run(name: str, arguments: Sequence[str]) -> int:
    """Find the figure and draw it.

    Raises:
        FaceDiffError: if there is no such figure, or for anything that the user can put right.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    figure, *rest = arguments
    if figure not in FIGURES:
        raise FaceDiffError(f'there is no command "figure {figure}": {choices(figure, FIGURES)}')
    args = parser(figure).parse_args(rest)
    from facediff.evaluation.figures.page import check_output, matplotlib

    matplotlib()
    check_output(args.output)
    notes = FIGURES[figure][2](args)
    for note in notes[:NOTES]:
        print(f"note: {note}")
    if len(notes) > NOTES:
        print(f"note: likewise {len(notes) - NOTES} more")
    print(f"written: {args.output}")
    return 0


def parser(figure: str) -> argparse.ArgumentParser:
    """Options of one of the figures."""
    description, options, _ = FIGURES[figure]
    made = argparse.ArgumentParser(
        f"facediff figure {figure}",
        description=description[:1].upper() + description[1:] + ".",
        epilog=None if figure == "training" else EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    options(made.add_argument)
    _page_options(made.add_argument)
    return made


def usage() -> str:
    """The help text."""
    lines = ["usage: facediff figure <figure> [options]", "", "figures:"]
    lines += [f"  {name:<10}{description}" for name, (description, _, _) in FIGURES.items()]
    return "\n".join([*lines, "", "`facediff figure <figure> --help` tells a figure's options"])


Add = Callable[..., argparse.Action]


def _page_options(add: Add) -> None:
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=".png, .pdf or .svg")
    add("--width", type=float, default=175.0, metavar="MM", help="175 (default) fills a page, 85 a column")
    add("--dpi", type=int, default=300, help="pixels an inch (default: 300)")
    add("--font", default="DejaVu Sans", help="an installed font (default: DejaVu Sans, which has the IPA)")


def _file_options(add: Add) -> None:
    add("predictions", metavar="PREDICTIONS", help="folder of predictions, or NAME=FOLDER")
    add("truth", metavar="TRUTH", type=Path, help="corpus folder, folder of truths, or puppet")
    add("--method", metavar="NAME=FOLDER", action="append", default=[], help="a further method, repeatable")
    add("--pattern", metavar="PATTERN", action="append", help="how predictions are named (see `facediff evaluate`)")
    add("--truth-pattern", metavar="PATTERN", help="how truths are named (default: {subject}_{sentence})")
    add("--identity", default="own", help="whose style predictions were given: own (default), or a name")
    add("--topology", "--corpus", metavar="NAME", help="biwi, vocaset, mead3d, puppet, or package.module.Class")
    add("--templates", type=Path, metavar="FILE", help="templates.pkl, each subject's neutral face")
    add("--mesh", type=Path, metavar="FILE", help=".ply or .obj with the faces")
    add("--frame-rate", type=float, metavar="FPS", help="frames a second of the predictions")
    add("--truth-stride", type=int, metavar="N", help="take every N-th frame of the truth (default: by the rates)")
    add("--unit", help="unit of the vertices, such as m (default: the corpus's)")


def _view_options(add: Add) -> None:
    _file_options(add)
    add("--view", choices=["front", "three_quarter", "side"], default="front", help="default: %(default)s")


def _frames_options(add: Add) -> None:
    _view_options(add)
    add("--clip", metavar="CLIP", help="<subject>_<sentence> (default: the first that all have)")
    add("--times", type=float, nargs="+", metavar="SECONDS", help="columns by time")
    add("--phonemes", nargs="+", metavar="IPA", help="columns by phoneme or viseme; m:2 is the clip's second /m/")
    add("--phoneme-file", type=Path, metavar="CSV", help="table of start, end, ipa (default: the corpus's)")
    add("--close-up", action="store_true", help="show the mouth only")
    add("--regions", type=Path, metavar="FOLDER", help="for --close-up: folder with lve.txt or FLAME_masks.pkl")
    add("--lips", metavar="FILE", help="for --close-up: the lips, as `facediff evaluate` takes them")


def _clips_options(add: Add) -> None:
    _view_options(add)
    add("--clips", nargs="+", metavar="CLIP", help="clips to count (default: all that truth and methods have)")


def _heatmap_options(add: Add) -> None:
    _clips_options(add)
    add("--highest-mean", type=float, metavar="VALUE", help="end of the mean's scale in the unit shown")
    add("--highest-std", type=float, metavar="VALUE", help="end of the standard deviation's scale")


def _error_options(add: Add) -> None:
    _clips_options(add)
    add("--statistic", choices=["mean", "max", "both"], default="mean", help="over frames (default: %(default)s)")
    add("--highest-mean", type=float, metavar="VALUE", help="end of the mean's scale in the unit shown")
    add("--highest-max", type=float, metavar="VALUE", help="end of the maximum's scale")


def _lips_options(add: Add) -> None:
    _file_options(add)
    add("--clip", metavar="CLIP", help="<subject>_<sentence> (default: the first that all have)")
    add("--lip-pairs", metavar="FILE", help="pairs of upper and lower lip vertices (default: the corpus's)")
    add("--audio", type=Path, metavar="FILE", help="the clip's speech (default: the corpus's)")
    add("--phoneme-file", type=Path, metavar="CSV", help="table of start, end, ipa (default: the corpus's)")
    add("--span", type=float, nargs=2, metavar=("FROM", "TO"), help="seconds to show (default: all)")


def _training_options(add: Add) -> None:
    add("runs", nargs="+", metavar="RUN", help="run folder with metrics.csv, or NAME=FOLDER")
    add("--scalar", action="append", metavar="NAME", help="such as val/lve, repeatable (default: train/loss, val/lve)")
    add("--smooth", type=float, default=0.0, metavar="W", help="weight of the past, 0 (default) to below 1")
    add("--log", action="store_true", help="logarithmic values")
    add("--x", choices=["step", "epoch"], default="step", help="what the curves are over (default: %(default)s)")


def _paper(args: argparse.Namespace) -> Paper:
    from facediff.evaluation.figures import Paper

    return Paper(args.width, args.dpi, args.font)


def _frames(args: argparse.Namespace) -> list[str]:
    from facediff.evaluation.figures import Moment, draw_frames, find_phoneme

    if bool(args.times) == bool(args.phonemes):
        raise FaceDiffError("choose what the columns show, with either --times or --phonemes")
    paper, material = _paper(args), gather(args)
    clip = material.choose([args.clip] if args.clip else None)[0]
    if args.times:
        moments = [Moment(time, _spoken_at(time, args, material, clip)) for time in args.times]
    else:
        phonemes = _phonemes(args, material, clip)
        if not phonemes:
            raise FaceDiffError(
                f"nothing says when which phoneme of {clip} is spoken; give --phoneme-file, a table with the columns "
                f"start, end (seconds) and ipa, or choose --times"
            )
        found = [find_phoneme(name, phonemes, clip) for name in args.phonemes]
        moments = [Moment(phoneme.middle, phoneme) for phoneme in found]
    region = None
    if args.close_up:
        from facediff.evaluation import read_region

        folder = args.regions or (material.corpus / "regions" if material.corpus else None)
        region = read_region("lips", material.n_vertices, folder=folder, source=args.lips).indices
    draw_frames(material, clip, moments, args.output, paper=paper, view=args.view, region=region)
    return []


def _phonemes(args: argparse.Namespace, material: Material, clip: str) -> list[Phoneme]:
    """Phonemes of a clip; none if nothing says them."""
    from facediff.evaluation.figures import read_phonemes
    from facediff.evaluation.figures.frames import phonemes_file

    path = args.phoneme_file or phonemes_file(material.corpus, material.truths[clip].path.stem)
    return read_phonemes(path) if path else []


def _spoken_at(time: float, args: argparse.Namespace, material: Material, clip: str) -> Phoneme | None:
    return next((p for p in _phonemes(args, material, clip) if p.start <= time < p.end), None)


def _heatmap(args: argparse.Namespace) -> list[str]:
    from facediff.evaluation.figures import draw_heatmap

    paper, material = _paper(args), gather(args)
    highest = (args.highest_mean, args.highest_std)
    clips = material.choose(args.clips)
    return draw_heatmap(material, clips, args.output, paper=paper, view=args.view, highest=highest)


def _error(args: argparse.Namespace) -> list[str]:
    from facediff.evaluation.figures import draw_error

    paper, material = _paper(args), gather(args)
    clips = material.choose(args.clips)
    highest = (args.highest_mean, args.highest_max)
    return draw_error(
        material, clips, args.output, paper=paper, view=args.view, statistic=args.statistic, highest=highest
    )


def _lips(args: argparse.Namespace) -> list[str]:
    from facediff.evaluation.figures import Sound, draw_lips, opening_curves, read_pairs

    paper, material = _paper(args), gather(args)
    clip = material.choose([args.clip] if args.clip else None)[0]
    pairs = read_pairs(args.lip_pairs, material.corpus, material.n_vertices)
    curves, note = opening_curves(material, clip, pairs)
    samples = read_sound(args.audio, material, clip)
    notes = [f"{clip}: {note}"] if note else []
    if samples is None:
        notes.append(f"there is no sound of {clip}; give --audio to have its waveform")
    phonemes = _phonemes(args, material, clip)
    sound = Sound(phonemes=phonemes) if samples is None else Sound(samples, phonemes=phonemes)
    span = tuple(args.span) if args.span else None
    draw_lips(curves, sound, args.output, paper=paper, scale=material.scale, span=span, remark=material.remark)
    return notes


def _training(args: argparse.Namespace) -> list[str]:
    from facediff.evaluation.figures import choose_scalars, draw_training, find_gaps, find_metrics, read_curves

    paper = _paper(args)
    folders = named_folders(args.runs, lambda path: "/".join(path.resolve().parts[-2:]).removeprefix("/"))
    runs = {name: read_curves(find_metrics(folder), args.x) for name, folder in folders.items()}
    scalars = choose_scalars(runs, args.scalar)
    draw_training(runs, scalars, args.output, paper=paper, axis=args.x, smoothing=args.smooth, log=args.log)
    return find_gaps(runs, scalars, log=args.log)


FIGURES: dict[str, tuple[str, Callable[[Add], None], Callable[[argparse.Namespace], list[str]]]] = {
    "frames": (
        "faces at chosen times or phonemes, the truth and the methods below one another",
        _frames_options,
        _frames,
    ),
    "heatmap": ("mean and standard deviation over time of each vertex's motion", _heatmap_options, _heatmap),
    "error": ("each vertex's error against the truth", _error_options, _error),
    "lips": ("lip opening over time, with phonemes and waveform beneath", _lips_options, _lips),
    "training": ("curves of one or several runs from their metrics.csv", _training_options, _training),
}
