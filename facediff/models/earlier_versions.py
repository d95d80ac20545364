"""Options that classes had in 1.x and have no more, for checkpoints and configs that still state them.

An option that went had one value in practice. A file that states this value means the present behaviour, and
the option is dropped; another value asks for something that is gone, and is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from facediff.errors import FaceDiffError

ANY = "any"
"""Of a size, which the shapes of the weights tell as well, or of what changes nothing but the time that is taken."""

DUAL_PATH: dict[str, Any] = {
    **{"min_snr": None, "invented_gain": 0.1, "face_weight_unit": "scaled", "style_contrast_weight": 0.0},
    **{"speech_dropout": 0.0, "speech_guidance": 1.0, "identity_guidance": 1.0, "style_guidance": 1.0},
}

REMOVED: dict[str, dict[str, Any]] = {
    "facediff.models.dual_path.model.DualPathDiffusion": DUAL_PATH,
    "facediff.models.dual_path.many_faces.ManyFaces": DUAL_PATH,
    "facediff.models.style_content.model.StyleContentDisentanglement": {
        "basis_start": "pca",
        "upper_face_weight": 0.0,
    },
    "facediff.models.audio_encoders.MelEncoder": {"n_mels": 64},
    "facediff.models.mesh_encoders.SpiralMeshEncoder": {"negative_slope": 0.2, "max_frames": None},
    "facediff.models.speaker_encoders.HierarchicalIdentity": {"unseen": "mean"},
    "facediff.data.puppet.Puppet": {"edition": (None, 2)},
    "facediff.data.parametric.Beat": {"split": "order"},
    "facediff.models.published.faceformer.FaceFormer": {"loop": ANY, "alignment": "auto"},
    "facediff.models.published.talkingstyle.TalkingStyle": {
        **{"loop": ANY, "alignment": "auto", "mouth_weight": 0.6, "style_attention": "one_key"},
    },
    "facediff.models.published.codetalker.CodeTalker": {
        **{"loop": ANY, "alignment": "auto", "kernel": 5, "token_maps": ANY, "out_bias": ANY},
        **{"positions": "constant", "attention_scale": "width", "first_frame": "duplicated", "output": "together"},
        **{"commitment": 0.25, "quantisation_weight": 1.0, "feature_weight": 1.0},
    },
    "facediff.models.published.facediffuser.FaceDiffuser": {"encode_speech": ANY, "alignment": "auto"},
    "facediff.models.published.diffspeaker.DiffSpeaker": {
        **{"time_dim": ANY, "loss_mean": "padded", "unknown_speaker": "first", "alignment": "interpolated"},
        "sampling_space": ANY,
    },
    "facediff.models.published.selftalk.SelfTalk": {"lip_heads": 8, "alignment": "auto"},
    "facediff.models.published.voca.Voca": {
        "rows_per_frame": lambda options: (None, max(1, round(60.0 / options["frame_rate"]))),
        "alignment": "auto",
    },
    "facediff.models.published.emotalk.EmoTalk": {
        **{"content_dim": ANY, "period": None, "alignment": "auto", "finish": ""},
    },
    "facediff.models.published.lam.LamAudio2Expression": {
        **{"chunk_seconds": 1.0, "alignment": "auto", "chunks": "none", "finish": ""},
    },
    "facediff.models.published.unitalker.UniTalker": {
        **{"period": 30, "component_weight": 0.01, "value_weight": 1e-4, "common_share": 0.1, "alignment": "auto"},
        **{"long_windows": "published", "normalize_windows": True},
    },
    "facediff.models.published.diffposetalk.DiffPoseTalk": {
        **{"indicator": True, "memory_width": 1, "padding": "zero", "speech_context": True, "threshold": None},
        **{"guidance_form": "published", "velocity_weight": 5.0, "smoothness_weight": 0.5, "head_weight": 0.05},
        **{"head_velocity_weight": 5.0, "style_weight": 0.1, "temperature": 0.1, "alignment": "interpolated"},
        **{"style_positions": "published", "jaw": "x"},
    },
    "facediff.models.published.artalk.ARTalk": {
        **{"memory_chunks": 1, "flipped_bits": 0.3, "dropped": 0.1, "velocity_weight": 5.0, "head_weight": 1.0},
        **{"commitment_weight": 0.2, "jaw": "all", "alignment": "interpolated", "style_positions": "published"},
    },
}
"""By class path, the removed options and the value that each has for good, as plain data of a checkpoint; a tuple
holds several such values, a function makes them of the other options."""

SHORT_NAMES = {"mel": "MelEncoder", "spiral": "SpiralMeshEncoder", "hierarchical": "HierarchicalIdentity"}
"""Registered names of components of :data:`REMOVED`, by which configs and checkpoints name them, and their classes."""


def without_removed_options(content: Any, source: object) -> Any:  # noqa: ANN401 - a tree of plain data
    """Hyperparameters, or a config, without removed options, in every model and component that is described in them.

    Args:
        content: plain data; classes stand in it as ``class_path`` with ``init_args``, a checkpoint's model as
            ``_class_path`` next to its options.
        source: the file, for messages.

    Returns:
        a copy, in which nothing else has changed.
    """
    if isinstance(content, list):
        return [without_removed_options(item, source) for item in content]
    if not isinstance(content, dict):
        return content
    tree = {key: without_removed_options(value, source) for key, value in content.items()}
    if "_class_path" in tree:
        tree = _present(tree["_class_path"], tree, source)
        # Of every model's tests alone: tables by attributes, and the policy that refused clips of unknown speakers.
        tree.pop("score_by", None)
        if tree.get("unseen_identity") == "adapted":
            tree["unseen_identity"] = "style_only"
    model = tree.get("model")
    if isinstance(model, dict) and isinstance(options := model.get("init_args"), dict) and not options.get("score_by"):
        options.pop("score_by", None)
    if isinstance(tree.get("init_args"), dict):
        tree["init_args"] = _present(tree.get("class_path"), tree["init_args"], source)
    return tree


def _present(class_path: object, options: Mapping[str, Any], source: object) -> dict[str, Any]:
    """The options of a class that it still has."""
    removed = _removed_of(class_path)
    for name in removed.keys() & options.keys():
        defaults = removed[name](options) if callable(removed[name]) else removed[name]
        defaults = defaults if isinstance(defaults, tuple) else (defaults,)
        if defaults != (ANY,) and options[name] not in defaults:
            expected = " or ".join(map(str, defaults))
            raise FaceDiffError(
                f"{source}: {name}={options[name]} of {class_path} is an option of facediff 1.1 that is gone (it is "
                f"{expected} now); use facediff 1.1 for this file, or train the model again without the option"
            )
    return {name: value for name, value in options.items() if name not in removed}


def _removed_of(class_path: object) -> dict[str, Any]:
    """The removed options of a class, which may stand by its path, by a shorter path of facediff's, or by its name."""
    module, _, name = str(class_path).rpartition(".")
    if module and module.partition(".")[0] != "facediff":
        return {}
    name = SHORT_NAMES.get(name, name)
    return next((options for path, options in REMOVED.items() if path.rpartition(".")[2] == name), {})
