"""What a checkpoint must hold about its corpus to animate a face without the corpus."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from jaxtyping import Float, Int, UInt8
from torch import Tensor

from facediff.errors import FaceDiffError

ASSETS_KEY = "facediff_assets"
"""Where a checkpoint keeps :meth:`Assets.state`."""

DATA_SOURCE_KEY = "facediff_data"
"""Where a checkpoint keeps which data module it was trained on (``class_path``) and where the corpus was (``root``)."""


@dataclass(frozen=True)
class Reference:
    """A reference motion that carries a person's style.

    Attributes:
        clip: the clip it was taken from.
        motion: offsets from the template, half precision to keep checkpoints small.
    """

    clip: str
    motion: Float[Tensor, "frames vertices 3"]


@dataclass(frozen=True)
class Assets:
    """Everything about a corpus that animation needs.

    Attributes:
        corpus: name of the corpus.
        synthetic: whether the corpus was made by a program rather than captured from people.
        unit: unit of length of templates and motion.
        frame_rate: motion frames a second.
        identities: the training identities, in the order of the identity index.
        templates: neutral face of every subject.
        faces: triangles; None where the corpus has no mesh file.
        colours: vertex colours (sRGB, 0 to 255) for pictures; None where the mesh file has none.
        regions: vertex indices by region name: ``lips``, ``upper_face``.
        inner_lip_pairs: (upper, lower) vertex pairs on the inner lips, for the mouth's opening.
        references: a default style reference for every subject that has one.
        motion_scale: factor that gives the training motion unit variance; None until it has been measured.
    """

    corpus: str
    synthetic: bool
    unit: str
    frame_rate: float
    identities: list[str]
    templates: dict[str, Float[Tensor, "vertices 3"]]
    faces: Int[Tensor, "faces 3"] | None
    regions: dict[str, Int[Tensor, " region"]]
    colours: UInt8[Tensor, "vertices 3"] | None = None
    inner_lip_pairs: Int[Tensor, "pairs 2"] | None = None
    references: dict[str, Reference] = field(default_factory=dict)
    motion_scale: float | None = None

    @property
    def n_vertices(self) -> int:
        """Vertices of the topology."""
        return len(next(iter(self.templates.values())))

    def template(self, subject: str) -> Float[Tensor, "vertices 3"]:
        """The neutral face of a subject.

        Raises:
            FaceDiffError: naming the known subjects.
        """
        if subject not in self.templates:
            raise FaceDiffError(
                f'identity: there is no "{subject}"; the checkpoint knows {", ".join(sorted(self.templates))}'
            )
        return self.templates[subject]

    def identity_index(self, subject: str) -> int:
        """Index of a training identity, −1 for anybody else."""
        return self.identities.index(subject) if subject in self.identities else -1

    def with_motion_scale(self, scale: float | None) -> Assets:
        """The same with another motion scale."""
        return replace(self, motion_scale=scale)

    def state(self) -> dict[str, Any]:
        """Plain containers and tensors, fit for a checkpoint that is loaded with ``weights_only=True``."""
        state = dict(vars(self))
        state["references"] = {name: (r.clip, r.motion) for name, r in self.references.items()}
        return state

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Assets:
        """The inverse of :meth:`state`."""
        references = {name: Reference(clip, motion) for name, (clip, motion) in state["references"].items()}
        return cls(**{**state, "references": references})
