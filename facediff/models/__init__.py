"""Models: LightningModules that turn speech into facial motion, and their components."""

from typing import TYPE_CHECKING

from facediff.utils.lazy import lazy_names

if TYPE_CHECKING:
    from facediff.models.base import AnimationModel as AnimationModel
    from facediff.models.base import load_model as load_model
    from facediff.models.dual_path import DualPathDiffusion as DualPathDiffusion
    from facediff.models.dual_path import ManyFaces as ManyFaces
    from facediff.models.inference import Style as Style
    from facediff.models.published.artalk import ARTalk as ARTalk
    from facediff.models.published.codetalker import CodeTalker as CodeTalker
    from facediff.models.published.diffposetalk import DiffPoseTalk as DiffPoseTalk
    from facediff.models.published.diffspeaker import DiffSpeaker as DiffSpeaker
    from facediff.models.published.emotalk import EmoTalk as EmoTalk
    from facediff.models.published.facediffuser import FaceDiffuser as FaceDiffuser
    from facediff.models.published.faceformer import FaceFormer as FaceFormer
    from facediff.models.published.importing import import_checkpoint as import_checkpoint
    from facediff.models.published.lam import LamAudio2Expression as LamAudio2Expression
    from facediff.models.published.selftalk import SelfTalk as SelfTalk
    from facediff.models.published.talkingstyle import TalkingStyle as TalkingStyle
    from facediff.models.published.unitalker import UniTalker as UniTalker
    from facediff.models.published.voca import Voca as Voca
    from facediff.models.style_content import StyleContentDisentanglement as StyleContentDisentanglement

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "base": "AnimationModel load_model",
        "dual_path": "DualPathDiffusion ManyFaces",
        "inference": "Style",
        "published.artalk": "ARTalk",
        "published.codetalker": "CodeTalker",
        "published.diffposetalk": "DiffPoseTalk",
        "published.diffspeaker": "DiffSpeaker",
        "published.emotalk": "EmoTalk",
        "published.facediffuser": "FaceDiffuser",
        "published.faceformer": "FaceFormer",
        "published.importing": "import_checkpoint",
        "published.lam": "LamAudio2Expression",
        "published.selftalk": "SelfTalk",
        "published.talkingstyle": "TalkingStyle",
        "published.unitalker": "UniTalker",
        "published.voca": "Voca",
        "style_content": "StyleContentDisentanglement",
    },
)
