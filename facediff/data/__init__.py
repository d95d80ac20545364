"""Data: the batch contract, speech files, and one data module per corpus."""

from facediff.data.assets import Assets, Reference
from facediff.data.base import SpeechMotionDataModule
from facediff.data.batch import Batch, Sample, collate
from facediff.data.puppet import Puppet

__all__ = ["Assets", "Batch", "Puppet", "Reference", "Sample", "SpeechMotionDataModule", "collate"]
