"""Speech with exactly known phonemes, in several voices and languages, and the open face that models are put on.

The face is the built-in speaker F1's. The motion that the built-in corpus would have for the same speech is the
reference: its mouth follows from the phonemes, the rest is one of many performances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facediff.errors import FaceDiffError, check_known
from facediff.spaces.rigs import LinearRig
from facediff.speech.audio import write_wav
from facediff.speech.espeak import SpokenPhoneme, Utterance
from facediff.synthetic.corpus import PerformedClip, perform_clip, region_vertices, rig_of, speak_clip
from facediff.synthetic.geometry import Array
from facediff.synthetic.head.parts import build_head
from facediff.synthetic.head.rig import eyelid_pairs, lip_pairs
from facediff.synthetic.known_faces import built_in_rig
from facediff.synthetic.sentences import GERMAN, TEST
from facediff.synthetic.voices import installed_voices
from facediff.utils import SAMPLE_RATE
from facediff.utils.files import atomic_folder
from facediff.utils.plain_files import write_table

SPEAKER = "F1"
"""The built-in speaker with the face, delivery and habits that are used."""

# Written for this purpose, and rich in p, b and m.
_SPANISH = (
    "Mi mamá compra un mapa bonito para papá.",
    "El bombero bebe un vaso de agua en el balcón.",
    "Pablo y María pasean por la playa con su bebé.",
    "Un pequeño pájaro vuela sobre el puente del pueblo.",
)
_FRENCH = (
    "Papa prépare une bonne soupe aux pommes.",
    "Ma mère met le bébé dans son berceau.",
    "Un beau bateau passe sous le pont.",
    "Le boulanger vend beaucoup de pain au beurre.",
)
_ITALIAN = (
    "La mamma compra il pane e le mele.",
    "Il bambino beve un bicchiere di acqua.",
    "Papà porta una bella palla rossa.",
    "Piove sempre quando prendiamo il battello.",
)
_MANDARIN = (
    "爸爸给妈妈买了面包。",
    "八百个朋友跑步。",
    "我们明天不怕爬山。",
    "冰箱里没有苹果和葡萄。",
)


@dataclass(frozen=True)
class Language:
    """A language's name, voices in order of preference, and sentences that are in no training data."""

    name: str
    voices: tuple[str, ...]
    sentences: tuple[str, ...]


LANGUAGES = {
    "en": Language("English", ("espeak:en-us+f5", "flite:slt", "espeak:en-gb-scotland+m6"), TEST),
    "de": Language("German", ("espeak:de+m8", "espeak:de+f2"), GERMAN),
    "es": Language("Spanish", ("espeak:es+f2", "espeak:es-419+m3"), _SPANISH),
    "fr": Language("French", ("espeak:fr+m4", "espeak:fr+f4"), _FRENCH),
    "cmn": Language("Mandarin", ("espeak:cmn+f2", "espeak:cmn+m3"), _MANDARIN),
    "it": Language("Italian", ("espeak:it+f3", "espeak:it+m2"), _ITALIAN),
}
"""By their codes. English voices are kept out of the built-in corpus's training, and it has no other language."""


@dataclass(frozen=True)
class SpokenClip:
    """A sentence as one voice speaks it, (S,) at 16 kHz with quiet at both ends, and its phonemes without gaps."""

    name: str
    language: str
    voice: str
    text: str
    samples: NDArray[np.float32]
    phonemes: tuple[SpokenPhoneme, ...]

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return len(self.samples) / SAMPLE_RATE


def spoken_set(languages: Sequence[str], voices: int, sentences: int) -> list[SpokenClip]:
    """Sentences in several voices of several languages; each voice of a language has sentences of its own, in turn."""
    installed = installed_voices()
    clips = []
    for code in languages:
        check_known("--languages", "language", [code], LANGUAGES)
        language = LANGUAGES[code]
        usable = [voice for voice in language.voices if voice.partition(":")[0] in installed]
        if not usable:
            raise FaceDiffError(f'--languages {code}: no voice is installed; pip install "facediff[puppet]"')
        for index, voice in enumerate(usable[:voices]):
            for number in range(min(sentences, len(language.sentences))):
                text = language.sentences[(index * sentences + number) % len(language.sentences)]
                name = f"{voice.replace(':', '_').replace('+', '_')}_{number + 1:02d}"
                speech = speak_clip(_performed(text, number, voice))
                clips.append(SpokenClip(name, code, voice, text, speech.samples, speech.phonemes))
    return clips


def _performed(text: str, number: int, voice: str) -> PerformedClip:
    return PerformedClip(SPEAKER, "test_c", number + 1, text, "neutral", voice)


def write_spoken_set(clips: Sequence[SpokenClip], folder: Path) -> None:
    """Write recordings, the times of their phonemes, and a table of the sentences, for models that run elsewhere."""
    with atomic_folder(folder) as temporary:
        for name in ("wav", "phonemes"):
            (temporary / name).mkdir()
        for clip in clips:
            samples = np.rint(clip.samples * 32767).astype(np.int16)
            write_wav(temporary / "wav" / f"{clip.name}.wav", samples, SAMPLE_RATE)
            rows = [[f"{p.start:.4f}", f"{p.end:.4f}", p.ipa] for p in clip.phonemes]
            write_table(temporary / "phonemes" / f"{clip.name}.csv", [["start", "end", "ipa"], *rows])
        table = [[clip.name, clip.language, clip.voice, clip.text] for clip in clips]
        write_table(temporary / "clips.csv", [["clip", "language", "voice", "text"], *table])


@dataclass(frozen=True, eq=False)
class OpenFace:
    """The face that models are put on, in metres, and which of its vertices are looked at.

    Attributes:
        points: vertices that are looked at, sorted; the other fields are places among them.
        lip_pairs, lid_pairs: (P, 2) of the inner lips and of the eyelids, upper and lower.
        upper_face: forehead, brows and around the eyes.
    """

    rig: LinearRig
    points: NDArray[np.int64]
    lip_pairs: NDArray[np.int64]
    lid_pairs: NDArray[np.int64]
    lips: NDArray[np.int64]
    upper_face: NDArray[np.int64]

    @cached_property
    def rest(self) -> Array:
        """The points of the face at rest (P, 3)."""
        return self.rig.neutral[self.points]


@dataclass(frozen=True, eq=False)
class SpokenMotion:
    """A motion for a clip: points (T, P, 3) of the open face in metres, and turns (T, 3) of the head (axis-angle).

    Where no face could be made, the points are the face's channels (T, C, 1).
    """

    points: Array
    head: Array | None = None


@lru_cache(maxsize=1)
def open_face() -> OpenFace:
    """The built-in speaker F1's face."""
    mesh, regions = build_head(), region_vertices()
    lips, lids = (np.stack(pairs(mesh), axis=1) for pairs in (lip_pairs, eyelid_pairs))
    points = np.unique(np.concatenate([lips.ravel(), lids.ravel(), regions["lve"], regions["fdd"]]))
    indices = (np.searchsorted(points, index) for index in (lips, lids, regions["lve"], regions["fdd"]))
    return OpenFace(built_in_rig(SPEAKER), points, *indices)


def reference(clip: SpokenClip, frame_rate: float) -> SpokenMotion:
    """How the built-in corpus performs a clip."""
    number = int(clip.name.rpartition("_")[2]) - 1
    speech = Utterance(clip.samples, clip.phonemes)
    performed, _ = perform_clip(_performed(clip.text, number, clip.voice), speech, 0, frame_rate)
    rig = rig_of(SPEAKER)[:, open_face().points].astype(np.float64)
    # Turns of a few degrees about three axes are nearly the axis-angle of all of them; one about z leads to the right.
    turns = np.deg2rad(performed.head) * [1.0, 1.0, -1.0]
    return SpokenMotion(rig[0] + np.tensordot(performed.weights, rig[1:], 1), turns)
