"""Data: the batch contract, speech files, and one data module per corpus."""

from typing import TYPE_CHECKING

from facediff.utils.lazy import lazy_names

if TYPE_CHECKING:
    from facediff.data.batch import Assets as Assets
    from facediff.data.batch import Batch as Batch
    from facediff.data.batch import Reference as Reference
    from facediff.data.batch import Sample as Sample
    from facediff.data.batch import collate as collate
    from facediff.data.biwi import Biwi as Biwi
    from facediff.data.corpus import Clip as Clip
    from facediff.data.corpus import Corpus as Corpus
    from facediff.data.datamodule import SpeechMotionDataModule as SpeechMotionDataModule
    from facediff.data.mead3d import Mead3D as Mead3D
    from facediff.data.parametric import Beat as Beat
    from facediff.data.parametric import FlameClips as FlameClips
    from facediff.data.parametric import LiveLink as LiveLink
    from facediff.data.people import People as People
    from facediff.data.puppet import Puppet as Puppet
    from facediff.data.puppet import PuppetMask as PuppetMask
    from facediff.data.vocaset import Vocaset as Vocaset

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "batch": "Assets Batch Reference Sample collate",
        "biwi": "Biwi",
        "corpus": "Clip Corpus",
        "datamodule": "SpeechMotionDataModule",
        "mead3d": "Mead3D",
        "parametric": "Beat FlameClips LiveLink",
        "people": "People",
        "puppet": "Puppet PuppetMask",
        "vocaset": "Vocaset",
    },
)
