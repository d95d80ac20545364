"""Animations as Python shows them: read from files, played in notebooks, compared, edited and written.

From top to bottom: methods of :class:`~facediff.animation.Animation`; several :class:`Samples` of one
recording; :class:`Page`, animations that play side by side in a browser or a notebook; :func:`view`, which makes pages;
:func:`read`, which opens motion files.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast

from facediff.animation import Animation
from facediff.animation.archives import AnimationFacts, complete, facts_of, read_animation
from facediff.animation.options import AnimationControls, ExportKeywords, ExportOptions, SourceOptions, with_options
from facediff.errors import OptionError, check_known, note, refuse_idle
from facediff.utils.hub import bundled_by_name, is_graphs
from facediff.utils.paths import from_home

if TYPE_CHECKING:
    from facediff.editing.blendshapes import SolveOptions, Weights
    from facediff.editing.shapes import ShapeSet

INLINE_MB = 8.0
"""The largest page that a notebook shows; of a larger one, it shows the beginning. A notebook keeps its pages."""
DIFFERS = 0.2
"""Seconds by which a motion and its speech may differ without a note."""
TRIED_FRAMES = 64
"""Frames by which the size of a page is estimated."""
INLINE_HEIGHT = 540
"""Pixels that a page takes in a notebook."""


def save(animations: Sequence[Animation], path: str | Path, options: ExportKeywords) -> list[Path]:
    """Write animations of one recording: :meth:`Animation.save` and :meth:`Samples.save`."""
    from facediff.export import check_used, write_animations

    settings = {name: value for name, value in options.items() if value is not None}
    path = Path(from_home(path))
    check_used(path.suffix, settings)
    return write_animations(path, animations, ExportOptions(**settings))  # type: ignore[arg-type]  # of a TypedDict


def compare(
    animations: Sequence[Animation], truth: Animation, output: str | Path | None, labels: Sequence[str] | None
) -> Page:
    """Animations next to the truth: :meth:`Animation.compare` and :meth:`Samples.compare`."""
    names = [animation.name for animation in animations]
    if labels is None and truth.name in names:  # as of one recording
        labels = ["truth", *names]
    page = view(animations, truth=truth, labels=labels, shortest=True)
    if output is not None:
        page.save(output)
    return page


def control(animation: Animation, controls: AnimationControls) -> Animation:
    """An animation with controls applied: :meth:`Animation.control`."""
    from facediff.editing.controls import check_controls
    from facediff.editing.controls.controlled_face import apply_controls

    check_controls(controls)
    return apply_controls(animation, controls)


def retarget(
    animation: Animation,
    mesh: str | Path,
    map_file: str | Path | None,
    landmarks: str | Path | None,
    accept_poor: bool = False,  # noqa: FBT001, FBT002 - of the method
) -> Animation:
    """The motion on another mesh: :meth:`Animation.retarget`."""
    from facediff.editing.fit_check import refuse_poor
    from facediff.editing.retargeting import retarget as transfer

    for option, file in (("target_mesh", mesh), ("landmarks", landmarks)):
        if file is not None and not Path(file).is_file():
            raise OptionError(option, "no such file; expected a mesh or a table of its vertices", file)
    files = [None if file is None else Path(file) for file in (map_file, landmarks)]
    if accept_poor or (files[0] is not None and files[0].exists()):  # a map that exists was accepted when it was made
        return transfer(animation, Path(mesh), *files)[0]
    return transfer(animation, Path(mesh), *files, check=lambda _, __, report: refuse_poor(mesh, report))[0]


def drive(animation: Animation, avatar: str | Path, path: str | Path) -> list[Path]:
    """A copy of an avatar that plays the motion: :meth:`Animation.drive`."""
    from facediff.export import write_animations

    return write_animations(Path(path), [animation], into=Path(avatar), own_shapes=True)


def blendshapes(animation: Animation, shapes: str | Path, *, carry: bool, only_arkit: bool, **options: Any) -> Weights:  # noqa: ANN401 - fields of SolveOptions
    """Weights of blendshapes: :meth:`Animation.blendshapes`."""
    from facediff.editing.blendshapes import SolveOptions

    solving = SolveOptions(**options)
    return solve_weights(animation, Path(shapes), solving, carry=carry, only_arkit=only_arkit)[1]


class Samples(list[Animation]):
    """Several samples for one recording: a list of animations that are written, shown and compared together."""

    @with_options(ExportOptions, ExportKeywords)
    def save(self, path: str | Path, **options: Unpack[ExportKeywords]) -> list[Path]:
        """Write all of them, as :meth:`Animation.save` writes one.

        Formats that show several, .html and .mp4, show them side by side; of others, ``x.glb`` becomes
        ``x_sample1.glb``, ``x_sample2.glb`` …

        Args:
            path: the file; its suffix chooses the format.
            options: listed below.
        """
        return save(self, path, options)

    def compare(
        self, truth: Animation, output: str | Path | None = None, *, labels: Sequence[str] | None = None
    ) -> Page:
        """All of them next to the truth, three at most; with the arguments of :meth:`Animation.compare`."""
        return compare(self, truth, output, labels)

    def _repr_html_(self) -> str | None:
        return Page(self[:4])._repr_html_() if self else None


class Page:
    """Animations that play side by side, in a notebook or in one .html file that loads nothing from anywhere.

    Args:
        animations: 1 to 4 of one frame rate and one length.
        truth: number of the one that the others are compared with, by heat maps; None for none.
    """

    def __init__(self, animations: Sequence[Animation], truth: int | None = None) -> None:
        self.animations, self.truth = list(animations), truth

    def save(self, path: str | Path) -> Path:
        """Write the page to an .html file."""
        from facediff.export.viewer import write_page

        path = Path(path)
        check_known(path, "format of a page", [path.suffix], (".html", ".htm"))
        write_page(path, self.animations, truth=self.truth)
        return path

    def html(self) -> str:
        """The text of the page.

        Raises:
            FaceDiffError: if the animations do not make a page.
        """
        from facediff.export.viewer import page_parts

        return "".join(page_parts(self.animations, truth=self.truth))

    def beginning(self, frames: int) -> Page:
        """The page with the first frames only."""
        return Page([animation.part(slice(frames)) for animation in self.animations], self.truth)

    def _repr_html_(self) -> str | None:
        """The page in a frame of a notebook; of a page that is too large, the beginning; None without a mesh."""
        if any(animation.faces is None or not len(animation.faces) for animation in self.animations):
            return None
        length = frames = len(self.animations[0].vertices)
        # A page grows with its frames nearly in proportion, but for the meshes. Tried on few frames first: packing an
        # hour only to see that it is too large would take minutes.
        page = self if length <= TRIED_FRAMES else self.beginning(TRIED_FRAMES)
        text = page.html()
        if page is not self:
            frames = min(length, max(TRIED_FRAMES, int(0.95 * TRIED_FRAMES * INLINE_MB / (len(text) / 1e6))))
            page = self if frames == length else self.beginning(frames)
            text = page.html()
        note = ""
        if page is not self:
            note = (
                f"<p>The first {page.animations[0].seconds:.1f} of {self.animations[0].seconds:.1f} s, since a "
                f"notebook keeps what it shows; <code>save(&quot;page.html&quot;)</code> writes all of it.</p>"
            )
        title = html.escape(" · ".join(animation.name for animation in self.animations))
        # In a frame of its own origin, the page's script can do nothing to the notebook; and it may load nothing.
        return (
            f'<iframe srcdoc="{html.escape(text)}" title="{title}" sandbox="allow-scripts allow-downloads" '
            f'allow="autoplay" style="width: 100%; height: {INLINE_HEIGHT}px; border: 0"></iframe>{note}'
        )

    def __repr__(self) -> str:
        names = [
            f"{animation.name} (truth)" if number == self.truth else animation.name
            for number, animation in enumerate(self.animations)
        ]
        first = self.animations[0]
        return (
            f"Page({', '.join(names)}: {len(first.vertices)} frames, {first.seconds:.2f} s; "
            f'save("page.html") writes it)'
        )


def view(
    animations: Animation | Sequence[Animation],
    *,
    truth: Animation | None = None,
    labels: Sequence[str] | None = None,
    shortest: bool = False,
) -> Page:
    """A page that plays animations side by side with their speech, in a notebook or any browser.

    Args:
        animations: one, or up to four with the truth among them, of one frame rate.
        truth: reference of the comparison: shown first, and in heat maps.
        labels: names to show, the truth's first.
        shortest: cut all to the shortest instead of refusing.

    Raises:
        FaceDiffError: if the animations do not make a page.

    Example:
        >>> facediff.view([calm, lively], labels=["calm", "lively"]).save("both.html")  # doctest: +SKIP
        PosixPath('both.html')
    """
    predictions = [animations] if isinstance(animations, Animation) else list(animations)
    panels = [*([] if truth is None else [truth]), *predictions]
    if labels is not None and len(labels) != len(panels):
        raise OptionError.naming(
            f"{{labels}}: {len(labels)} names for {len(panels)} panels; give one for each, the truth's first"
        )
    if labels is not None:
        panels = [replace(animation, name=label) for animation, label in zip(panels, labels, strict=True)]
    if shortest:
        frames = min(len(animation.vertices) for animation in panels)
        panels = [animation.part(slice(frames)) for animation in panels]
    from facediff.export.viewer.page import check_page

    number = None if truth is None else 0
    check_page(panels)
    return Page(panels, number)


def read(
    path: str | Path,
    *,
    like: Animation | None = None,
    mesh: str | Path | None = None,
    checkpoint: str | Path | Any | None = None,  # noqa: ANN401 - or a loaded model
    identity: str | None = None,
    speech: str | Path | None = None,
    frame_rate: float | None = None,
    unit: str | None = None,
) -> Animation:
    """Read a motion file: .npz as :meth:`Animation.save` writes it, or .npy of absolute vertices (T, V, 3) or (T, 3V).

    A .csv or .json of ARKit's weights, such as a take of Live Link Face, is played by the built-in face. What a bare
    array does not say is taken from the other arguments: first from those that name it, then from the checkpoint, then
    from ``like``.

    Args:
        path: the file.
        like: an animation of the same topology, for the neutral face, triangles, frame rate, unit and regions.
        mesh: neutral face with triangles: .ply, .obj, .glb …
        checkpoint: source of missing facts: a checkpoint or a loaded model.
        identity: the face in the checkpoint; the first one trained on if None.
        speech: the recording that the motion belongs to.
        frame_rate: frames a second.
        unit: unit of length: m, cm, mm, in, or a number of metres.

    Raises:
        FaceDiffError: if a file cannot be read, nothing says the frame rate, or the parts do not fit one another.

    Example:
        >>> truth = facediff.read("vertices_npy/F1_e28.npy", like=animation)  # doctest: +SKIP
    """
    options = SourceOptions(mesh, checkpoint, identity, speech, frame_rate, unit)
    return SourceReader(options).read(Path(from_home(path)), like)


class SourceReader:
    """Reads motion files, and completes bare arrays of vertices by what options say.

    Args:
        options: facts that the arrays lack.

    Raises:
        FaceDiffError: if an identity is named, and no checkpoint that has it.
    """

    def __init__(self, options: SourceOptions) -> None:
        if options.checkpoint is None:
            refuse_idle("has no effect without {checkpoint}", identity=options.identity is not None)
        self.options = options

    @cached_property
    def facts(self) -> tuple[AnimationFacts, AnimationFacts | None]:
        """Facts of the options, which override a file; and of the checkpoint, which complete it."""
        import numpy as np

        from facediff.mesh import read_mesh

        options = self.options
        overrides: dict[str, Any] = {}
        defaults = None
        if options.checkpoint is not None:
            defaults = _facts_of_model(options.checkpoint, options.identity)
            if options.identity is not None:
                overrides["template"] = defaults["template"]
        if options.mesh is not None:
            mesh = read_mesh(Path(options.mesh))
            overrides |= {"template": mesh.vertices.astype(np.float32), "faces": mesh.faces}
            overrides |= {} if mesh.colours is None else {"colours": mesh.colours}
        if options.speech is not None:
            from facediff.speech.audio import read_recording

            recording = read_recording(Path(options.speech))
            overrides |= {"speech": recording.sound, "sample_rate": recording.rate}
        overrides |= {} if options.frame_rate is None else {"frame_rate": options.frame_rate}
        overrides |= {} if options.unit is None else {"unit": options.unit}
        return cast("AnimationFacts", overrides), defaults

    def read(self, path: Path, lender: Animation | None = None) -> Animation:
        """The animation in a file, completed by this, then by another animation; all of its frames are finite.

        Raises:
            FaceDiffError: if it cannot be read, or says another frame rate or unit than the options.
        """
        overrides, defaults = self.facts
        bare = path.suffix.lower() == ".npy"
        if not bare:
            # Another frame rate would play the motion faster than its speech, another unit change the face's size.
            overrides = cast("AnimationFacts", {k: v for k, v in overrides.items() if k not in ("frame_rate", "unit")})
        if lender is not None:
            defaults = complete(defaults or {}, facts_of(lender))
        from facediff.editing.recorded_weights import SUFFIXES, read_weights

        if path.suffix.lower() in SUFFIXES:
            recorded = read_weights(path)
            animation = replace(recorded, **complete(overrides, facts_of(recorded)))
        else:
            animation = read_animation(path, overrides, defaults)
        for option, value in (("frame_rate", animation.frame_rate), ("unit", animation.unit)):
            contradicts = not bare and getattr(self.options, option) not in (None, value)
            refuse_idle(f"is for a bare .npy, and {path.name} has {value} by itself", **{option: contradicts})
        animation.refuse_not_finite()
        if self.options.speech is not None and animation.speech is not None:
            lasts = len(animation.speech) / animation.sample_rate
            if abs(lasts - animation.seconds) > DIFFERS:
                note(f"{path}: its motion lasts {animation.seconds:.2f} s and {self.options.speech} {lasts:.2f} s")
        return animation


def solve_weights(
    animation: Animation, shapes: Path, options: SolveOptions, *, carry: bool = False, only_arkit: bool = False
) -> tuple[ShapeSet, Weights]:
    """Shapes from a folder or a file as they fit an animation, and their weights: :meth:`Animation.blendshapes`."""
    from facediff.editing.blendshapes import solve
    from facediff.editing.retargeting import retarget_shapes
    from facediff.editing.shapes import EXTRA_NOTE, check_shapes, read_shapes
    from facediff.spaces.arkit import ARKIT

    check_shapes(shapes)
    shape_set = retarget_shapes(shapes, animation) if carry else read_shapes(shapes, animation.template, animation.unit)
    if only_arkit:
        notes = [note for note in shape_set.notes if not note.startswith(EXTRA_NOTE)]
        if shape_set.extra:
            notes.append(f"not ARKit's, left out so that they take no motion: {', '.join(shape_set.extra)}")
        shape_set = replace(shape_set.only(ARKIT), notes=tuple(notes))
    return shape_set, solve(animation, shape_set, options)


def _facts_of_model(source: Any, identity: str | None) -> AnimationFacts:  # noqa: ANN401 - a file, a folder or a model
    """The facts of a model's animations of one of its faces."""
    from facediff.runtime.model import RuntimeModel

    is_file = isinstance(source, str | Path)
    source = bundled_by_name(source) if is_file else source
    exported = RuntimeModel.open(Path(source)) if is_file and is_graphs(source) else getattr(source, "model", None)
    if isinstance(exported, RuntimeModel):
        return facts_of(exported.still(exported.stream(identity=identity)))
    from facediff.models.checkpoint import read_assets
    from facediff.pipelines.trained import facts_of as facts_of_assets

    assets = read_assets(Path(source)) if is_file else source.module.assets
    return cast("AnimationFacts", facts_of_assets(assets, identity))


def corpus_of_model(source: str | Path) -> str:
    """The corpus of a checkpoint or a folder, and whether it is synthetic, as it stands under a video."""
    source = bundled_by_name(source)
    if is_graphs(source):
        from facediff.runtime.folder import read_folder

        about = read_folder(Path(source))[0]
        corpus, synthetic = about.corpus, about.synthetic
    else:
        from facediff.models.checkpoint import read_assets

        assets = read_assets(source)
        corpus, synthetic = assets.corpus, assets.synthetic
    return f"{corpus} (synthetic)" if synthetic else corpus
