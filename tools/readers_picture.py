"""Draw the mouth in people's recordings: rounded, open, closed and at the teeth, three moments each, a row a person.

    python tools/readers_picture.py READERS picture.webp

READERS is a folder of `facediff data align`; the first six people with all four kinds of sounds are drawn.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import facediff  # noqa: E402
from facediff.export import ExportOptions  # noqa: E402
from facediff.export.video import drawn_frames  # noqa: E402
from facediff.render import contact_sheet  # noqa: E402
from facediff.synthetic.recordings import recordings_of, speakers_of  # noqa: E402
from facediff.synthetic.voices import open_voice  # noqa: E402
from facediff.utils import SAMPLE_RATE  # noqa: E402

PEOPLE, EACH = 6, 3
SIZE, CROP = 400, (slice(210, 370), slice(110, 290))
"""Pixels of a picture, and the rows and columns round the mouth."""
KINDS = {"rounded": ("u", "w", "ʊ"), "open": ("ɑ", "æ", "a"), "closed": ("p", "b", "m"), "at the teeth": ("f", "v")}
"""Kinds of sounds by the starts of their phonemes."""


def main() -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--model", default="puppet")
    given = parser.parse_args()
    model = facediff.load(given.model)
    pictures, labels = [], []
    for speaker in speakers_of(Path(given.readers)):
        said = [open_voice(each.voice).speak("") for each in recordings_of(speaker, 9)]
        found = {kind: [] for kind in KINDS}
        for number, utterance in enumerate(said):
            for phoneme in utterance.phonemes:
                for kind, sounds in KINDS.items():
                    if phoneme.ipa.lstrip("ˈˌ").startswith(sounds):
                        found[kind].append((number, 0.5 * (phoneme.start + phoneme.end), phoneme.ipa))
        if min(map(len, found.values())) < EACH:
            continue
        faces = [model.animate(each.samples, SAMPLE_RATE, seed=0) for each in said]
        for moments in found.values():
            for number, time, ipa in moments[:EACH]:
                pick = min(int(time * faces[number].frame_rate), len(faces[number].vertices) - 1)
                frame = next(iter(drawn_frames([faces[number].part([pick])], ExportOptions(size=SIZE))))
                pictures.append(np.asarray(frame)[CROP])
                labels.append(f"{Path(speaker).name} {ipa}")
        if len(pictures) == PEOPLE * EACH * len(KINDS):
            break
    sheet = contact_sheet(pictures, EACH * len(KINDS), labels=labels)
    Image.fromarray(sheet).save(given.picture, quality=80)


if __name__ == "__main__":
    main()
