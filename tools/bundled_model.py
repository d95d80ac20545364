r"""Make the model that comes with facediff, ``facediff/bundled/puppet``, out of a trained checkpoint.

The recipe, where flite is installed, in three hours and a half on two cores. READERS
are 185 people of LibriSpeech with up to two recordings each; the first 32 epochs heard 121 of them (version 3bae1a2b).

    $ facediff data align LibriSpeech -o READERS
    $ FIT="facediff fit --config configs/experiment/puppet_quality.yaml --model.motion_space.lips_weight=3.5 \
        --model.motion_space.eyelids_weight=20 --trainer.callbacks+=facediff.callbacks.SpokenSoundsTerm \
        --trainer.callbacks.recordings=READERS"
    $ MORE="--ckpt_path last --data.augmented_share=0.25"
    $ $FIT && $FIT $MORE --trainer.max_epochs=16 && $FIT $MORE --trainer.max_epochs=32
    $ $FIT $MORE --trainer.callbacks.weight=0.5 --trainer.max_epochs=48
    $ cp runs/puppet_quality/version_0/checkpoints/last.ckpt puppet.ckpt
    $ facediff generation-metrics puppet.ckpt --samples 3 --references 1 --max-clips 30 --json puppet.json
    $ python tools/bundled_model.py puppet.ckpt

The folder has graphs in 16 bits, the faces of the ten written-down speakers, and for each of the six whom the model was
trained on a style for each mood: the mean of the styles of their training clips. Its model card is that of
`facediff publish`, with how this folder is used.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from facediff.cli.generation_metrics import corpus_of_checkpoint
from facediff.data import Reference
from facediff.models import AnimationModel, load_model
from facediff.models.inference import Style
from facediff.models.styles import vector_of
from facediff.pipelines.export_model import export_model
from facediff.synthetic.cast import SEEN, UNSEEN
from facediff.utils.checksums import sha256
from facediff.utils.hub import BUNDLED
from facediff.utils.plain_files import write_json

USE = """## How to use it

It comes with facediff and is taken where no model is named:

```bash
pip install facediff
facediff animate speech.wav -o speech.html
```

```python
import facediff

facediff.load().animate("speech.wav", identity="F1", style="F1_lively").save("speech.glb")
```

"""
"""How the folder is used, in place of how a model folder is."""
SPEECH = """## Who speaks in its corpus

espeak-ng (GPL-3.0) and flite (Carnegie Mellon's licence, as free as BSD's), whose licences do not cover what they say.
Its audio encoder was also taught the sounds of 185 readers of LibriSpeech (Panayotov, Chen, Povey and Khudanpur, 2015;
CC BY 4.0).

"""
"""Programs whose speech it was trained with."""
MOODS = {"flat": "calm", "neutral": "neutral", "lively": "lively"}
"""Words for the corpus's moods."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--data-root", type=Path, help="folder of the corpus (default: that of the training)")
    parser.add_argument("--output", type=Path, default=BUNDLED)
    given = parser.parse_args(arguments)
    model = load_model(given.checkpoint)
    data = corpus_of_checkpoint(given.checkpoint, given.data_root, None, None)
    styles = {}
    for speaker in SEEN:
        for mood, word in MOODS.items():
            clips = [c for c in data.clips("train") if c.identity == speaker and c.attributes["mood"] == mood]
            moves = [Reference(clip.name, data.corpus.read_motion(clip, 0, data.reference_frames)) for clip in clips]
            vectors = [vector_of(each, model) for each in moves]
            styles[f"{speaker}_{word}"] = Style(f"{speaker}_{word}", torch.stack(vectors).mean(0))
    given.output.parent.mkdir(exist_ok=True)
    made = given.output.with_name(f"{given.output.name}.new")
    export_model(model, made, precision="float16", identities=(*SEEN, *UNSEEN), styles=styles)
    scores = given.checkpoint.with_suffix(".json")
    provenance = {
        "recipe": (__doc__ or "").split("\n\n")[2],
        "checkpoint": sha256(given.checkpoint),
        "generation_metrics": json.loads(scores.read_text()) if scores.is_file() else None,
    }
    write_json(made / "provenance.json", provenance)
    (made / "README.md").write_text(card(model), encoding="utf-8")
    if given.output.is_dir():
        shutil.rmtree(given.output)
    made.rename(given.output)
    size = sum(path.stat().st_size for path in given.output.iterdir())
    print(f"wrote {given.output}: {size / 1e6:.1f} MB")


def card(model: AnimationModel) -> str:
    """The model card of `facediff publish`, without what it says of a model folder's own files."""
    with tempfile.TemporaryDirectory() as folder:
        published = model.save_pretrained(Path(folder) / "puppet", license="apache-2.0", name="puppet")
        text = (published / "README.md").read_text(encoding="utf-8")
    start, end = text.index("## How to use it"), text.index("## Licences")
    return text[:start] + USE + SPEECH + text[end:]


if __name__ == "__main__":
    main()
