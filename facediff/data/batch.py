"""The data contract: one clip, one batch of clips, and the part of a corpus that a checkpoint keeps.

Audio is 16 kHz mono float32 and spans exactly the time of the motion. Motion is offsets from the speaker's neutral
template, (frames, points, dims): of vertices in the corpus's unit of length, or of the channels of a parametric space
(:mod:`facediff.spaces`). Tensors are padded with zeros; lengths tell which part is valid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from facediff.errors import FaceDiffError, check_known
from facediff.spaces import VERTICES, Space
from facediff.spaces.rigs import LinearRig
from facediff.utils.hints import is_name
from facediff.utils.limits import FRAME_RATES, quoted

UNKNOWN_IDENTITY = -1


@dataclass
class Sample:
    """One clip.

    Attributes:
        audio: waveform at 16 kHz.
        motion: offsets from the template; in training the components (frames, K) of these, where the model asks for
            them (:meth:`~facediff.models.AnimationModel.training_projection`), and so in ``reference``.
        template: neutral face.
        identity: index into the training identities, −1 for any other.
        reference: motion that carries the speaking style.
        name: the clip's name, ``<identity>_<sentence>``.
        identity_name: the speaker's name.
        sentence: which sentence is spoken.
        reference_name: the clip that the reference comes from.
        decoy_audio: speech of another sentence, as long as ``audio``; only for evaluation against shuffled audio.
        features: the clip's speech, encoded by the frozen part of the audio encoder; None where it is not cached.
        repeated: whether another process scores the same clip, so that this one must not.
        style: a style vector to be used instead of encoding ``reference``.
        window: the first frame that counts and the one after the last, where ``motion`` has frames around a training
            window; None where all frames count.
        partner_frames: for each frame the corresponding frame of the neighbour in the batch, which speaks the same
            sentence; −1 where it lies outside the neighbour's sample. None where the two were not aligned.
    """

    audio: Float[Tensor, " samples"]
    motion: Float[Tensor, "frames points dims"]
    template: Float[Tensor, "points dims"]
    identity: int
    reference: Float[Tensor, "reference_frames points dims"]
    name: str
    identity_name: str
    sentence: str
    reference_name: str
    decoy_audio: Float[Tensor, " samples"] | None = None
    features: Float[Tensor, "steps channels"] | None = None
    repeated: bool = False
    style: Float[Tensor, " style_dim"] | None = None
    window: tuple[int, int] | None = None
    partner_frames: Int[Tensor, " frames"] | None = None


@dataclass
class Batch:
    """Several clips, padded to the longest.

    The fields have the names of :class:`Sample` and a batch dimension; a field that only some clips have is None. The
    lengths count each clip's valid samples, frames and steps; ``decoy_audio`` is as long as ``audio``. Where several
    corpora are trained on together, ``face`` names the one of :attr:`SpeechMotionDataModule.further` that all clips are
    from; it is empty for the data module's own.
    """

    audio: Float[Tensor, "batch samples"]
    audio_lengths: Int[Tensor, " batch"]
    motion: Float[Tensor, "batch frames points dims"]
    frame_lengths: Int[Tensor, " batch"]
    template: Float[Tensor, "batch points dims"]
    identity: Int[Tensor, " batch"]
    reference: Float[Tensor, "batch reference_frames points dims"]
    reference_lengths: Int[Tensor, " batch"]
    names: list[str]
    identity_names: list[str]
    sentences: list[str]
    reference_names: list[str]
    decoy_audio: Float[Tensor, "batch samples"] | None = None
    features: Float[Tensor, "batch steps channels"] | None = None
    feature_lengths: Int[Tensor, " batch"] | None = None
    repeated: bool = False
    style: Float[Tensor, "batch style_dim"] | None = None
    window: Int[Tensor, "batch 2"] | None = None
    partner_frames: Int[Tensor, "batch frames"] | None = None
    face: str = ""

    @property
    def mask(self) -> Bool[Tensor, "batch frames"]:
        """True on valid frames."""
        return torch.arange(self.motion.shape[1], device=self.motion.device) < self.frame_lengths[:, None]

    @property
    def window_mask(self) -> Bool[Tensor, "batch frames"]:
        """True on the valid frames that count: training windows without the frames around them."""
        if self.window is None:
            return self.mask
        frames = torch.arange(self.motion.shape[1], device=self.motion.device)
        return self.mask & (frames >= self.window[:, :1]) & (frames < self.window[:, 1:])

    @property
    def reference_mask(self) -> Bool[Tensor, "batch reference_frames"]:
        """True on valid frames of the references."""
        frames = torch.arange(self.reference.shape[1], device=self.reference.device)
        return frames < self.reference_lengths[:, None]

    @property
    def cached_features(self) -> tuple[Tensor, Tensor] | None:
        """Features of the frozen part of the audio encoder with their lengths; None if they are not cached."""
        if self.features is None or self.feature_lengths is None:
            return None
        return self.features, self.feature_lengths

    def __len__(self) -> int:
        """Number of clips."""
        return len(self.names)

    def to(self, device: torch.device | str) -> Batch:
        """The same batch on another device."""
        moved: dict[str, Any] = {
            name: value.to(device, non_blocking=True) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **moved)

    def select(self, clips: Sequence[int]) -> Batch:
        """Some of the clips, in the order given, padded to the longest of them."""
        indices = torch.as_tensor(clips, device=self.motion.device)
        lengths = {
            "audio": self.audio_lengths,
            "decoy_audio": self.audio_lengths,
            "motion": self.frame_lengths,
            "reference": self.reference_lengths,
            "features": self.feature_lengths,
            "partner_frames": self.frame_lengths,
        }
        fields: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                counts = lengths.get(name)
                fields[name] = value[indices] if counts is None else value[indices][:, : int(counts[indices].max())]
            elif isinstance(value, list):
                fields[name] = [value[clip] for clip in clips]
        return replace(self, **fields)

    def pin_memory(self) -> Batch:
        """The same batch in page-locked memory; called by PyTorch's loaders."""
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(self, name, value.pin_memory())
        return self


def clips_in(batch: Batch) -> int:
    """Number of clips of a batch, for Lightning's throughput monitor."""
    return len(batch)


def pad(tensors: Sequence[Tensor]) -> Tensor:
    """Stack tensors, padded with zeros to the longest; one alone is not copied, for motion is large."""
    return tensors[0][None] if len(tensors) == 1 else pad_sequence(list(tensors), batch_first=True)


def collate(samples: Sequence[Sample]) -> Batch:
    """Pad samples to a batch."""
    decoys = [s.decoy_audio for s in samples if s.decoy_audio is not None]
    features = [s.features for s in samples if s.features is not None]
    styles = [s.style for s in samples if s.style is not None]
    cached = len(features) == len(samples)
    windows = [s.window for s in samples if s.window is not None]
    aligned = any(s.partner_frames is not None for s in samples)
    return Batch(
        audio=pad([s.audio for s in samples]),
        audio_lengths=torch.tensor([len(s.audio) for s in samples]),
        motion=pad([s.motion for s in samples]),
        frame_lengths=torch.tensor([len(s.motion) for s in samples]),
        template=torch.stack([s.template for s in samples]),
        identity=torch.tensor([s.identity for s in samples]),
        reference=pad([s.reference for s in samples]),
        reference_lengths=torch.tensor([len(s.reference) for s in samples]),
        names=[s.name for s in samples],
        identity_names=[s.identity_name for s in samples],
        sentences=[s.sentence for s in samples],
        reference_names=[s.reference_name for s in samples],
        decoy_audio=pad(decoys) if len(decoys) == len(samples) else None,
        features=pad(features) if cached else None,
        feature_lengths=torch.tensor([len(f) for f in features]) if cached else None,
        repeated=samples[0].repeated,
        style=torch.stack(styles) if len(styles) == len(samples) else None,
        window=torch.tensor(windows) if len(windows) == len(samples) else None,
        partner_frames=_pad_partners(samples) if aligned else None,
    )


def _pad_partners(samples: Sequence[Sample]) -> Int[Tensor, "batch frames"]:
    """The samples' partner frames; −1 on padding and for samples that are not aligned."""
    rows = [torch.full((len(s.motion),), -1) if s.partner_frames is None else s.partner_frames for s in samples]
    return pad_sequence(rows, batch_first=True, padding_value=-1)


# The part of a corpus that a checkpoint keeps, so that it animates a face without the corpus.

FORMAT_KEY = "facediff_format"
"""Where a checkpoint keeps :data:`FORMAT`."""

FORMAT = 2
"""Number of the format of checkpoints; others are refused."""

ASSETS_KEY = "facediff_assets"
"""Where a checkpoint keeps :meth:`Assets.state`."""

DATA_SOURCE_KEY = "facediff_data"
"""Where a checkpoint keeps which data module it was trained on (``class_path``) and where the corpus was (``root``)."""


@dataclass(frozen=True)
class Reference:
    """A reference motion that carries a speaking style."""

    clip: str  # the clip that it comes from
    motion: Float[Tensor, "frames points dims"]  # offsets from the template, half precision to keep checkpoints small


@dataclass(frozen=True)
class Rig:
    """What turns the channels of a corpus into vertices: each speaker's own shapes."""

    mesh: Assets  # the same corpus as vertices: neutral faces, triangles, colours, regions, inner lips
    # by speaker, what each channel of face moves the vertices by at 1, (K, V, 3)
    deltas: dict[str, Float[Tensor, "face vertices 3"]]

    @classmethod
    def of(cls, linear: LinearRig, assets: Assets) -> Rig:
        """A linear rig for all speakers of a corpus; channels without displacements in it move nothing.

        Its lips and upper face are the vertices that the channels of these regions move at least half as far as any.
        """
        rows = {name.casefold(): row for row, name in enumerate(linear.names)}
        names = [assets.space.channels[channel].casefold() for channel in assets.space.face]
        if not rows.keys() & set(names):
            raise FaceDiffError(
                f"{linear.title or 'rig'}: has none of the channels of {assets.corpus} ({', '.join(names[:3])} …); "
                f"give a rig with shapes of these names"
            )
        zero = np.zeros(linear.neutral.shape)
        shapes = np.stack([linear.deltas[rows[name]] if name in rows else zero for name in names])
        deltas = torch.from_numpy(shapes.astype(np.float32))
        sizes = {
            region: deltas[[assets.space.face.index(c) for c in channels.tolist() if c in assets.space.face]]
            .norm(dim=-1)
            .amax(0)
            for region, channels in assets.regions.items()
        }
        mesh = replace(
            assets,
            unit=linear.unit or "m",
            templates=dict.fromkeys(assets.templates, torch.from_numpy(linear.neutral.astype(np.float32))),
            faces=None if linear.faces is None else torch.from_numpy(np.asarray(linear.faces, np.int64)),
            regions={region: (size >= size.max() / 2).nonzero()[:, 0] for region, size in sizes.items()},
            references={},
            space=VERTICES,
            rig=None,
        )
        return cls(mesh, dict.fromkeys(assets.templates, deltas))

    @cached_property
    def mean(self) -> Float[Tensor, "face vertices 3"]:
        """The mean of all speakers' shapes."""
        return torch.stack([*self.deltas.values()]).mean(0)

    def decode(
        self, motion: Float[Tensor, "*frames channels 1"], space: Space, identity: str
    ) -> Float[Tensor, "*frames vertices 3"]:
        """Offsets of channels as offsets of a speaker's vertices; how the head turns as a whole is left out."""
        deltas = self.deltas_of(identity).to(motion)
        weights = motion[..., list(space.face), 0]
        return (weights @ deltas.flatten(1)).view(*weights.shape[:-1], *deltas.shape[1:])

    def deltas_of(self, identity: str) -> Float[Tensor, "face vertices 3"]:
        """A speaker's shapes; the mean of all others' where they have none of their own."""
        # Some models have thousands of speakers, so the mean is taken only where it is needed.
        shapes = self.deltas.get(identity)
        return self.mean if shapes is None else shapes

    def gram(self, weights: Float[Tensor, "vertices 3"]) -> Float[Tensor, "face face"]:
        """Products D Dᵀ of the weighted deltas D, the mean over speakers, over the number of coordinates.

        For weights w of the channels, wᵀ (D Dᵀ) w is the mean squared coordinate of the vertices that they move.
        """
        weighted = ((deltas * weights).flatten(1).double() for deltas in self.deltas.values())
        return torch.stack([deltas @ deltas.T for deltas in weighted]).mean(0) / weights.numel()


@dataclass(frozen=True)
class Assets:
    """Everything about a corpus that animation needs.

    Attributes:
        corpus: name of the corpus.
        synthetic: whether the corpus was made by a program rather than captured from people.
        unit: unit of length of templates and motion.
        frame_rate: motion frames per second.
        identities: the training identities, in the order of the identity index.
        templates: neutral face of every identity.
        faces: triangles; None where the corpus has no mesh file.
        colours: vertex colours (sRGB, 0 to 255) for pictures; None where the mesh file has none.
        regions: vertex (or channel) indices by region name: ``lips``, ``upper_face``.
        inner_lip_pairs: (upper, lower) vertex pairs on the inner lips, for the mouth's opening.
        references: a default style reference for every identity that has one.
        motion_scale: factor that gives the training motion unit variance; None until it has been measured.
        identity_colours: vertex colours of identities that have their own.
        space: meaning of the numbers of templates and motion.
        rig: turns the channels of a parametric space into vertices; None for vertices, or where it is not known.
    """

    corpus: str
    synthetic: bool
    unit: str
    frame_rate: float
    identities: list[str]
    templates: dict[str, Float[Tensor, "points dims"]]
    faces: Int[Tensor, "faces 3"] | None
    regions: dict[str, Int[Tensor, " region"]]
    colours: UInt8[Tensor, "vertices 3"] | None = None
    inner_lip_pairs: Int[Tensor, "pairs 2"] | None = None
    references: dict[str, Reference] = field(default_factory=dict)
    motion_scale: float | None = None
    identity_colours: dict[str, UInt8[Tensor, "vertices 3"]] = field(default_factory=dict)
    space: Space = VERTICES
    rig: Rig | None = None

    @property
    def n_vertices(self) -> int:
        """Points of the motion: vertices of the topology, or channels."""
        return len(next(iter(self.templates.values())))

    @property
    def mesh(self) -> Assets:
        """The corpus as vertices: these assets, or the rig's."""
        if self.space.is_vertices:
            return self
        if self.rig is None:
            raise FaceDiffError(
                f"{self.corpus}: its motion is {self.n_vertices} channels ({self.space.kind}), which no rig turns into "
                f"vertices; write the channels themselves, to .csv or .npz"
            )
        return self.rig.mesh

    @property
    def scored(self) -> Assets:
        """The assets for pictures and scores: vertices, decoded by a rig where there is one; else the channels."""
        return self if self.rig is None else self.rig.mesh

    def to_scored(
        self, motion: Float[Tensor, "*frames points dims"], identity: str
    ) -> Float[Tensor, "*frames scored_points scored_dims"]:
        """Offsets from the template in the form of :attr:`scored`."""
        return motion if self.rig is None else self.rig.decode(motion, self.space, identity)

    def template(self, identity: str) -> Float[Tensor, "points dims"]:
        """The neutral face of an identity, in the corpus's unit."""
        check_known("{identity}", "identity", [identity], self.templates)
        return self.templates[identity]

    def colours_of(self, identity: str) -> UInt8[Tensor, "vertices 3"] | None:
        """The vertex colours of an identity: its own, else from the mesh file."""
        return self.identity_colours.get(identity, self.colours)

    def identity_index(self, identity: str) -> int:
        """Index of a training identity, −1 for any other."""
        return self.identities.index(identity) if identity in self.identities else UNKNOWN_IDENTITY

    def with_motion_scale(self, scale: float | None) -> Assets:
        """The same with another motion scale."""
        return replace(self, motion_scale=scale)

    def state(self) -> dict[str, Any]:
        """Plain containers and tensors, fit for a checkpoint that is loaded with ``weights_only=True``."""
        state = dict(vars(self))
        state["references"] = {name: (r.clip, r.motion) for name, r in self.references.items()}
        # Vertices have neither, so that their checkpoints are as in versions without other spaces.
        del state["space"], state["rig"]
        if not self.space.is_vertices:
            state["space"] = self.space.state()
            state["rig"] = None if self.rig is None else {"mesh": self.rig.mesh.state(), "deltas": self.rig.deltas}
        return state

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Assets:
        """The inverse of :meth:`state`. It comes from a file, so names, shapes and indices are checked."""
        expected = {attribute.name for attribute in fields(cls)}
        # Checkpoints of 0.2 and older have no colours, and checkpoints of vertices no space.
        state = {"identity_colours": {}, "space": VERTICES.state(), "rig": None, **state}
        if state.keys() != expected:
            odd = quoted(sorted(map(str, expected ^ state.keys())))
            raise FaceDiffError(f"its assets are not those of this version of facediff (different: {odd}); train again")
        rig = state["rig"]
        assets = cls(
            **{
                **state,
                "references": {name: Reference(clip, motion) for name, (clip, motion) in state["references"].items()},
                "space": Space.from_state(state["space"]),
                "rig": None if rig is None else Rig(cls.from_state(rig["mesh"]), rig["deltas"]),
            }
        )
        if fault := assets._fault():
            raise FaceDiffError(f"its assets have {fault}. The file is damaged; get it again")
        return assets

    def _fault(self) -> str:
        """What contradicts itself and would go unnoticed: names reach files, shapes and indices select vertices."""
        mappings = (self.templates, self.regions, self.references, self.identity_colours)
        names = [self.corpus, self.unit, *self.identities, *(name for mapping in mappings for name in mapping)]
        if odd := [name for name in names if not is_name(name)]:
            return f"a name {quoted(odd[0])}; expected a short text without path separators"
        if not self.identities or len(set(self.identities)) < len(self.identities):
            return "no identities, or one of them twice"
        if not FRAME_RATES[0] <= self.frame_rate <= FRAME_RATES[1]:
            return f"a frame rate of {self.frame_rate}"
        points = (self.n_vertices, self.space.dims)
        motions = [*self.templates.values(), *(reference.motion for reference in self.references.values())]
        if any(motion.shape[-2:] != points or not motion.isfinite().all() for motion in motions):
            return f"a template or reference that is not of finite {points[0]} points in {points[1]} dimensions"
        indices = [*self.regions.values(), *(part for part in (self.faces, self.inner_lip_pairs) if part is not None)]
        if any(part.numel() and not 0 <= int(part.min()) <= int(part.max()) < points[0] for part in indices):
            return f"indices beyond {points[0] - 1}"
        if not self.space.is_vertices and points[0] != len(self.space.channels):
            return f"{points[0]} values for {len(self.space.channels)} channels"
        deltas = {} if self.rig is None else self.rig.deltas
        shape = (len(self.space.face), self.scored.n_vertices, 3)
        return next((f"shapes of {quoted(name)} of another rig" for name, d in deltas.items() if d.shape != shape), "")
