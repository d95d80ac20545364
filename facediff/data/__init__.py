"""Data: the batch contract, speech files, and one data module per corpus."""

from facediff.data.assets import Assets, Reference
from facediff.data.base import SpeechMotionDataModule
from facediff.data.batch import Batch, Sample, collate
from facediff.data.biwi import Biwi
from facediff.data.corpus import Clip, Corpus
from facediff.data.mead3d import Mead3D
from facediff.data.puppet import Puppet
from facediff.data.vocaset import Vocaset

__all__ = [
    "Assets",
    "Batch",
    "Biwi",
    "Clip",
    "Corpus",
    "Mead3D",
    "Puppet",
    "Reference",
    "Sample",
    "SpeechMotionDataModule",
    "Vocaset",
    "collate",
]
