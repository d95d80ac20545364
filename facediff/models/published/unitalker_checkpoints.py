"""UniTalker's released files: the checkpoint of the network, and what its data release holds of a face.

The checkpoint has one table of speakers of all data sets, in their order, and a head for each kind of face; principal
components and neutral faces are in the data release (``pca.npz`` and ``id_template.npy`` of each data set).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facediff.errors import FaceDiffError, OptionError, choices
from facediff.models.published.autoregressive import read_period
from facediff.models.published.convolutions import AUTHORS_NAMES
from facediff.models.published.faceformer import LAYER_NAMES
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.recognition import AuthorsWeights, CheckpointFacts, FaceFacts, Recogniser, register
from facediff.models.published.unitalker import COMMON, UniTalker
from facediff.spaces import VERTICES, Space
from facediff.spaces.layouts import find_layout, parametric
from facediff.utils.arrays import open_array, read_arrays
from facediff.utils.licences import Licence


@dataclass(frozen=True)
class ReleasedData:
    """One of UniTalker's data sets.

    Attributes:
        folder: in the data release.
        head: of the checkpoint.
        width: numbers of a frame.
        subjects: rows of the table of speakers.
        scale: what its neutral faces are multiplied by.
        template_row: of ``id_template.npy``, as the published demo takes it.
        layout: of the channels; empty for vertices.
        licence: of the data set.
    """

    folder: str
    head: str
    width: int
    subjects: int
    scale: float = 1.0
    template_row: int = 0
    layout: str = ""
    licence: Licence = Licence("")

    @property
    def frame_rate(self) -> float:
        """Frames a second."""
        return 25.0 if self.head.startswith("BIWI") else 30.0


def _non_commercial(of: str, source: str) -> Licence:
    return Licence(f"corpus {of}", "CC-BY-NC-4.0", "forbidden", source)


RELEASE = "github.com/X-niper/UniTalker"

DATA: dict[str, ReleasedData] = {
    "D0": ReleasedData(
        *("D0_BIWI", "BIWI_23370_vertices", 70110, 6, 0.2, 3, "", _non_commercial("BIWI", RELEASE)),
    ),
    "D1": ReleasedData(
        *("D1_vocaset", "FLAME_5023_vertices", 15069, 12, 1.0, 3, "", _non_commercial("VOCASET", RELEASE)),
    ),
    "D2": ReleasedData(
        *("D2_meshtalk", "meshtalk_6172_vertices", 18516, 13, 0.001, 0, "", _non_commercial("MeshTalk", RELEASE)),
    ),
    "D3": ReleasedData("D3D4_3DETF/D3_HDTF", "3DETF_blendshape_weight", 52, 141, layout="arkit"),
    "D4": ReleasedData("D3D4_3DETF/D4_RAVDESS", "3DETF_blendshape_weight", 52, 24, layout="arkit"),
    "D5": ReleasedData("D5_unitalker_faceforensics++", "flame_params_from_dadhead", 413, 719, layout="unitalker_d5"),
    "D6": ReleasedData(
        "D6_unitalker_Chinese_speech", "inhouse_blendshape_weight", 51, 8, template_row=4, layout="arkit_51"
    ),
    "D7": ReleasedData("D7_unitalker_song", "inhouse_blendshape_weight", 51, 11, layout="arkit_51"),
}
"""The eight data sets, in the order of the table's rows."""

TABLE, DEFAULT = "decoder.learnable_style_emb.weight", "D3"


def space_of(released: ReleasedData) -> Space:
    """What the numbers of a head mean; FLAME's 413 with the 300 of the shape, which the released model predicts too."""
    if not released.layout:
        return VERTICES
    layout = find_layout(released.layout)
    if not layout.identity:
        return layout.space
    turns: dict[int, Any] = {rotation.start: (rotation.joint, rotation.form) for rotation in layout.space.rotations}
    inside = {channel for rotation in layout.space.rotations for channel in rotation.channels}
    parts: list[Any] = [f"shape {layout.identity}"]
    for place, name in enumerate(layout.space.channels):
        if place in turns:
            parts.append(turns[place])
        elif place not in inside:
            parts.append(name)
    return parametric("flame", parts, version=layout.space.version)


def faces(weights: AuthorsWeights, options: ImportOptions) -> FaceFacts:
    """The chosen data set's frame rate, speakers and neutral face.

    Raises:
        FaceDiffError: if there is no such data set, or its files are missing or do not fit.
    """
    name = options.dataset or DEFAULT
    if name not in DATA:
        raise OptionError.naming(f"{{dataset}} {name}: UniTalker has no such data set: {choices(name, DATA)}")
    released, rows = DATA[name], weights.shape(TABLE)[0]
    expected = sum(entry.subjects for entry in DATA.values()) + 1
    if rows != expected and options.identities is None:
        raise OptionError.naming(
            f"{weights.source}: has {rows} rows of speakers, and all data sets together have {expected} with the "
            f"common one; give {{identities}} with {rows - 1} names, if it was trained on {name} alone"
        )
    alone = rows != expected
    names = list(options.identities or [f"{name}_{row}" for row in range(released.subjects)])
    if len(names) != (rows - 1 if alone else released.subjects):
        raise OptionError.naming(
            f"{{identities}}: {len(names)} names are given, and {name} has {rows - 1 if alone else released.subjects} "
            f"speakers"
        )
    width = weights.shape(f"out_head_dict.{released.head}.weight")[0]
    notes: list[str] = []
    root = None if options.data_root is None else Path(options.data_root)
    template = np.zeros((1, released.width), np.float32)
    row = released.template_row if options.template_row is None else options.template_row
    if root is not None:
        template = released_array(root, released.folder, "id_template.npy", (None, released.width))
        if not 0 <= row < len(template):
            raise OptionError.naming(f"{{template_row}} {row}: {root / released.folder} has {len(template)} faces")
        template = template[row : row + 1]
    elif not released.layout:
        raise OptionError.naming(
            f"{weights.source}: its vertices are principal components, which the checkpoint does not hold; give "
            f"{{data_root}} with the data release's {released.folder}/pca.npz and id_template.npy"
        )
    elif options.template_row is not None:
        raise OptionError.naming("{template_row}: is a row of the data release; give {data_root} too, or omit it")
    else:
        notes.append("no --data-root: the published code adds the neutral values of id_template.npy, here they are 0")
    space = space_of(released)
    face = torch.from_numpy(template[0].astype(np.float32) * np.float32(released.scale)).view(-1, space.dims)
    start = 0 if alone else sum(entry.subjects for key, entry in DATA.items() if key < name)
    return FaceFacts(
        corpus=f"UniTalker {name}",
        space=space,
        frame_rate=released.frame_rate,
        identities=names,
        n_points=len(face),
        templates=dict.fromkeys([COMMON, *names], face),
        licences=() if not released.licence.of else (released.licence,),
        notes=notes,
        details={"data": released, "start": start, "root": root, "width": width},
    )


def released_array(root: Path, folder: str, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """An array of the data release.

    Raises:
        FaceDiffError: if it cannot be read or has another shape.
    """
    path = root / folder / name
    if not path.is_file():
        raise OptionError.naming(f"{{data_root}} {root}: has no {folder}/{name}; expected UniTalker's data release")
    array = np.asarray(open_array(path, kinds="f"))
    if array.ndim != len(shape) or any(size not in (None, own) for size, own in zip(shape, array.shape, strict=True)):
        raise FaceDiffError(f"{path}: has the shape {array.shape}, expected {shape}; is it of another release?")
    return array


def components_of(root: Path, released: ReleasedData, count: int) -> tuple[Tensor, Tensor]:
    """Mean and principal components of a data set's vertices."""
    path = root / released.folder / "pca.npz"
    if not path.is_file():
        raise OptionError.naming(
            f"{{data_root}} {root}: has no {released.folder}/pca.npz; expected UniTalker's data release"
        )
    archive = read_arrays(path, ("original_data_mean", "components_to_data"), remedy="download it again")
    parts = []
    for name, shape in (("original_data_mean", (released.width,)), ("components_to_data", (None, released.width))):
        array = archive.get(name)
        if array is None or array.dtype.kind != "f" or array.ndim != len(shape) or array.shape[-1] != released.width:
            raise FaceDiffError(f"{path}: its {name} is missing, or not of {released.width} numbers")
        parts.append(torch.from_numpy(np.asarray(array, np.float32)))
    if len(parts[1]) < count:
        raise FaceDiffError(f"{path}: has {len(parts[1])} components, the checkpoint's head {count}; is it another's?")
    return parts[0], parts[1][:count].contiguous()


def convert(weights: AuthorsWeights, facts: CheckpointFacts) -> dict[str, Any]:
    """The tensors of one head under the names of the model, and its options."""
    details = facts.details
    released, start = details["data"], details["start"]
    wavlm = "audio_encoder.encoder.layers.0.attention.rel_attn_embed.weight" in weights
    # The published B model hears the waveform as it is, the L model what is standardised.
    settings = {**UniTalker.encoder_settings(), "do_normalize": not wavlm}
    encoder = weights.backbone("audio_encoder.", kind="wavlm" if wavlm else "wav2vec2", facts=facts, **settings)
    table = weights.get(TABLE)
    count = len(facts.identities)
    weights.renamed["network.style.weight"] = torch.cat([table[start : start + count], table[-1:]])
    weights.move_all("decoder.audio_feature_map.", "network.audio_map.")
    head = f"out_head_dict.{released.head}."
    weights.move_all(head, "network.head.")
    for name in weights.names("out_head_dict."):
        if not name.startswith(head):
            weights.ignore(name, f"a head for other faces than those of {facts.dataset}; import it with --dataset")
    weights.ignore("pca_layer_dict.", "principal components, which are read from the data release")
    components = 0
    if released.layout == "":
        components = details["width"]
        mean, basis = components_of(details["root"], released, components)
        weights.renamed["network.mean"], weights.renamed["network.basis"] = mean, basis
    dim = weights.shape("decoder.audio_feature_map.weight")[0]
    options: dict[str, Any] = {"audio_encoder": encoder, "dim": dim, "components": components}
    if "decoder.PPE.pe" in weights:
        period = read_period(weights, "decoder.PPE.pe", facts, any_rate=True)
        weights.ignore("decoder.biased_mask", "the attention's bias is computed by its formula")
        first = "0.self_attn.in_proj_weight"  # whatever the decoder's own name is
        prefix = next((name.removesuffix(first) for name in weights.names("decoder.") if name.endswith(first)), "")
        weights.move_all(prefix or "decoder.transformer_decoder.layers.", "network.transformer.layers.", LAYER_NAMES)
        return {**options, "decoder_type": "transformer", "period": period}
    weights.move_all("decoder.tcn.first_net.conv_layers.", "network.convolutions.layers.", AUTHORS_NAMES)
    return {**options, "style_dim": table.shape[1]}


register(
    Recogniser(
        method="UniTalker",
        marks=(TABLE, "decoder.audio_feature_map.weight"),
        unless=(),
        convert=convert,
        vertices=lambda weights: 0,  # noqa: ARG005 - of the chosen head
        count=lambda weights: weights.shape(TABLE)[0] - 1,
        faces=faces,
        reads=("dataset", "identities", "mesh", "data_root", "template_row"),
        licence="Apache-2.0",
        commercial="allowed",
        licence_source=RELEASE,
    )
)
