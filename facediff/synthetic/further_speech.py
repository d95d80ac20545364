"""Speech without motion, in any amount: words in random order by the speakers of the built-in corpus.

An audio encoder that is distilled needs no motion, but more than two dozen sentences, or it overfits to their sequences
of sounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from facediff.speech.espeak import speak
from facediff.synthetic.speakers import speaker_of
from facediff.synthetic.voices import in_language
from facediff.utils import SAMPLE_RATE

# Chosen for this corpus, so that every English sound occurs in several places of a word; no content word is in the test
# sentences.
_WORDS = """
apple arm beach begin below bench bird bite black blanket blood blow bone bottle bread bridge bring bubble
build burn butter cabin camel candle car carpet catch chair cheap cheese chimney choice church circle climb
clock cloth cloud coffee cold computer copper corner cotton cream crowd cry cup damp dance dark deep desk
dinner dish divide dog doubt dream drum dust eagle early east eight empty engine enough evening eye fabric
fall family fast feather field finger fire fish five flag flower fly forget fork fresh frog garden gate gentle
ghost gift glass goat gold grape green guess hammer hand happy harbour heavy help high hill holiday honey
horse humble hungry ice imagine important inside island job join judge jump jungle keep kettle kick kind
kitchen knife label ladder large laugh lazy leaf leave lemon letter library light limb little lobster long
loud lucky lump machine market measure medicine member milk mirror mistake monkey month morning mouse museum
music nature neighbour never night nobody noise north number nurse object ocean often onion orange outside
oven paint palace paper party path pencil people perhaps picture pigeon pillow planet pleasure pocket poison
pony possible potato powder pretty problem proud public puddle purpose push quick quiet rabbit radio rain
rapid ready remember repeat ribbon right ring robin rough round rubber running sailor salt sample sandwich
scrub secret seven shadow shallow sharp ship shop shoulder silver simple sister sleep slippery small smooth
snow soap somebody south space spider spring square station stone storm street strong stubborn student subject
sugar summer sunny supper surprise table tail teacher temper ten thank thick thin thirty thousand thumb ticket
tiger timber toilet tomato tongue touch towel treasure trip trouble trumpet twelve twenty uncover under upset
usual valley velvet very village visit voice volume wagon walk wander watch water weather weekend wheel
whisper window winter wise wonder wool work wrap yard year yellow yesterday young zebra zipper
"""
WORDS = tuple(_WORDS.split())
_QUIET_BEFORE, _QUIET_AFTER = 0.10, 0.08
_PEAK = 0.6


def further_speech(number: int, identities: Sequence[str]) -> NDArray[np.float32]:
    """Five to eight words by one of some speakers, (S,) at 16 kHz; the same number gives the same speech."""
    random = np.random.default_rng([number, len(WORDS)])
    text = random.choice(WORDS, size=random.integers(5, 9))
    return said(" ".join(text), identities[int(random.integers(len(identities)))])


def said(text: str, identity: str, language: str = "") -> NDArray[np.float32]:
    """A text by a speaker, as loud as the corpus's clips, with quiet at both ends; (S,) at 16 kHz."""
    voice = speaker_of(identity).voice
    speech = speak(text, replace(voice, name=in_language(voice.name, language))).samples
    before, after = round(_QUIET_BEFORE * SAMPLE_RATE), round(_QUIET_AFTER * SAMPLE_RATE)
    padded: NDArray[np.float32] = np.pad(
        speech * np.float32(_PEAK / max(float(np.abs(speech).max()), 1e-6)), (before, after)
    )
    return padded
