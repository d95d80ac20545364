"""A speaking style from the text after ``--style``: a clip's name, a file, or a weighted mixture of several.

The text is split into names with weights (:mod:`facediff.animation.style_files`); each name becomes a reference
motion or a style vector; a motion file is brought to offsets from its speaker's neutral face, and checked against the
face that it is taken for. Libraries are imported inside the functions, so that splitting alone costs nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.animation.style_files import (
    FILES,
    StyleFile,
    frames_of,
    normalised,
    open_style,
    split_styles,
    stillness_of,
    stride_of,
    style_given,
    vector_in,
    with_layout,
)
from facediff.errors import OptionError, choices, refuse_idle

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt
    from torch import Tensor

    from facediff.animation import Animation
    from facediff.data import Assets, Reference
    from facediff.models import AnimationModel, Style
    from facediff.spaces.files import ParameterClip

    Recorded = Animation | ParameterClip | npt.NDArray[np.floating] | Tensor
    StyleLike = str | Path | Mapping[str, float] | Recorded | Reference | Style
    """Forms of a style in Python, see :func:`style_from`."""

MEDIAN = "median"
"""Instead of a template's file: the median of the motion's own frames."""


def read_styles(
    text: str, identity: str, model: AnimationModel, *, template: str | Path | None = None
) -> Reference | Style:
    """The style that the words of ``--style`` ask for.

    Args:
        text: one style as :func:`read_style` takes it, or several with weights, ``a.npy:0.3,b.npy:0.7``; without
            weights all count alike. A mixture is the weighted mean of the model's style vectors. Weights may be
            negative, which leads away from a style; they are divided by their sum.
        identity: the animated face.
        model: gives the style vectors.
        template: neutral face of the speaker in the .npy files, or ``median``.
    """
    import torch

    from facediff.models import Style
    from facediff.models.inference import named

    trained = model.own_styles()
    if not trained:
        refuse_without_styles(model)
    parts = split_styles(text, [*trained, *(reference.clip for reference in model.assets.references.values())])
    if len(parts) == 1:
        # A weight of one style would have to mean a distance from some other style, and there is none.
        if parts[0].weight not in (None, 1.0):
            raise OptionError.naming(
                f"{{style}} {text}: one style alone cannot be weighted; mix it with another one (A:0.3,B:0.7)"
            )
        return read_style(parts[0].name, identity, model, template=template)
    shares = normalised(text, [part.weight for part in parts])
    styles = [read_style(part.name, identity, model, template=template) for part in parts]
    # Vectors are mixed, not motions: two motions averaged frame by frame cancel each other where they differ in timing.
    vector = torch.stack([share * vector_of(s, model) for share, s in zip(shares, styles, strict=True)]).sum(0)
    name = " + ".join(f"{share:.3g} {named(style)}" for share, style in zip(shares, styles, strict=True))
    return Style(name, vector)


def style_from(
    source: StyleLike, identity: str, model: AnimationModel, *, template: str | Path | None = None
) -> Reference | Style:
    """The style that was given in Python.

    Args:
        source: the words of ``--style``; a path; names or paths with their weights, ``{"F1_e03": 0.4, "M2_e05": 0.6}``;
            a motion as an animation or as an array (T, V, 3) of absolute vertices; of a model of channels also one of
            :func:`facediff.spaces.files.read_parameters`; a style vector (S,) of :func:`extract_style`; or what this
            function has returned.
        identity: the animated face; also the speaker of an array's motion, unless a template is given.
        model: gives the style vectors.
        template: as :func:`read_styles` takes it.
    """
    from facediff.data import Reference
    from facediff.models import Style
    from facediff.spaces.files import ParameterClip

    if isinstance(source, Reference | Style):
        return source
    if not isinstance(source, Mapping | str | Path):
        refuse_without_styles(model)
    style = style_given(source, vertices=model.assets.space.is_vertices)
    if isinstance(style, str):
        return read_styles(style, identity, model, template=template)
    if isinstance(style, ParameterClip):
        return style_of_channels(style, identity, model)
    return style_of(style, identity, model, template=template)


def refuse_without_styles(model: AnimationModel) -> None:
    """Refuse a style for a model that has none."""
    reason = "this checkpoint was trained without a dynamic style, so a style would change nothing"
    refuse_idle(reason, style=not style_width(model))


def vector_of(style: Reference | Style, model: AnimationModel) -> Tensor:
    """The style vector (style_dim,) of a style, on the CPU."""
    import torch

    from facediff.models import Style

    if isinstance(style, Style):
        return style.vector.float()
    motion = style.motion.float()[None].to(model.device)
    with torch.inference_mode():
        encoded = model.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=model.device))
    # A plain tensor: one made in inference mode could not be used outside of it.
    return encoded[0].cpu().clone()


def style_width(model: AnimationModel) -> int:
    """How many numbers a style vector of the model has; 0 if it has no dynamic style."""
    return len(still_style(model))


def still_style(model: AnimationModel) -> Tensor:
    """The style vector (S,) of a face that keeps still, which tells a model's style encoder from another's."""
    import torch

    from facediff.data import Reference

    return vector_of(Reference("still", torch.zeros(1, model.n_vertices, model.dims)), model)


def extract_style(clips: Sequence[StyleLike], identity: str, model: AnimationModel) -> Tensor:
    """The style vector (S,) of clips; their mean if there are several.

    Args:
        clips: motions, as :func:`read_style` takes them, or :func:`style_from` other things than words.
        identity: the motion's speaker, where a file's name does not say it.
        model: gives the style vectors; S is 0 if it was trained without styles.
    """
    import torch

    styles = [
        read_style(str(clip), identity, model) if isinstance(clip, str | Path) else style_from(clip, identity, model)
        for clip in clips
    ]
    return torch.stack([vector_of(style, model) for style in styles]).mean(0)


def read_style(
    style: str, identity: str, model: AnimationModel, *, template: str | Path | None = None
) -> Reference | Style:
    """A style from a file, from the checkpoint, or from the corpus that the checkpoint was trained on.

    A file holds a style vector that ``facediff style extract`` wrote, or a motion in absolute vertices: an animation
    (``.npz``), which has its own template, or a bare array (``.npy``). An array's speaker follows from its name
    (``F1_e03.npy``), else it is ``identity``, unless a template is given. A model of channels takes motion in
    parameters, see :func:`recorded_parameters`. A file in the ``vertices_npy`` of a corpus
    folder comes with that folder's templates and frame rate. A model that has styles by name takes only those.

    Args:
        style: the file, or the name of a clip, of an identity (its usual style), or of a style that the model has.
        identity: the animated face.
        model: the trained model.
        template: neutral face of the speaker in the array, or ``median``.
    """
    trained = model.own_styles()
    if trained:
        # Such a model has no style encoder: there is nothing to make a style of motion with.
        if style not in trained:
            raise OptionError.naming(
                f"{{style}} {style}: {type(model).__name__} takes no motion as a style, but a training identity or a "
                f"mixture of several (A:0.3,B:0.7): {choices(style, trained)}"
            )
        return trained[style]
    is_file = style.endswith(FILES)
    if not is_file:
        if style in model.styled_identities():  # as the styles of an exported folder are named
            return model.default_style(style)
        for reference in model.assets.references.values():
            if reference.clip == style:
                return reference
    if not model.assets.space.is_vertices:
        recorded = recorded_parameters(style, model.assets.frame_rate)
        if recorded is not None:
            return style_of_channels(recorded, identity, model)
    opened = open_style(Path(style)) if is_file else corpus_clip(style, model)
    return style_of(opened, identity, model, template=template if is_file else None)


def style_of(
    opened: StyleFile, identity: str, model: AnimationModel, *, template: str | Path | None = None
) -> Reference | Style:
    """The style in a motion or a vector, however it was obtained; arguments as of :func:`read_style`."""
    import torch

    from facediff.animation import metres_per_unit
    from facediff.data import Reference
    from facediff.models import Style

    assets, path, scale = model.assets, opened.path, 1.0
    if opened.array.ndim == 1:
        still = still_style(model).numpy()
        return Style(path.stem, torch.from_numpy(vector_in(opened, len(still), lambda: still)))
    refuse_vertices(path, model)
    if opened.template is None:
        face, whose, rate = face_of_array(opened, identity, model, template)
    else:
        face, whose, rate = torch.from_numpy(opened.template), None, opened.frame_rate or assets.frame_rate
        if opened.unit not in (None, assets.unit):
            scale = metres_per_unit(str(opened.unit)) / metres_per_unit(assets.unit)
    # Networks see offsets from the speaker's own neutral face, at the frame rate and in the unit of their corpus.
    motion = torch.from_numpy(frames_of(opened, assets.n_vertices, stride_of(path, rate, assets.frame_rate)))
    offsets = scale * (motion - face)
    check_face(path, offsets, assets, whose)
    return Reference(path.stem, offsets)


def recorded_parameters(text: str, frame_rate: float) -> ParameterClip | None:
    """As :func:`facediff.animation.parameter_styles.recorded_parameters`, and ARTalk's style clips (``.pt``)."""
    import numpy as np

    from facediff.animation import parameter_styles
    from facediff.spaces.files import ParameterClip
    from facediff.spaces.layouts import find_layout

    path, stated = with_layout(text)
    if path.suffix != ".pt" or not path.is_file():
        return parameter_styles.recorded_parameters(text, frame_rate)
    import torch

    from facediff.utils.torch_files import load_tensors

    entry = find_layout(stated or "flame_artalk", f"--style {path}")
    content = load_tensors(path)
    values: npt.NDArray[np.floating] = np.zeros(0, np.float32)
    if isinstance(content, torch.Tensor) and content.is_floating_point():
        values = content.float().numpy()
    if values.ndim != 2 or values.shape[1] != len(entry.space.channels) or not np.isfinite(values).all():
        raise OptionError.naming(
            f"{{style}} {path}: holds no tensor of finite numbers (frames, {len(entry.space.channels)}); expected "
            f"a style clip such as ARTalk's, or state its layout: {path.name}@LAYOUT"
        )
    return ParameterClip(path.stem, values, entry.space, entry.frame_rate or 25.0)


def style_of_channels(recorded: ParameterClip, identity: str, model: AnimationModel) -> Reference:
    """Motion in parameters as a reference of a model of channels, as offsets from the person's rest."""
    import torch

    from facediff.animation.parameter_styles import channels_of
    from facediff.data import Reference

    motion = torch.from_numpy(channels_of(recorded, model.assets.space, model.assets.frame_rate))[..., None]
    return Reference(recorded.name, motion - model.assets.template(identity))


def refuse_vertices(source: object, model: AnimationModel) -> None:
    """Refuse motion of vertices as the style of a model that takes channels."""
    if not model.assets.space.is_vertices:
        raise OptionError.naming(
            f"{{style}} {source}: holds vertices, and this model takes channels; give motion in parameters, a speaker "
            f"of the checkpoint, or a style vector of this model"
        )


def corpus_clip(name: str, model: AnimationModel) -> StyleFile:
    """The motion of a clip of the training corpus, if the corpus is on this machine."""
    import numpy as np

    from facediff.data.storage import MOTION_FOLDERS, motion_path, open_motion

    refuse_vertices(name, model)
    root = model.data_source.get("root")
    path = motion_path(Path(root), name) if root else None
    if path is None or not path.is_file():
        where = f"in the checkpoint nor at {path}" if path else "in the checkpoint, and its corpus is not known"
        raise OptionError.naming(f"{{style}} {name}: no clip of that name {where}; give a .npy file or another clip")
    motion = open_motion(path, model.n_vertices)
    # Vertices also where the corpus keeps weights of shapes: its templates and frame rate belong to them.
    return StyleFile(path.parent.parent / MOTION_FOLDERS[0] / path.name, np.asarray(motion.read(range(motion.frames))))


def face_of_array(
    opened: StyleFile, identity: str, model: AnimationModel, template: str | Path | None
) -> tuple[Tensor, str | None, float]:
    """The neutral face of a bare array's speaker, who that is taken to be (None for a given face), and its frame rate.

    Args:
        opened: the array.
        identity: the speaker, if the file's name contains no known one.
        model: its checkpoint's templates are known, and the templates of the corpus folder that the file lies in.
        template: a template that was given, or ``median``.
    """
    from facediff.data import SpeechMotionDataModule
    from facediff.data.corpus import MOTION_FOLDERS, read_manifest, read_templates
    from facediff.registry import corpus, find_class

    path, assets, source = opened.path, model.assets, model.data_source
    templates, rate = dict(assets.templates), assets.frame_rate
    # A file below a corpus folder is one of that corpus's clips; templates and frame rate lie next to it.
    in_corpus = path.resolve().parent.name in MOTION_FOLDERS
    if in_corpus:
        root = path.resolve().parent.parent
        if (root / "templates.pkl").is_file():
            templates |= read_templates(root / "templates.pkl", assets.n_vertices)
        module = find_class(corpus, str(source.get("class_path")), SpeechMotionDataModule)
        frame_rate = module.stored_frame_rate if module is not None and str(root) == source.get("root") else None
        rate = float(read_manifest(root).get("frame_rate") or frame_rate or rate)
    stem = path.stem.split("_condition_")[0].rpartition("_")[0]
    if template is not None and not (in_corpus and stem in templates):
        return given_face(template, opened, assets), None, rate
    whose = next((name for name in (stem, identity) if name in templates), None)
    return assets.template(identity) if whose is None else templates[whose], whose or identity, rate


def given_face(template: str | Path, opened: StyleFile, assets: Assets) -> Tensor:
    """The neutral face (V, 3) that was given for a motion: a mesh, an array, or ``median``."""
    import numpy as np
    import torch

    from facediff.mesh import read_mesh

    path = Path(template)
    if str(template) == MEDIAN and not path.is_file():
        # The median of each coordinate and not the mean: a face is at rest or nearly so in more frames than in any one
        # expression, and wide openings would pull a mean.
        median = np.median(frames_of(opened, assets.n_vertices, 1), axis=0)
        print(
            f"note: --style {opened.path}: the median of its {len(opened.array)} frames stands for the neutral face; a "
            f"mouth that is open most of the time then counts as closed"
        )
        return torch.from_numpy(np.asarray(median, np.float32))
    read = open_style(path).array if path.suffix.lower() == ".npy" else read_mesh(path).vertices
    fits = read.size == 3 * assets.n_vertices
    face = np.asarray(read, np.float32).reshape(-1, 3) if fits else np.zeros((0, 3), np.float32)
    if not fits or not np.isfinite(face).all():
        raise OptionError.naming(
            f"{{style_template}} {path}: has shape {read.shape}; expected the neutral face of {assets.n_vertices} "
            f"finite vertices whose motion is in {{style}}, as .obj, .ply or .npy, or the word {MEDIAN}"
        )
    return torch.from_numpy(face)


def check_face(path: Path, offsets: Tensor, assets: Assets, whose: str | None) -> None:
    """Refuse a motion if another face's template was subtracted; it would pass for an odd style."""
    stillness = stillness_of([reference.motion.float().numpy() for reference in assets.references.values()])
    if stillness is None or not stillness.another_face(offsets.numpy()):
        return
    reason = "the head moves, or the template is another person's or in another unit"
    if whose is not None:
        reason = f"it is not {whose}'s; name the file <identity>_<clip>.npy with an identity of the checkpoint"
    raise OptionError.naming(
        f"{{style}} {path}: does not lie on its template: {reason}, or give that person's own with {{style_template}}, "
        f"and a head that keeps still (`facediff data import-person` does it)"
    )
