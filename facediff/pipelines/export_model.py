"""A trained model as a folder that animates without PyTorch: its graphs, its numbers, and a check against the model."""

from __future__ import annotations

import hashlib
import io
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
import numpy.typing as npt

from facediff.animation.styles import Stillness, stillness_of
from facediff.errors import FaceDiffError, MissingExtraError, check_known
from facediff.runtime.folder import ARRAYS, DESCRIPTION, Description, packed_deltas, read_folder
from facediff.utils import SAMPLE_RATE
from facediff.utils.files import atomic_folder
from facediff.utils.licences import licence_metadata
from facediff.utils.limits import brief
from facediff.utils.plain_files import write_json
from facediff.version import __version__

if TYPE_CHECKING:
    import onnx
    import torch

    from facediff.data import Assets, Reference
    from facediff.models.base import AnimationModel
    from facediff.models.graphs import Graph, Graphs
    from facediff.models.inference import Style
    from facediff.spaces.decoding import ChannelDecoder
    from facediff.speech.windows import FrameClock

Precision = Literal["float32", "float16", "int8"]

OPSET = 20
"""Version of ONNX's operators; ONNX Runtime 1.17 and its web build know it."""

SMALLEST = 4096
"""Numbers of a weight that is worth storing in fewer bits; smaller ones stay exact."""

ENDLESS = 1e9
"""Seconds that stand for no limit, since JSON knows no infinity."""

LARGE = 1_000_000
"""Numbers that are worth storing in fewer bits though they are not learnt, such as weights in another order."""

TOLERANCE = 1e-4
"""Largest difference from PyTorch in float32, as a share of the motion's range."""


def export_model(
    model: AnimationModel,
    folder: Path,
    *,
    precision: Precision = "float32",
    speech: npt.NDArray[np.float32] | None = None,
    identities: Sequence[str] | None = None,
    styles: Mapping[str, Style] | None = None,
) -> Description:
    """Write a model as graphs for ONNX Runtime, with everything that animating needs.

    Weights may be stored in 16 or 8 bits; they are widened when the graph is loaded, and everything is computed in
    float32. In ``int8`` the audio encoder's take 8 bits a number, with a scale for each output channel, and all
    others 16.

    Args:
        model: a trained model with the sampler and the windows that the folder is to have.
        folder: to write; it must not exist.
        precision: how weights are stored.
        speech: (S,) at 16 kHz that the folder is compared with the model on; noise bursts if None.
        identities: faces and styles of the folder; all that the model knows if None.
        styles: further styles by their names.
    """
    from facediff.pipelines.trained import with_rig

    require_onnx()
    _ = with_rig(model.assets).mesh  # refused before graphs are recorded, which takes a minute
    graphs = model.graphs()
    known_identities = list(model.assets.templates)
    check_known("{identities}", "identity", identities or (), known_identities)
    whose = known_identities if identities is None else [name for name in known_identities if name in set(identities)]
    with atomic_folder(folder) as staged:
        sizes, described = {}, {}
        for part in graphs.parts:
            document = record(part)
            # After the audio encoder, errors add up over the steps.
            bits: Precision = "float16" if precision == "int8" and part.name != "speech" else precision
            store_weights(document, bits, part.module)
            path = staged / f"{part.name}.onnx"
            path.write_bytes(document.SerializeToString())
            sizes[path.name] = path.stat().st_size
            described[part.name] = described_ends(document)
        arrays, style_names = arrays_of(model, graphs, whose, styles or {})
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
        (staged / ARRAYS).write_bytes(buffer.getvalue())
        sizes[ARRAYS] = len(buffer.getvalue())
        description = describe(model, graphs, precision, sizes, described, style_names, whose)
        write_json(staged / DESCRIPTION, description.content())
        read_folder(staged)  # the folder must be readable
        checked = replace(
            description, check=compare(model, staged, trial_speech() if speech is None else speech, styles)
        )
        share = checked.check["share_of_range"]
        if precision == "float32" and not share <= TOLERANCE:
            raise FaceDiffError(
                f"{folder}: differs from PyTorch by {share:.1e} of the motion's range; expected at most {TOLERANCE:g}"
            )
        write_json(staged / DESCRIPTION, checked.content())
    return checked


def require_onnx() -> None:
    """Refuse to begin without the packages."""
    import importlib.util

    for package in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(package, "onnx", "exporting a model")


def record(graph: Graph) -> onnx.ModelProto:
    """Record a graph with PyTorch's exporter; axes of any length get the names that the graph gives them."""
    import torch
    from torch.export import Dim
    from torch.utils._sympy.numbers import int_oo

    shapes = tuple(dict.fromkeys(graph.axes.get(name, {}), Dim.DYNAMIC) for name in graph.inputs)
    try:
        with quiet():
            program = torch.onnx.export(
                graph.module.eval(),
                tuple(graph.inputs.values()),
                dynamo=True,
                opset_version=OPSET,
                input_names=list(graph.inputs),
                output_names=list(graph.outputs),
                dynamic_shapes=shapes,
                verbose=False,
            )
    except Exception as error:  # of any component while it is recorded
        raise FaceDiffError(
            f"{graph.name}: PyTorch cannot record this part of the model as a graph "
            f"({brief(error.__cause__ or error)}); choose components that do not depend on values, or report it"
        ) from error
    if program is None or program.exported_program is None:
        raise FaceDiffError(f"{graph.name}: PyTorch gave no graph; install the PyTorch that facediff was tested with")
    if any(lengths.upper != int_oo for lengths in program.exported_program.range_constraints.values()):
        raise FaceDiffError(f"{graph.name}: a component branches on the clip's length, as no graph can; choose another")
    document: onnx.ModelProto = program.model_proto
    names: dict[str, str] = {}
    for value_info in document.graph.input:
        for axis, name in graph.axes.get(value_info.name, {}).items():
            names.setdefault(value_info.type.tensor_type.shape.dim[axis].dim_param, name)
    for value_info in [*document.graph.input, *document.graph.output, *document.graph.value_info]:
        for dim in value_info.type.tensor_type.shape.dim:
            if dim.dim_param:
                dim.dim_param = names.get(
                    dim.dim_param, "frames" if value_info.name in graph.outputs else dim.dim_param
                )
    # Where the modules stand in the source says nothing to a reader of the file, and paths are private.
    for node in document.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    document.producer_name, document.producer_version = "facediff", __version__
    return document


@contextmanager
def quiet() -> Iterator[None]:
    """Without the exporter's remarks and graphs, and without checks of shapes.

    While a graph is recorded, symbols stand for numbers. Where shapes are checked at run time, as in facediff's tests,
    the checks would take them for wrong types.
    """
    from jaxtyping import config

    checked = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "torch.fx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), redirect_stderr(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        config.update("jaxtyping_disable", checked)
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def store_weights(document: onnx.ModelProto, precision: Precision, module: torch.nn.Module) -> None:
    """Store large weights in fewer bits, each followed by a node that widens it.

    Numbers that are not learnt, such as the kernel of spectra, stay as they are unless they take megabytes.
    """
    from onnx import TensorProto, helper, numpy_helper

    if precision == "float32":
        return
    graph, learnt = document.graph, digests(module)
    nodes = []
    for initializer in list(graph.initializer):
        if initializer.data_type != TensorProto.FLOAT or int(np.prod(initializer.dims)) < SMALLEST:
            continue
        weight, name = numpy_helper.to_array(initializer), initializer.name
        # A logarithm follows the spectra: what eight bits do to its kernel drowns soft sounds.
        if weight.size < LARGE and digest(weight) not in learnt:
            continue
        if precision == "float16" or weight.ndim < 2:
            if float(np.abs(weight).max()) > float(np.finfo(np.float16).max):
                continue
            stored = [numpy_helper.from_array(weight.astype(np.float16), f"{name}_16")]
            nodes.append(helper.make_node("Cast", [f"{name}_16"], [name], to=TensorProto.FLOAT))
        else:
            # A convolution's kernel has its output channels first, the right side of a product has them last.
            axis = 0 if weight.ndim > 2 else weight.ndim - 1
            other_axes = tuple(dimension for dimension in range(weight.ndim) if dimension != axis)
            scale = np.maximum(np.abs(weight).max(axis=other_axes), 1e-12).astype(np.float32) / 127
            along = scale.reshape([-1 if dimension == axis else 1 for dimension in range(weight.ndim)])
            stored = [
                numpy_helper.from_array(np.rint(weight / along).astype(np.int8), f"{name}_8"),
                numpy_helper.from_array(along, f"{name}_scale"),
            ]
            # Not DequantizeLinear, which ONNX Runtime fuses with the product into one of whole numbers: four times the
            # error, and NaN for some inputs. These two nodes are computed once, when the graph is loaded.
            nodes.append(helper.make_node("Cast", [f"{name}_8"], [f"{name}_wide"], to=TensorProto.FLOAT))
            nodes.append(helper.make_node("Mul", [f"{name}_wide", f"{name}_scale"], [name]))
        graph.initializer.remove(initializer)
        graph.initializer.extend(stored)
    for node in reversed(nodes):
        graph.node.insert(0, node)


def digests(module: torch.nn.Module) -> set[bytes]:
    """The weights of a module and their transposes, which graphs hold of linear maps, as :func:`digest` gives them."""
    weights = [weight.detach().float().cpu().numpy() for weight in module.parameters()]
    return {digest(form) for weight in weights for form in (weight, weight.T)}


def digest(array: npt.NDArray[Any]) -> bytes:
    """What tells arrays apart by shape and content."""
    return hashlib.sha256(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes()).digest()


def described_ends(document: onnx.ModelProto) -> dict[str, list[dict[str, Any]]]:
    """Inputs and outputs of a graph: name, type and shape."""
    from onnx import TensorProto

    def end(value_info: onnx.ValueInfoProto) -> dict[str, Any]:
        kind = value_info.type.tensor_type
        shape = [dim.dim_param or dim.dim_value for dim in kind.shape.dim]
        return {"name": value_info.name, "type": TensorProto.DataType.Name(kind.elem_type).lower(), "shape": shape}

    return {
        "inputs": [end(value_info) for value_info in document.graph.input],
        "outputs": [end(value_info) for value_info in document.graph.output],
    }


def arrays_of(
    model: AnimationModel, graphs: Graphs, faces: list[str], extra_styles: Mapping[str, Style]
) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
    """What ``arrays.npz`` holds for these faces, and the names of its styles."""
    from facediff.editing.controls.expressiveness import rest_weights
    from facediff.models.styles import vector_of
    from facediff.pipelines.trained import facts_of, with_rig

    assets = with_rig(model.assets).mesh
    facts = facts_of(assets)
    regions = facts["regions"]
    templates = np.stack([np.asarray(assets.templates[name], np.float32) for name in faces])
    arrays: dict[str, npt.NDArray[Any]] = {
        "templates": templates,
        "rest_weights": np.stack([rest_weights(template, regions) for template in templates]),
        **{f"region_{name}": indices for name, indices in regions.items()},
    }
    for name in ("faces", "colours", "inner_lip_pairs"):
        if facts[name] is not None:
            arrays[name] = facts[name]
    if assets.identity_colours:  # of each face
        grey = np.full((assets.n_vertices, 3), 190, np.uint8)
        face_colours = [assets.colours_of(name) for name in faces]
        arrays["colours"] = np.stack([grey if colours is None else colours.numpy() for colours in face_colours])
    if not model.assets.space.is_vertices:
        arrays |= channel_arrays(model.assets, faces)
    if graphs.sampling is not None and graphs.sampling.noise is not None:
        arrays["noise"] = graphs.sampling.noise.numpy()
    if graphs.style != "reference":
        return arrays, list(assets.identities) if graphs.style == "identity" else []
    references_by_name: dict[str, Reference | Style] = {}
    for name in [name for name in dict.fromkeys([*model.styled_identities(), *faces]) if name in faces]:
        with suppress(FaceDiffError):  # a face without a style is given one by name
            references_by_name[name] = model.default_style(name)
    # Where identities do without their stored clips, these are styles by their own names, as in a checkpoint.
    defaults = {id(style) for style in references_by_name.values()}
    references = model.assets.references
    stored = [references[name] for name in faces if name in references]
    references_by_name |= {reference.clip: reference for reference in stored if id(reference) not in defaults}
    references_by_name |= extra_styles
    styles = {name: vector_of(style, model).numpy() for name, style in references_by_name.items()}
    if not styles:
        raise FaceDiffError("styles: the checkpoint holds no reference motion; train with a corpus that gives one")
    arrays["styles"] = np.stack(list(styles.values()))
    if (stillness := model_stillness(model)) is not None:
        arrays["still"] = stillness.vertices
    return arrays, list(styles)


def channel_arrays(assets: Assets, faces: list[str]) -> dict[str, npt.NDArray[Any]]:
    """What ``arrays.npz`` holds besides of a model of channels: their values at rest, and the rigs that decode them."""
    from facediff.pipelines.trained import decoder_of, with_rig

    rigged = with_rig(assets)
    decoders = [cast("ChannelDecoder", decoder_of(rigged, name)) for name in faces]
    # Most corpora have one rig for all of their speakers.
    keys = [digest(decoder.deltas) for decoder in decoders]
    rigs = dict(zip(keys, (decoder.deltas for decoder in decoders), strict=True))
    deltas, scales = packed_deltas(np.stack([*rigs.values()]))
    return {
        "resting": np.stack([decoder.resting for decoder in decoders]).astype(np.float32),
        "rest_weights": np.stack([decoder.rest_weights for decoder in decoders]),
        "deltas": deltas,
        "delta_scales": scales,
        "rigs": np.array([[*rigs].index(key) for key in keys], np.int32),
    }


def model_stillness(model: AnimationModel) -> Stillness | None:
    """Where the model's faces keep still, by its stored references; None for channels."""
    if not model.assets.space.is_vertices:
        return None
    return stillness_of([reference.motion.float().numpy() for reference in model.assets.references.values()])


def describe(
    model: AnimationModel,
    graphs: Graphs,
    precision: Precision,
    sizes: dict[str, int],
    described: dict[str, dict[str, list[dict[str, Any]]]],
    styles: list[str],
    faces: list[str],
) -> Description:
    """What ``model.json`` says."""
    from facediff.models.graphs import NO_LOOP
    from facediff.pipelines.trained import with_rig

    assets, plan = model.assets, model.windows
    stillness = model_stillness(model) if graphs.style == "reference" else None
    return Description(
        model=type(model).__name__,
        facediff=__version__,
        corpus=assets.corpus,
        synthetic=assets.synthetic,
        licences=licence_metadata(model.licences),
        opset=OPSET,
        precision=precision,
        sizes=sizes,
        graphs=described,
        sample_rate=SAMPLE_RATE,
        frame_rate=assets.frame_rate,
        unit=with_rig(assets).mesh.unit,
        identities=list(assets.identities),
        faces=faces,
        styles=styles,
        windows={name: min(float(value), ENDLESS) for name, value in vars(plan).items()},
        epsilon=graphs.epsilon,
        equal_lengths=graphs.equal_lengths,
        generation="sampled" if graphs.sampling else "direct",
        blending=graphs.blending,
        clock=clock_facts(graphs.clock),
        style_source=graphs.style,
        longest=graphs.longest,
        stillness=stillness.size if stillness else 0.0,
        usual_expressivity=float(model.expressivity),
        voice_gate=model.usual_gate,
        space={} if assets.space.is_vertices else assets.space.state(),
        **{name: value for name, value in vars(graphs.sampling or NO_LOOP).items() if name != "noise"},
    )


def clock_facts(clock: FrameClock) -> dict[str, Any]:
    """A clock as ``model.json`` says it; what its rule has no use for is left out."""
    facts: dict[str, Any] = {"rule": clock.rule}
    if clock.rule in ("steps", "pairs", "seconds_or_pairs"):
        facts["convolutions"] = [list(layer) for layer in clock.convolutions]
    return facts | ({"rows": clock.rows} if clock.rule == "rows" else {})


def compare(
    model: AnimationModel,
    folder: Path,
    speech: npt.NDArray[np.float32],
    extra_styles: Mapping[str, Style] | None = None,
) -> dict[str, Any]:
    """The folder against the model on some speech: largest difference of a number, alone and by the range."""
    import torch

    from facediff.runtime.model import RuntimeModel

    runtime = RuntimeModel.open(folder)
    about = runtime.description
    face = about.faces[0]
    style, reference = None, None
    if about.style_source == "reference":
        style = face if face in about.styles else about.styles[0]
        reference = (extra_styles or {}).get(style) or model.default_style(style)
    audio = torch.from_numpy(speech).to(model.device)
    expected = model.animate(audio, identity=face, style=reference, seed=3).vertices.numpy()
    stream = runtime.stream(identity=face, style=style, seed=3)
    exported = runtime.motion(speech, stream)
    span = float(np.ptp(expected - stream.conditions.template))
    difference = float(np.abs(exported - expected).max())
    return {
        "seconds": round(len(speech) / SAMPLE_RATE, 3),
        "identity": face,
        "largest_difference": difference,
        "share_of_range": difference / max(span, 1e-12),
    }


def trial_speech() -> npt.NDArray[np.float32]:
    """Two seconds of bursts of noise with a slow tone, for a comparison without a recording."""
    time = np.arange(2 * SAMPLE_RATE) / SAMPLE_RATE
    bursts = np.sin(2 * np.pi * 3 * time) > 0
    sound = np.random.default_rng(0).normal(size=len(time)) * 0.05 + 0.2 * np.sin(2 * np.pi * 160 * time)
    return (sound * bursts).astype(np.float32)
