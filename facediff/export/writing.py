"""Writing animations in the format that a suffix chooses: checks, names of files, and all files or none."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from facediff import registry
from facediff.animation import Animation, metres_per_unit
from facediff.animation.options import ExportOptions
from facediff.errors import FaceDiffError, MissingExtraError, OptionError, check_known, refuse_idle
from facediff.export.format import MARK, Format, check_animation, folder_of, speech_wav
from facediff.export.sequences import RECORD
from facediff.mesh.textures import has_textures
from facediff.utils.files import check_writable, put_in_place, scratch_folder

COMPANIONS = (b"facediff blendshape weights", b"facediff sequence")
"""A file of JSON that holds one of them may be replaced without having been named."""

OPTIONS = ("view", "size", "video_rate", "tolerance", "shapes", "tracks", "key_tolerance", "surface")
"""Options that some formats use."""


class _Formats(Mapping[str, Format]):
    """All registered formats by suffix; they are loaded when the first one is looked up."""

    def __getitem__(self, suffix: str) -> Format:
        if suffix not in list(self):
            raise KeyError(suffix)
        format_of_suffix: Format = registry.export_format.get(suffix[1:])()
        return format_of_suffix

    def __iter__(self) -> Iterator[str]:
        return iter([f".{name}" for name in registry.export_format.names()])

    def __len__(self) -> int:
        return len(registry.export_format.names())


FORMATS: Mapping[str, Format] = _Formats()
"""Format by suffix (``".glb"``): the built-in ones and those that installed packages have added."""


def write_animations(
    path: Path,
    animations: Sequence[Animation],
    options: ExportOptions | None = None,
    *,
    into: Path | None = None,
    own_shapes: bool = False,
    z_up: bool = False,
) -> list[Path]:
    """Write animations in the format that the suffix chooses; either all files appear, each complete, or none.

    Args:
        path: the file. If several animations are written in a format that holds one, their files are called
            ``NAME_sample1.glb``, ``NAME_sample2.glb`` …; a format of many files makes a folder (``hello.obj`` gives
            ``hello_obj/``).
        animations: at least one.
        options: the user's; the defaults if None.
        into: the file of the animations' mesh: to the copy of a .glb each animation is added where that is a .glb as
            well, else its texture coordinates and materials, or an .obj's, are written to .glb, and coordinates to USD.
        own_shapes: drive the shapes and bones that this .glb has, instead of adding shapes that move as the animation.
        z_up: whether z points up in that file. Formats that hold either axis then have z up too, unless the options
            choose one, so that the output fits the file.

    Returns:
        The written files and folders: first the animations, then their companions.

    Example:
        >>> write_animations(Path("hello.usdc"), [animation], ExportOptions(output_unit="cm", up="z"))  # doctest: +SKIP
        [PosixPath('hello.usdc'), PosixPath('hello.wav')]
    """
    options = options or ExportOptions()
    check_export(path, options, len(animations), weights=seeks_weights(path, options) and have_weights(animations))
    form = FORMATS[path.suffix]
    if z_up and options.up is None and "z" in form.up_axes:
        options = replace(options, up="z")
    if into is not None and not (into.suffix.lower() == path.suffix == ".glb"):
        if "surface" in form.uses and options.surface is None and has_textures(into):
            options = replace(options, surface=into)
        into = None
    if into is not None:
        refuse_idle(
            "has no effect on a copy of the target .glb",
            shapes=options.shapes is not None,
            surface=options.surface is not None,
            key_tolerance=options.key_tolerance != ExportOptions.key_tolerance,
            tolerance=own_shapes and options.tolerance != ExportOptions.tolerance,
        )
    for animation in animations:
        check_animation(animation, needs_mesh=form.needs_mesh)
    targets = _targets(path, form, len(animations))
    groups = [animations] if form.holds_several else [[animation] for animation in animations]
    for target, group in zip(targets, groups, strict=True):
        for companion in form.companions(target, group[0]):
            check_free(companion)
    speech_files = [
        _speech_file(target, form, group[0], options) for target, group in zip(targets, groups, strict=True)
    ]
    with scratch_folder(path) as hidden:
        try:
            for target, group, speech_file in zip(targets, groups, speech_files, strict=True):
                staged = hidden / target.name
                if into is None:
                    form.write(staged, group, replace(options, speech_file=speech_file))
                elif own_shapes:
                    from facediff.export.glb_own_shapes import drive_avatar

                    drive_avatar(staged, into, group[0])
                else:
                    from facediff.export.glb_added import add_to_glb

                    add_to_glb(staged, into, group[0], options.tolerance)
                if speech_file is not None and (wav := speech_wav(group[0])) is not None:
                    with ((folder_of(staged) if form.is_folder else hidden) / speech_file).open("wb") as stream:
                        stream.writelines(wav)
        except FaceDiffError as error:
            # The format's writer names the hidden folder, which the user has never seen.
            raise FaceDiffError(str(error).replace(str(hidden), str(path.parent))) from error
        written = sorted(hidden.iterdir())
        for file in written:
            put_in_place(file, path.with_name(file.name))
    for target, speech_file in zip(targets, speech_files, strict=True):
        stale = target.with_suffix(".wav")
        if form.speech == "next to it" and speech_file is None and stale.is_file() and is_free(stale):
            warnings.warn(f"{stale}: is of an earlier animation; {target.name} has no speech now", stacklevel=2)
    first = [(folder_of(target) if form.is_folder else target).name for target in targets]
    return [path.with_name(name) for name in [*first, *(file.name for file in written if file.name not in first)]]


def check_export(path: Path, options: ExportOptions, n_animations: int = 1, *, weights: bool = False) -> None:
    """Refuse wrong options before any work is done.

    Args:
        path: the file to write; its suffix chooses the format.
        options: the user's.
        n_animations: how many animations will be written.
        weights: whether the animations have, or may have, weights of ARKit's shapes by themselves.
    """
    suffix = path.suffix
    check_known(path, "format", [suffix], FORMATS)
    form = FORMATS[suffix]
    metres = 1.0 if options.output_unit is None else metres_per_unit(options.output_unit)
    reason = ""
    if (form.units == "none" and options.output_unit is not None) or (form.units == "m" and metres != 1):
        reason = f"{'holds no lengths' if form.units == 'none' else 'is in metres by its standard'}; omit the unit"
    elif options.up is not None and options.up not in form.up_axes:
        reason = f"{f'has {form.up_axes[0]} up by definition' if form.up_axes else 'holds no axes'}; omit the axis"
    if reason:
        raise FaceDiffError(f"{path}: {suffix} {reason}")
    if seeks_weights(path, options) and not weights:
        raise OptionError(
            "",
            f"{path}: {suffix} needs blendshapes; give {{shapes}}: a folder of meshes, a .glb with targets, or puppet",
        )
    if options.shapes is not None and (form.needs_shapes or "shapes" in form.uses):
        from facediff.editing.shapes import check_shapes

        check_shapes(Path(options.shapes))
    if form.requires is not None and importlib.util.find_spec(form.requires[0]) is None:
        raise MissingExtraError(*form.requires, f"writing {suffix}")
    for target in _targets(path, form, n_animations):
        check_writable(target)
        if form.is_folder:
            check_free(folder_of(target))


def seeks_weights(path: Path, options: ExportOptions) -> bool:
    """Whether a format needs blendshapes, and none are named: only then is it worth while to look for weights."""
    form = FORMATS.get(path.suffix)
    return form is not None and form.needs_shapes and options.shapes is None


def have_weights(animations: Sequence[Animation]) -> bool:
    """Whether animations have weights of ARKit's shapes, or are of the built-in face, which has such shapes."""
    from facediff.editing.blendshapes import has_arkit_weights

    return all(map(has_arkit_weights, animations))


def is_film(suffix: str) -> bool:
    """Whether a file of this suffix holds pictures of the face that move: a video or a GIF."""
    return suffix in FORMATS and "view" in FORMATS[suffix].uses


def check_used(suffix: str, option_names: Collection[str]) -> None:
    """Refuse options that the format of a suffix does not use; an unknown suffix is refused elsewhere.

    Args:
        suffix: of the file.
        option_names: names of the options that were given, as ``facediff export`` calls them.
    """
    form = FORMATS.get(suffix)
    if form is None:
        return
    problems: dict[str, str] = {}
    for name in OPTIONS:
        if name in option_names and name not in form.uses:
            users = [ending for ending, format_of_suffix in FORMATS.items() if name in format_of_suffix.uses]
            problems[name] = f"has no effect on {suffix}, but on {', '.join(users)}; omit it"
    if {"shapes", "tolerance"} <= {*option_names}:
        problems.setdefault("tolerance", "has no effect with {shapes}, which fixes the targets; omit one")
    if "key_tolerance" in option_names and "shapes" not in option_names:
        problems.setdefault("key_tolerance", "has no effect without the weights of {shapes}, which have keys; omit it")
    for name, problem in problems.items():
        raise OptionError(name, problem)


def _targets(path: Path, form: Format, count: int) -> list[Path]:
    """The files that the user asked for."""
    if form.holds_several or count == 1:
        return [path]
    return [path.with_name(f"{path.stem}_sample{index + 1}{path.suffix}") for index in range(count)]


def _speech_file(path: Path, form: Format, animation: Animation, options: ExportOptions) -> str | None:
    """Name of the .wav file: ``hello.wav``, or ``hello_speech.wav`` if the former is the user's; None without one."""
    if form.speech != "next to it" or options.no_speech or animation.speech is None:
        return None
    wav = path.with_suffix(".wav")
    if not form.is_folder and not is_free(wav):
        wav = path.with_name(f"{path.stem}_speech.wav")
        check_free(wav)
    return wav.name


def is_free(path: Path) -> bool:
    """Whether a path is not there, empty, or of facediff; for a folder, whether all of its files are."""
    if not path.exists():
        return True
    with suppress(OSError):  # a file that cannot be read is not ours
        if path.is_dir():
            files = list(path.iterdir())
            recorded = not files or (path / RECORD) in files
            return recorded and all(file.is_file() and is_free(file) for file in files)
        with path.open("rb") as stream:
            start = stream.read(200)
            ours = COMPANIONS if path.suffix == ".json" else (MARK,)  # a direction or answers, made by hand, say it too
            return not start or any(mark in start for mark in ours)
    return False


def check_free(path: Path) -> None:
    """Refuse a file or folder that the user did not name and that facediff did not write."""
    if not is_free(path):
        kind = "is a folder with files" if path.is_dir() else "is a file"
        raise FaceDiffError(
            f"{path}: {kind} that facediff did not write, and would be replaced; choose another -o, or move it"
        )
