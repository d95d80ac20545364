"""``facediff style extract``: a speaking style as one vector."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from facediff.animation.options import LicenceOptions
from facediff.cli.options import Checkpoint, Identity
from facediff.cli.process import tell
from facediff.utils.hub import check_model_source, split_face
from facediff.utils.option import Option


def extract(
    clips: Annotated[list[str], Option(metavar="CLIP", reads=True)],
    *,
    checkpoint: Checkpoint,
    output: Annotated[Path, Option(also="-o", metavar="OUT", writes="file", suffixes=(".npy",))],
    identity: Identity = None,
    licence: LicenceOptions,
) -> None:
    """Write the style vector of clips, their mean if there are several.

    Args:
        clips: motion of one speaker: .npy files of absolute vertices, or names of the corpus's clips (F1_e03)
        checkpoint: trained model (.ckpt)
        output: vector to write (.npy)
        identity: the speaker, where the files' names do not say it; by default the first one trained on
        licence: which models are refused.
    """
    check_model_source(checkpoint, "--checkpoint")

    from facediff.animation.styles import marked
    from facediff.models import ManyFaces, load_model
    from facediff.models.styles import still_style
    from facediff.pipelines.animator import Animator
    from facediff.utils.files import atomic

    model = load_model(checkpoint, commercial_only=licence.commercial_only)
    import numpy as np

    vector = numbers = Animator(model, checkpoint).extract_style(clips, identity=identity)
    # Faces of one model take each other's styles, but each has its own encoder of meshes: they answer differently.
    if not isinstance(model, ManyFaces) and split_face(checkpoint)[1] is None:
        numbers = marked(numbers, still_style(model).numpy())
    with atomic(output) as temporary, temporary.open("wb") as stream:
        np.save(stream, numbers, allow_pickle=False)
    tell(f"{output}: style vector of {len(vector)} numbers from {', '.join(clips)}, for this checkpoint only")
    tell(f"next: facediff animate speech.wav --checkpoint {checkpoint} --style {output} -o speech.mp4")
