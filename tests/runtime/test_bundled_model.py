"""The model that comes with the package: taken where none is named, small, without PyTorch, and what it says it is."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile

import facediff
from facediff.animation.options import AnimationOptions
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.export import FORMATS
from facediff.pipelines.exported import ExportedPipeline
from facediff.runtime.folder import read_folder
from facediff.speech.audio import read_speech
from facediff.synthetic.cast import SEEN, UNSEEN
from facediff.synthetic.known_faces import built_in_rig
from facediff.utils import hub

ROOT = Path(__file__).parents[2]
SPEECH = ROOT / "docs" / "examples" / "speech.wav"
WITHOUT_TORCH = "import sys; sys.modules['torch'] = None; from facediff.cli.app import main; main(sys.argv[1:])"


def test_a_recording_becomes_a_page_without_a_checkpoint_and_without_pytorch(tmp_path: Path) -> None:
    page = tmp_path / "speech.html"
    command = [sys.executable, "-c", WITHOUT_TORCH, "animate", str(SPEECH), "-o", str(page)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    said = [line for line in done.stderr.splitlines() if line.startswith("no --checkpoint")]
    assert said == ["no --checkpoint: puppet, the model that comes with facediff; its speech and faces are synthetic"]
    assert page.stat().st_size > 10_000


def test_the_face_lives_in_what_is_looked_at_and_not_in_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    speech = tmp_path / "speech.wav"
    soundfile.write(speech, read_speech(SPEECH)[:24_000], 16_000)

    def said(name: str, *words: str) -> str:
        assert main(["animate", str(speech), "-o", str(tmp_path / name), *words]) == 0
        return capsys.readouterr().out

    unasked = said("alive.html")
    assert "F1_lively" in unasked
    assert all(control in unasked for control in ("gaze (4", "head sway (2", "acting (prosody"))
    chosen = said("chosen.html", "--style", "F1_calm", "--sway", "5", "--direction", "happy")
    assert all(choice in chosen for choice in ("F1_calm", "head sway (5", "gaze (4"))
    still = said("still.html", "--still")
    assert "style of F1," in still
    assert "procedural" not in still
    plain = said("plain.npz")
    assert "procedural" not in plain
    motion = facediff.load().animate(speech)
    assert np.array_equal(facediff.read(tmp_path / "plain.npz").vertices, motion.vertices)
    assert main(["animate", str(speech), "-o", str(tmp_path / "x.npz"), "--still"]) == 2
    assert "is for videos, pages and avatars" in capsys.readouterr().err


def test_a_stream_opens_the_mouth_no_wider_than_the_recording_does() -> None:
    """On the first sound, of which it hears no more than the beginning."""
    model = facediff.load()
    rig = built_in_rig("F1")
    jaw = rig.deltas[rig.names.index("jawOpen")]
    start = read_speech(SPEECH)[:12_800]  # until the first pause
    recording: list[float] = []
    stream: list[float] = []
    for seed in range(4):
        motion = model.animate(SPEECH, seed=seed)
        for peaks, vertices in (
            (recording, motion.vertices),
            (stream, model.animate(start, 16_000, seed=seed, low_latency=True).vertices),
        ):
            peaks.append(float(((vertices - motion.template) * jaw).sum(axis=(1, 2)).max() / (jaw**2).sum()))
    assert np.mean(stream) < 1.2 * np.mean(recording)


def test_films_take_the_time_of_their_pictures() -> None:
    pipeline = ExportedPipeline(AnimationOptions(checkpoint=str(hub.BUNDLED)))
    seconds = {suffix: pipeline.cost(10.0, Path(f"hello{suffix}"), 1080)[0] for suffix in FORMATS}
    longer = {suffix for suffix, each in seconds.items() if each > 2 * seconds[".npz"]}
    assert longer == {".mp4", ".webm", ".gif"}


def test_its_name_is_taken_unless_a_file_is_called_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert Path(facediff.load("puppet").source) == hub.BUNDLED
    assert hub.model_or_bundled("./puppet") == "./puppet"
    assert not capsys.readouterr().err  # it was named, so that nothing has to be said
    with pytest.raises(FaceDiffError, match="--checkpoint puppet: holds graphs.*expected a .ckpt file"):
        hub.check_model_source("puppet", "--checkpoint")
    with pytest.raises(FaceDiffError, match="pupet: no such checkpoint; expected puppet, the model that comes"):
        facediff.load("pupet")
    (tmp_path / "puppet").mkdir()
    with pytest.raises(FaceDiffError, match=r"this folder has no config.json"):
        facediff.load("puppet")


def test_its_motion_becomes_arkit_weights_without_shapes(tmp_path: Path) -> None:
    facediff.load("puppet").animate(SPEECH).save(tmp_path / "take.npz")
    np.save(tmp_path / "bare.npy", np.load(tmp_path / "take.npz")["vertices"])
    main(["export", str(tmp_path / "take.npz"), "-o", str(tmp_path / "take.csv")])
    main(["export", str(tmp_path / "bare.npy"), "--checkpoint", "puppet", "-o", str(tmp_path / "bare.csv")])
    tables = [(tmp_path / name).read_text().splitlines() for name in ("take.csv", "bare.csv")]
    assert "JawOpen" in tables[0][0]
    assert len(tables[0]) == len(tables[1]) > 100
    assert main(["export", str(tmp_path / "bare.npy"), "-o", str(tmp_path / "none.csv")]) == 2


def test_it_is_small_and_knows_ten_people_and_their_moods() -> None:
    files = list(hub.BUNDLED.iterdir())
    assert sum(path.stat().st_size for path in files) < 16e6
    about = read_folder(hub.BUNDLED)[0]
    assert about.synthetic
    assert set(about.faces) == {*SEEN, *UNSEEN}
    assert {f"{name}_{mood}" for name in SEEN for mood in ("calm", "neutral", "lively")} <= set(about.styles)
    provenance = json.loads((hub.BUNDLED / "provenance.json").read_text())
    assert provenance["generation_metrics"]
    assert "facediff fit" in provenance["recipe"]
    scores = {(row["split"], row["metric"]): row["mean"] for row in provenance["generation_metrics"]["metrics"]}
    manual = " ".join((ROOT / "docs" / "exported_models.md").read_text(encoding="utf-8").split())
    for metric in ("lve_still", "lve_default_still"):
        shares = [f"{scores[split, metric]:.3f}" for split in ("test_a", "test_b", "test_c")]
        assert "{}, {} and {}".format(*shares) in manual  # of the model that is there, not of one before


def test_the_lively_style_moves_more_than_the_calm_one(capsys: pytest.CaptureFixture[str]) -> None:
    model = facediff.load()
    assert "puppet" in capsys.readouterr().err
    for name in SEEN[:2]:
        moves = [
            np.std(model.animate(SPEECH, identity=name, style=f"{name}_{mood}", seed=1).vertices, axis=0).mean()
            for mood in ("calm", "lively")
        ]
        assert moves[1] > 1.1 * moves[0]


def test_it_is_written_as_a_folder_and_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "face"
    assert main(["export-model", "-o", str(folder), "--steps", "4"]) == 2
    assert "--steps" in capsys.readouterr().err
    assert not folder.exists()
    assert main(["export-model", "-o", str(folder)]) == 0
    for path in folder.iterdir():
        assert path.read_bytes() == (hub.BUNDLED / path.name).read_bytes()
    wanted, found = (facediff.load(one).animate(SPEECH, identity="M5", seed=1) for one in (hub.BUNDLED, folder))
    assert found.metadata["identity"] == "M5 (not trained on)"
    np.testing.assert_array_equal(found.vertices, wanted.vertices)
    capsys.readouterr()
    assert main(["components", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows if row["kind"] == "bundled_model"] == ["puppet"]
    assert main(["components", "model"]) == 0
    assert "bundled_model:" in capsys.readouterr().out
