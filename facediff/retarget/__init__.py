"""Takes carried over to other meshes."""

from facediff.retarget.carrying import carry, carry_displacements
from facediff.retarget.correspondence import Correspondence, correspond
from facediff.retarget.files import load_correspondence, read_landmarks, save_correspondence
from facediff.retarget.order import refuse_other_mesh

__all__ = [
    "Correspondence",
    "carry",
    "carry_displacements",
    "correspond",
    "load_correspondence",
    "read_landmarks",
    "refuse_other_mesh",
    "save_correspondence",
]
