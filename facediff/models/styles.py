"""A speaking style of a trained model: what :mod:`facediff.animation.styles` asks of one with PyTorch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff.animation.styles import Stillness, StyleFile, StyleReader, open_style, stillness_of
from facediff.data import Reference, SpeechMotionDataModule
from facediff.data.corpus import read_manifest, read_templates
from facediff.data.storage import MOTION_FOLDERS, motion_path, open_motion
from facediff.errors import OptionError, choices, refuse_idle
from facediff.models.inference import Style, named
from facediff.registry import corpus, find_class
from facediff.spaces.files import ParameterClip

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.models import AnimationModel

    Recorded = Animation | ParameterClip | npt.NDArray[np.floating] | Tensor
    StyleLike = str | Path | Mapping[str, float] | Recorded | Reference | Style
    """Forms of a style in Python, see :func:`style_from`."""

Array = npt.NDArray[np.float32]


def style_from(
    source: StyleLike, identity: str, model: AnimationModel, *, template: str | Path | None = None
) -> Reference | Style:
    """The style that was given in Python or in words.

    Args:
        source: as :meth:`facediff.animation.styles.StyleReader.style` takes it, or what this function has returned.
        identity: the animated face; also the speaker of an array's motion, unless a template is given.
        model: gives the style vectors. A model that has styles by name takes only those.
        template: neutral face of the speaker in the .npy files.
    """
    if isinstance(source, Reference | Style):
        return source
    if not (isinstance(source, Mapping | str | Path) and model.own_styles()):
        reason = "this checkpoint was trained without a dynamic style, so a style would change nothing"
        refuse_idle(reason, style=not len(still_style(model)))
    return ModelStyles(identity, model, template).style(source)


def extract_style(clips: Sequence[StyleLike], identity: str, model: AnimationModel) -> Tensor:
    """The style vector (S,) of clips, words among them being one style each; their mean if there are several.

    Args:
        clips: motions, as :func:`style_from` takes them.
        identity: the motion's speaker, where a file's name does not say it.
        model: gives the style vectors; S is 0 if it was trained without styles.
    """
    reader = ModelStyles(identity, model)
    styles = [
        reader.single(str(clip)) if isinstance(clip, str | Path) else style_from(clip, identity, model)
        for clip in clips
    ]
    return torch.stack([vector_of(style, model) for style in styles]).mean(0)


def vector_of(style: Reference | Style, model: AnimationModel) -> Tensor:
    """The style vector (S,) of a style, on the CPU."""
    if isinstance(style, Style):
        return style.vector.float()
    motion = style.motion.float()[None].to(model.device)
    with torch.inference_mode():
        encoded = model.encode_style(motion, torch.ones(motion.shape[:2], dtype=torch.bool, device=model.device))
    # A plain tensor: one made in inference mode could not be used outside of it.
    return encoded[0].cpu().clone()


def still_style(model: AnimationModel) -> Tensor:
    """The style vector (S,) of a face that keeps still, which tells a model's style encoder from another's."""
    return vector_of(Reference("still", torch.zeros(1, model.n_vertices, model.dims)), model)


class ModelStyles(StyleReader[Reference | Style]):
    """The styles of a trained model; see :func:`style_from`."""

    advice = (
        "or give that person's own with {style_template}, and a head that keeps still (`facediff data import-person` "
        "does it)"
    )

    def __init__(self, identity: str, model: AnimationModel, template: str | Path | None = None) -> None:
        assets = model.assets
        super().__init__(identity, assets.space, assets.n_vertices, assets.frame_rate, assets.unit)
        self.model, self.template = model, template

    @property
    def width(self) -> int:
        """S: how many numbers a style vector has."""
        return len(self._still)

    def names(self) -> list[str]:
        """Styles by name, and clips whose motion the checkpoint has."""
        return [*self.model.own_styles(), *(reference.clip for reference in self.model.assets.references.values())]

    def named(self, name: str) -> Reference | Style | None:
        """A style of the model, an identity's usual one, or a reference of the checkpoint by its clip."""
        if trained := self.model.own_styles():
            # Such a model has no style encoder: there is nothing to make a style of motion with.
            if name not in trained:
                raise OptionError.naming(
                    f"{{style}} {name}: {type(self.model).__name__} takes no motion as a style, but a training "
                    f"identity or a mixture of several (A:0.3,B:0.7): {choices(name, trained)}"
                )
            return trained[name]
        if name in self.model.styled_identities():  # as the styles of an exported folder are named
            return self.model.default_style(name)
        return next((reference for reference in self.model.assets.references.values() if reference.clip == name), None)

    def clip(self, name: str) -> StyleFile:
        """The motion of a clip of the training corpus, if the corpus is on this machine."""
        root = self.model.data_source.get("root")
        path = motion_path(Path(root), name) if root and self.space.is_vertices else None
        if path is None or not path.is_file():
            where = f"in the checkpoint nor at {path}" if path else "in the checkpoint, and its corpus is not known"
            raise OptionError.naming(f"{{style}} {name}: no clip of that name {where}; give a file or another clip")
        motion = open_motion(path, self.vertices)
        # Vertices also where the corpus keeps weights of shapes: its templates and frame rate belong to them.
        return StyleFile(
            path.parent.parent / MOTION_FOLDERS[0] / path.name, np.asarray(motion.read(range(motion.frames)))
        )

    def rest(self) -> Array:
        """The channels (C,) of the face at rest."""
        return self.model.assets.template(self.identity).numpy()[..., 0]

    def stillness(self) -> Stillness | None:
        """Where the faces of the checkpoint's references keep still."""
        return stillness_of([reference.motion.float().numpy() for reference in self.model.assets.references.values()])

    def still_vector(self) -> Array:
        """The style vector (S,) of a face that keeps still."""
        return self._still

    @cached_property
    def _still(self) -> Array:
        return still_style(self.model).numpy()

    def encode(self, name: str, offsets: Array) -> Reference:
        """Reference motion as it is: its vector is made with the model's other conditions."""
        return Reference(name, torch.from_numpy(offsets))

    def of_vector(self, name: str, vector: Array) -> Style:
        """A style vector (S,) as a style."""
        return Style(name, torch.from_numpy(vector))

    def vector(self, style: Reference | Style) -> tuple[str, Array]:
        """The name of a style, and its style vector (S,)."""
        return named(style), vector_of(style, self.model).numpy()

    def face(self, opened: StyleFile) -> tuple[Array, str | None, float]:
        """The neutral face of a bare array's speaker, who that is taken to be (None for a given face), and its rate."""
        path, assets, source = opened.path, self.model.assets, self.model.data_source
        templates, rate = dict(assets.templates), self.frame_rate
        # A file below a corpus folder is one of that corpus's clips; templates and frame rate lie next to it.
        in_corpus = path.resolve().parent.name in MOTION_FOLDERS
        if in_corpus:
            root = path.resolve().parent.parent
            if (root / "templates.pkl").is_file():
                templates |= read_templates(root / "templates.pkl", self.vertices)
            module = find_class(corpus, str(source.get("class_path")), SpeechMotionDataModule)
            frame_rate = module.stored_frame_rate if module is not None and str(root) == source.get("root") else None
            rate = float(read_manifest(root).get("frame_rate") or frame_rate or rate)
        stem = path.stem.split("_condition_")[0].rpartition("_")[0]
        if self.template is not None and not (in_corpus and stem in templates):
            return self._given_face(Path(self.template)), None, rate
        whose = next((name for name in (stem, self.identity) if name in templates), None)
        face = assets.template(self.identity) if whose is None else templates[whose]
        return face.numpy(), whose or self.identity, rate

    def _given_face(self, path: Path) -> Array:
        """The neutral face (V, 3) that was given for a motion: a mesh or an array."""
        from facediff.mesh import read_mesh

        read = open_style(path).array if path.suffix.lower() == ".npy" else read_mesh(path).vertices
        fits = read.size == 3 * self.vertices
        face = np.asarray(read, np.float32).reshape(-1, 3) if fits else np.zeros((0, 3), np.float32)
        if not fits or not np.isfinite(face).all():
            raise OptionError.naming(
                f"{{style_template}} {path}: has shape {read.shape}; expected the neutral face of {self.vertices} "
                f"finite vertices whose motion is in {{style}}, as .obj, .ply or .npy"
            )
        return face
