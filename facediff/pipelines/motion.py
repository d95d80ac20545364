"""Animations as Python shows them: read from files, played in notebooks, compared, edited and written.

From top to bottom: :class:`Animation`, and several :class:`Samples` of one recording; :class:`Page`, animations that
play side by side in a browser or a notebook; :func:`view`, which makes pages; :func:`read`, which opens motion files.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, cast

from facediff import animation as finished
from facediff.animation.files import AnimationFacts, complete, facts_of, read_animation
from facediff.animation.options import AnimationControls, DirectionLike, ExportOptions, Scales, SourceOptions
from facediff.errors import FaceDiffError, OptionError
from facediff.utils import ranges

if TYPE_CHECKING:
    from facediff.editing.blendshapes import SolveOptions, Weights
    from facediff.editing.shapes import ShapeSet
    from facediff.pipelines.animator import Animator

INLINE_MB = 8.0
"""The largest page that a notebook shows; of a larger one, it shows the beginning. A notebook keeps what it shows."""
TRIED_FRAMES = 64
"""Frames by which the size of a page is estimated."""
INLINE_HEIGHT = 540
"""Pixels that a page takes in a notebook."""


@dataclass(frozen=True, eq=False, repr=False)
class Animation(finished.Animation):
    """Finished motion of one face: to look at, to compare, to change and to write.

    In a notebook it plays, with its speech. It has the fields of :class:`facediff.animation.Animation`: ``vertices``
    (T, V, 3) in float32, ``template`` (V, 3), ``frame_rate``, ``unit``, ``regions``, ``faces``, ``speech``,
    ``metadata`` and others.

    Example:
        >>> import numpy as np
        >>> face = np.zeros((4, 3), np.float32)
        >>> Animation("hello", np.stack([face] * 50), face, frame_rate=25)
        Animation("hello": 50 frames, 2.00 s at 25 a second, 4 vertices in m, silent)
    """

    @classmethod
    def of(cls, animation: finished.Animation) -> Self:
        """The animation as this class; itself if it is one already."""
        if isinstance(animation, cls):
            return animation
        return cls(**{field.name: getattr(animation, field.name) for field in fields(animation)})

    def save(
        self,
        path: str | Path,
        *,
        output_unit: str | None = None,
        up: Literal["y", "z"] | None = None,
        no_speech: bool = False,
        shapes: str | Path | None = None,
        key_tolerance: float | None = None,
        tolerance: float | None = None,
        view: str | None = None,
        size: int | None = None,
    ) -> list[Path]:
        """Write a file of any export format; all of it, or nothing.

        Args:
            path: the file; its suffix chooses the format: .npz keeps everything, .glb, .usdc, .mp4, .html …
            output_unit: unit of length of the file: m, cm, mm, in, or a number of metres; the motion's own if None.
            up: axis that points up in the file, y or z; the format's own if None.
            no_speech: omit the sound.
            shapes: for .csv and .glb: folder of meshes, .glb with targets, or ``puppet`` for the built-in ones.
            key_tolerance: for weights: leave out keys that a straight line replaces to within so much; 0 if None.
            tolerance: for .glb: largest error in mm; 0.05 if None.
            view: for .mp4: camera, ``front``, ``three_quarter`` or ``side``; the front if None.
            size: for .mp4: height and width in pixels; 512 if None.

        Returns:
            the file, and those that were written next to it.

        Raises:
            FaceDiffError: if there is no such format, it does not support an option, or a file cannot be written.
        """
        return write([self], path, export_options(path, **_given(locals())))

    def compare(
        self, truth: finished.Animation, output: str | Path | None = None, *, labels: Sequence[str] | None = None
    ) -> Page:
        """The animation next to the truth, with a heat map of each vertex's distance from it.

        The longer one is cut to the shorter.

        Args:
            truth: a motion of the same face at the same frame rate, such as :func:`facediff.read` gives.
            output: an .html file to write as well.
            labels: names to show, the truth's first.

        Returns:
            the page, which plays in a notebook and can be written with :meth:`Page.save`.

        Raises:
            FaceDiffError: if the two cannot be compared, or the file cannot be written.
        """
        return Samples([self]).compare(truth, output, labels=labels)

    def control(
        self,
        *,
        expressiveness: Scales | None = None,
        blinks: float | bool | None = None,
        gaze: float | bool | None = None,
        sway: float | bool | None = None,
        eyes: str | Path | None = None,
        controls_seed: int | None = None,
        direction: DirectionLike | None = None,
        acting: str | None = None,
    ) -> Animation:
        """The animation with animation controls applied: ``anim.control(expressiveness=1.2, blinks=True)``.

        Args:
            expressiveness: scale the motion: 1.2, or by region, ``{"upper_face": 1.5, "lips": 0.9, "all": 1.1}``.
            blinks: blinks a minute; True for 17.
            gaze: eyes that wander by so many degrees at most; True for 4.
            sway: a head that sways by so many degrees at most; True for 2.
            eyes: file that says where lids and eyeballs are; the built-in puppet needs none.
            controls_seed: seed of blinks, gaze, sway and acting; 0 if None.
            direction: keys over time: a file, a :class:`facediff.Direction`, or a list of its rows.
            acting: brows, head and lids that move with the speech: ``"prosody"``, with options
                (``"prosody:strength=0.8"``).

        Raises:
            FaceDiffError: if a value is out of range, or does not fit the face.
        """
        controls = AnimationControls(**_given(locals()))
        from facediff.editing.controlled import apply_controls
        from facediff.editing.controls import check_controls

        check_controls(controls)
        return Animation.of(apply_controls(self, controls))

    def retarget(
        self,
        target_mesh: str | Path,
        *,
        correspondence: str | Path | None = None,
        landmarks: str | Path | None = None,
    ) -> Animation:
        """The same motion on another mesh.

        Args:
            target_mesh: the other face at rest: .obj, .ply, .glb …
            correspondence: .npz to use if it exists, else to write for other animations.
            landmarks: .csv of pairs of vertices that are one place, or the .json of `facediff retarget --pick`.

        Raises:
            FaceDiffError: if a file cannot be read, or the mesh does not fit.
        """
        from facediff.editing.retargeting import retarget

        for name, file in (("target_mesh", target_mesh), ("landmarks", landmarks)):
            if file is not None and not Path(file).is_file():
                raise FaceDiffError(f"{name} {file}: no such file; expected a mesh or a table of its vertices")
        return Animation.of(retarget(self, Path(target_mesh), _path(correspondence), _path(landmarks))[0])

    def blendshapes(
        self,
        shapes: str | Path,
        *,
        carry: bool = False,
        smoothness: float = 0.02,
        symmetry: float = 0.0,
        sparsity: float = 0.02,
        bounds: tuple[float, float] = (0.0, 1.0),
        region: str | None = None,
        residual_limit: float = 0.8,
        only_arkit: bool = False,
    ) -> Weights:
        """Weights of blendshapes that come nearest to the motion; their ``save`` writes a table.

        Args:
            shapes: folder of .obj or .ply files named jawOpen, mouthFunnel …, a .glb with named targets, or ``puppet``
                for those of the built-in face.
            carry: the shapes are of another topology: transfer them to this mesh.
            smoothness: cost of change over time; 0 is off.
            symmetry: cost of a difference between left and right; 0 is off.
            sparsity: cost of weights, which keeps shapes at 0 that would cancel one another; 0 is off.
            bounds: least and greatest weight.
            region: look at a region of the face only, such as ``lips``.
            residual_limit: share of the motion that weights may leave before they are refused.
            only_arkit: leave out shapes whose names are not ARKit's.

        Raises:
            FaceDiffError: if the shapes cannot be read or do not fit, or a number is out of range.
        """
        from facediff.editing.blendshapes import SolveOptions

        options = SolveOptions(
            smoothness=smoothness,
            symmetry=symmetry,
            sparsity=sparsity,
            lower=bounds[0],
            upper=bounds[1],
            region=region,
            residual_limit=residual_limit,
        )
        return solve_weights(self, Path(shapes), options, carry=carry, only_arkit=only_arkit)[1]

    def _repr_html_(self) -> str | None:
        """What a notebook shows: the face, which plays; nothing but the text where there is no mesh."""
        return Page([self])._repr_html_()

    def __repr__(self) -> str:
        known = self.metadata
        words = [f"{len(self.vertices)} frames", f"{self.seconds:.2f} s at {self.frame_rate:g} a second"]
        words += [f"{len(self.template)} vertices in {self.unit}"]
        words += [f"{name} {known[name]}" for name in ("identity",) if name in known]
        words += [f"style of {known['style']}"] if "style" in known else []
        words += ["with speech" if self.speech is not None else "silent"]
        return f'Animation("{self.name}": {", ".join(words)})'


class Samples(list[Animation]):
    """Several samples for one recording: a list of animations that are written, shown and compared together."""

    def save(
        self,
        path: str | Path,
        *,
        output_unit: str | None = None,
        up: Literal["y", "z"] | None = None,
        no_speech: bool = False,
        shapes: str | Path | None = None,
        key_tolerance: float | None = None,
        tolerance: float | None = None,
        view: str | None = None,
        size: int | None = None,
    ) -> list[Path]:
        """Write all of them, as :meth:`Animation.save` writes one.

        Formats that show several, .html and .mp4, show them side by side; of others, ``x.glb`` becomes
        ``x_sample1.glb``, ``x_sample2.glb`` …

        Args:
            path: as :meth:`Animation.save` takes it.
            output_unit: likewise.
            up: likewise.
            no_speech: likewise.
            shapes: likewise.
            key_tolerance: likewise.
            tolerance: likewise.
            view: likewise.
            size: likewise.

        Raises:
            FaceDiffError: as :meth:`Animation.save`.
        """
        return write(self, path, export_options(path, **_given(locals())))

    def compare(
        self, truth: finished.Animation, output: str | Path | None = None, *, labels: Sequence[str] | None = None
    ) -> Page:
        """All of them next to the truth, as :meth:`Animation.compare` shows one; three at most.

        Args:
            truth: as :meth:`Animation.compare` takes it.
            output: likewise.
            labels: likewise.

        Raises:
            FaceDiffError: as :meth:`Animation.compare`.
        """
        if not isinstance(truth, finished.Animation):
            raise FaceDiffError(
                f"truth: is of the type {type(truth).__name__}; expected an animation, as facediff.read gives it"
            )
        names = [animation.name for animation in self]
        if labels is None and truth.name in names:  # as of one recording
            labels = ["truth", *names]
        page = view(self, truth=truth, labels=labels, shortest=True)
        if output is not None:
            page.save(output)
        return page

    def _repr_html_(self) -> str | None:
        return Page(self[:4])._repr_html_() if self else None


class Page:
    """Animations that play side by side, in a notebook or in one .html file that loads nothing from anywhere.

    Args:
        animations: 1 to 4 of one frame rate and one length.
        truth: number of the one that the others are compared with, by heat maps; None for none.
    """

    def __init__(self, animations: Sequence[finished.Animation], truth: int | None = None) -> None:
        self.animations, self.truth = list(animations), truth

    @ranges.checked
    def save(self, path: str | Path, *, max_mb: ranges.Megabytes = 30.0) -> Path:
        """Write the page to a file.

        Args:
            path: the .html file.
            max_mb: largest file written, in megabytes.

        Raises:
            FaceDiffError: if the file would be larger or cannot be written.
        """
        from facediff.export.viewer import write_page

        path = Path(path)
        if path.suffix not in (".html", ".htm"):
            raise FaceDiffError(f'{path}: unknown suffix "{path.suffix}"; expected .html')
        write_page(path, self.animations, max_mb=max_mb, truth=self.truth)
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
        return Page([each.part(slice(frames)) for each in self.animations], self.truth)

    def _repr_html_(self) -> str | None:
        """The page in a frame of a notebook; of a page that is too large, the beginning; None without a mesh."""
        if any(animation.faces is None or not len(animation.faces) for animation in self.animations):
            return None
        whole = frames = len(self.animations[0].vertices)
        # A page grows with its frames nearly in proportion, but for the meshes. Tried on few frames first: packing an
        # hour only to see that it is too large would take minutes.
        shown = self if whole <= TRIED_FRAMES else self.beginning(TRIED_FRAMES)
        text = shown.html()
        if shown is not self:
            frames = min(whole, max(TRIED_FRAMES, int(TRIED_FRAMES * INLINE_MB / (len(text) / 1e6))))
            shown = self if frames == whole else self.beginning(frames)
            text = shown.html()
        while (size := len(text) / 1e6) > INLINE_MB and frames > 1:
            frames = max(1, min(frames - 1, int(0.95 * frames * INLINE_MB / size)))
            shown = self.beginning(frames)
            text = shown.html()
        note = ""
        if shown is not self:
            note = (
                f"<p>The first {shown.animations[0].seconds:.1f} of {self.animations[0].seconds:.1f} s, since a "
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
    animations: finished.Animation | Sequence[finished.Animation],
    *,
    truth: finished.Animation | None = None,
    labels: Sequence[str] | None = None,
    shortest: bool = False,
) -> Page:
    """A page that plays animations side by side with their speech, in a notebook or any browser.

    Args:
        animations: one, or up to four with the truth among them, of one frame rate.
        truth: what the animations are compared with: shown first, and in heat maps.
        labels: names to show, the truth's first.
        shortest: cut all to the shortest instead of refusing.

    Raises:
        FaceDiffError: if the animations do not make a page.

    Example:
        >>> facediff.view([calm, lively], labels=["calm", "lively"]).save("both.html")  # doctest: +SKIP
        PosixPath('both.html')
    """
    given = [animations] if isinstance(animations, finished.Animation) else list(animations)
    shown = [*([] if truth is None else [truth]), *given]
    if not shown:
        raise FaceDiffError("animations: there is none to show; give at least one")
    if labels is not None and len(labels) != len(shown):
        raise OptionError.naming(
            f"{{labels}}: {len(labels)} names for {len(shown)} panels; give one for each, the truth's first"
        )
    if labels is not None:
        shown = [replace(animation, name=label) for animation, label in zip(shown, labels, strict=True)]
    if shortest:
        frames = min(len(animation.vertices) for animation in shown)
        shown = [animation.part(slice(frames)) for animation in shown]
    from facediff.export.viewer.page import check_page

    number = None if truth is None else 0
    check_page(shown, number)
    return Page(shown, number)


def read(
    path: str | Path,
    *,
    like: finished.Animation | None = None,
    mesh: str | Path | None = None,
    checkpoint: str | Path | Animator | None = None,
    identity: str | None = None,
    speech: str | Path | None = None,
    frame_rate: float | None = None,
    unit: str | None = None,
) -> Animation:
    """Read a motion file: .npz as :meth:`Animation.save` writes it, or .npy of absolute vertices (T, V, 3) or (T, 3V).

    What a bare array does not say is taken from the other arguments: first from those that name it, then from the
    checkpoint, then from ``like``.

    Args:
        path: the file.
        like: an animation of the same topology, for the neutral face, triangles, frame rate, unit and regions.
        mesh: neutral face with triangles: .ply, .obj, .glb …
        checkpoint: what is still missing, from a checkpoint or a loaded model.
        identity: whose face in the checkpoint; the first one trained on if None.
        speech: the recording that the motion belongs to.
        frame_rate: frames a second.
        unit: unit of length: m, cm, mm, in, or a number of metres.

    Raises:
        FaceDiffError: if a file cannot be read, nothing says the frame rate, or the parts do not fit one another.

    Example:
        >>> truth = facediff.read("vertices_npy/F1_e28.npy", like=animation)  # doctest: +SKIP
    """
    options = SourceOptions(mesh, checkpoint, identity, speech, frame_rate, unit)
    return SourceReader(options).read(Path(path), like)


class SourceReader:
    """Reads motion files, and completes bare arrays of vertices by what options say.

    Args:
        options: what the arrays do not say.

    Raises:
        FaceDiffError: if an identity is named, and no checkpoint that has it.
    """

    def __init__(self, options: SourceOptions) -> None:
        if options.identity is not None and options.checkpoint is None:
            raise OptionError("identity", "names a face of a checkpoint; give {checkpoint} as well")
        self.options = options

    @cached_property
    def facts(self) -> tuple[AnimationFacts, AnimationFacts | None]:
        """What the options say, which overrides a file; and what the checkpoint adds where nothing else says it."""
        import numpy as np

        from facediff.mesh import read_mesh

        options = self.options
        overrides: dict[str, Any] = {}
        defaults = None
        if options.checkpoint is not None:
            from facediff.models.checkpoint import read_assets
            from facediff.pipelines.trained import facts_of as facts_of_assets

            source = options.checkpoint
            assets = read_assets(Path(source)) if isinstance(source, str | Path) else source.module.assets
            defaults = facts_of_assets(assets, options.identity)
            if options.identity is not None:
                overrides["template"] = defaults["template"]
        if options.mesh is not None:
            mesh = read_mesh(Path(options.mesh))
            overrides |= {"template": mesh.vertices.astype(np.float32), "faces": mesh.faces}
            overrides |= {} if mesh.colours is None else {"colours": mesh.colours}
        if options.speech is not None:
            from facediff.speech.audio import read_speech
            from facediff.utils import SAMPLE_RATE

            overrides |= {"speech": read_speech(Path(options.speech)), "sample_rate": SAMPLE_RATE}
        overrides |= {} if options.frame_rate is None else {"frame_rate": options.frame_rate}
        overrides |= {} if options.unit is None else {"unit": options.unit}
        return cast("AnimationFacts", overrides), cast("AnimationFacts | None", defaults)

    def read(self, path: Path, lender: finished.Animation | None = None) -> Animation:
        """The animation in a file, completed by this, then by another animation; all of its frames are finite."""
        overrides, defaults = self.facts
        if lender is not None:
            defaults = complete(defaults or {}, facts_of(lender))
        animation = Animation.of(read_animation(path, overrides, defaults))
        animation.refuse_not_finite()
        return animation


def solve_weights(
    animation: finished.Animation, shapes: Path, options: SolveOptions, *, carry: bool = False, only_arkit: bool = False
) -> tuple[ShapeSet, Weights]:
    """Shapes from a folder or a file as they fit an animation, and their weights: :meth:`Animation.blendshapes`."""
    from facediff.editing.blendshapes import solve
    from facediff.editing.retargeting import retarget_shapes
    from facediff.editing.shapes import ARKIT, check_shapes, read_shapes

    check_shapes(shapes)
    found = retarget_shapes(shapes, animation) if carry else read_shapes(shapes, animation.template, animation.unit)
    if only_arkit:
        found = found.only(ARKIT)
    return found, solve(animation, found, options)


def export_options(path: str | Path, **options: Any) -> ExportOptions:  # noqa: ANN401 - see Animation.save
    """Options of an export from the keywords of :meth:`Animation.save`.

    Raises:
        FaceDiffError: if the file's format does not use one of them.
    """
    from facediff.export import check_used

    check_used(Path(path).suffix, options)
    return ExportOptions(**options)


def write(animations: Sequence[finished.Animation], path: str | Path, options: ExportOptions) -> list[Path]:
    """Write animations of one recording; see :meth:`Animation.save`."""
    from facediff.export import write_animations

    return write_animations(Path(path), animations, options)


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)


def _given(arguments: dict[str, Any]) -> dict[str, Any]:
    """The keyword arguments of a method that were given, from its ``locals()``."""
    # By identity: 0 is a value, though it is equal to False.
    return {
        name: value
        for name, value in arguments.items()
        if name not in ("self", "path") and value is not None and value is not False
    }
