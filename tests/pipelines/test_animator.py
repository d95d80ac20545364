"""A loaded model: what it makes is what the command makes, whatever speech and styles are given as."""

from __future__ import annotations

import inspect
import shutil
import typing
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

import facediff
from facediff.animation.options import AnimateKeywords, StreamKeywords
from facediff.cli.app import main
from facediff.errors import FaceDiffError
from facediff.models import Style
from facediff.pipelines.animator import recordings_of
from facediff.speech.audio import speech_of


@pytest.fixture
def speech(tmp_path: Path) -> Path:
    """Two seconds in stereo at 22 050 Hz, 16 bits."""
    path, time = tmp_path / "tone.wav", np.arange(44100) / 22050
    left, right = 0.3 * np.sin(900 * time), 0.2 * np.sin(1300 * time)
    soundfile.write(path, np.stack([left, right], 1), 22050, subtype="PCM_16")
    return path


def command(*words: object) -> None:
    assert main([*map(str, words)]) == 0


def test_animation_is_that_of_the_command_to_the_last_bit(
    model: facediff.Animator, workplace: Path, speech: Path
) -> None:
    words = ["--checkpoint", "demo/puppet.ckpt", "--identity", "M2", "--style", "F1_e03:0.4,M2_e05:0.6", "--seed", 5]
    words += ["--steps", 4, "--expressivity", "lips=0.5,all=1.2", "--expressiveness", "1.3", "--blinks", "--sway", 3]
    command("animate", speech, "-o", "command.npz", "--quiet", *words)
    options = {"steps": 4, "expressivity": {"lips": 0.5, "all": 1.2}, "expressiveness": 1.3, "blinks": True, "sway": 3}
    made = facediff.load("demo/puppet.ckpt", "cpu").animate(
        speech, identity="M2", style={"F1_e03": 0.4, "M2_e05": 0.6}, seed=5, **options
    )
    assert type(made) is facediff.Animation
    made.save("python.npz")
    read = facediff.read("command.npz")
    np.testing.assert_array_equal(made.vertices, read.vertices)
    assert {**made.metadata, "expressivity": ""} == {**read.metadata, "expressivity": ""}
    assert made.metadata["procedural"]
    assert (made.name, made.unit, made.frame_rate) == ("tone", "m", 25)
    for file in ("export.glb", "export.wav"):
        assert not Path(file).exists()
    command("export", "command.npz", "-o", "command.glb", "--tolerance", 0.2)
    assert [path.name for path in read.save("python.glb", tolerance=0.2)] == ["python.glb", "python.wav"]
    same = [Path(name).read_bytes().replace(name[:-4].encode(), b"") for name in ("command.glb", "python.glb")]
    assert len(same[0]) - len(same[1]) in range(-8, 9)  # the name of the .wav
    assert Path("command.wav").read_bytes() == Path("python.wav").read_bytes()
    # What was chosen for that call is forgotten.
    plain = model.animate(speech, seed=5).vertices
    model.animate(speech, sampler="ddpm", steps=2, window=1, overlap=0.25, expressivity=0)
    np.testing.assert_array_equal(plain, model.animate(speech, seed=5).vertices)
    assert not np.array_equal(plain, model.animate(speech, seed=6).vertices)


def as_tensor(samples: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(samples.T.copy())  # as torchaudio: channels first


@pytest.mark.parametrize(
    "give",
    [
        lambda path: (path,),
        lambda path: (str(path),),
        lambda path: (soundfile.read(path, dtype="float32")[0], 22050),
        lambda path: (soundfile.read(path, dtype="float64"),),
        lambda path: (soundfile.read(path, dtype="int16"),),
        lambda path: (soundfile.read(path, dtype="int16")[::-1],),  # as scipy: the rate first
        lambda path: (soundfile.read(path, dtype="int32")[0], 22050.0),
        lambda path: ((np.int64(22050), soundfile.read(path, dtype="int16")[0]),),
        lambda path: (as_tensor(soundfile.read(path, dtype="float32")[0]), 22050),
        lambda path: ((as_tensor(soundfile.read(path, dtype="int16")[0]), 22050),),
    ],
    ids=["path", "text", "array and rate", "pair", "int16", "rate first", "int32", "NumPy's rate", "tensor", "tensors"],
)
def test_speech_is_the_same_however_it_is_given(give: Callable[[Path], tuple[object, ...]], speech: Path) -> None:
    expected = speech_of(speech).speech
    found = speech_of(*give(speech)).speech  # type: ignore[arg-type]
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-7)


def test_a_list_of_numpys_numbers_is_one_recording() -> None:
    assert recordings_of([*np.zeros(3, np.float32)]) is None
    assert recordings_of([np.zeros(3, np.float32)]) is not None


def test_an_identitys_name_is_its_usual_style(model: facediff.Animator) -> None:
    usual, named, other = (
        model.animate(TONE, 16_000, identity="F1", seed=4, style=style) for style in (None, "F1", "M2")
    )
    np.testing.assert_array_equal(named.vertices, usual.vertices)
    assert named.metadata["style"] == usual.metadata["style"]
    assert not np.array_equal(other.vertices, usual.vertices)


def test_tensor_without_a_rate_has_16_khz_and_bytes_their_silence_at_128() -> None:
    tone = 0.3 * torch.sin(torch.arange(8000) / 7)
    np.testing.assert_array_equal(speech_of(tone).speech, tone.numpy())
    np.testing.assert_array_equal(speech_of(tone.bfloat16()).speech, tone.bfloat16().float().numpy())
    coarse = (128 + 100 * tone).round().to(torch.uint8).numpy()
    np.testing.assert_allclose(speech_of(coarse, 16000).speech, (coarse - 128.0) / 128, atol=1e-7)


TONE = (0.3 * np.sin(np.arange(16000) / 7)).astype(np.float32)


@pytest.mark.parametrize(
    ("arguments", "options", "named"),
    [
        (["none.wav"], {}, "none.wav"),
        (["tone.wav", 16000], {}, "rate"),
        ([TONE], {}, "rate"),
        ([TONE, 10], {}, "rate"),
        ([(TONE,)], {}, "speech"),
        ([TONE[:1000], 16000], {}, "speech: lasts"),
        ([TONE * np.nan, 16000], {}, "speech"),
        ([TONE.astype(int), 16000], {}, "speech: is int64"),
        ([np.zeros((2, 3, 4)), 16000], {}, "speech"),
        ([TONE, 16000], {"max_seconds": 0.5}, "max_seconds"),
        ([TONE, 16000], {"direction": "."}, "direction .: no such file"),
        ([TONE, 16000], {"voice_gate": "energie"}, "voice_gate energie"),
        (["tone.wav"], {"identity": "Zoe"}, '"Zoe"'),
        (["tone.wav"], {"style": "F1_e99"}, "style F1_e99"),
        (["tone.wav"], {"style": {"F1_e03": "much"}}, "expected a number as the weight"),
        (["tone.wav"], {"style": np.zeros((4, 9, 3), np.float32)}, "style"),
        (["tone.wav"], {"style": 3}, "style"),
        (["tone.wav"], {"seed": -1}, "seed -1"),
        (["tone.wav"], {"sampler": "dim"}, "sampler"),
        (["tone.wav"], {"expressivity": {"chin": 1}}, "chin"),
        (["tone.wav"], {"blinks": 0}, "blinks 0"),
        (["tone.wav"], {"controls_seed": 3}, "controls_seed"),
        (["tone.wav"], {"eyes": "none.json", "blinks": True}, "eyes none.json"),
        (["tone.wav"], {"target_mesh": "none.obj"}, "target_mesh none.obj"),
        (["tone.wav"], {"correspondence": "x.npz"}, "correspondence"),
    ],
)
def test_wrong_things_meet_one_sentence_in_the_words_of_python(
    arguments: list[object],
    options: dict[str, object],
    named: str,
    model: facediff.Animator,
    speech: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(speech.parent)
    before = sorted(speech.parent.rglob("*"))
    with pytest.raises(facediff.FaceDiffError) as raised:
        model.animate(*arguments, **options)  # type: ignore[arg-type]
    message = str(raised.value)
    assert named in message
    assert "--" not in message
    assert sorted(speech.parent.rglob("*")) == before


def test_stream_is_the_recording_by_windows_however_it_is_cut(model: facediff.Animator, tmp_path: Path) -> None:
    bursts = np.sin(np.arange(16000 * 2) * 2 * np.pi * 3 / 16000) > 0  # a steady sound is no speech
    samples = (0.1 * bursts * np.random.default_rng(0).normal(size=16000 * 2)).astype(np.float32)
    model.module.windows = type(model.module.windows)(seconds=1, overlap=0.25, above=1)
    options = {"identity": "M2", "style": "F1_e03", "seed": 4, "steps": 3, "expressiveness": {"lips": 1.4}}
    whole = model.animate(samples, 16000, **options).vertices
    plain = model.animate(samples, 16000, **{**options, "expressiveness": None}).vertices
    assert np.ptp(whole, axis=0).max() > 1.1 * np.ptp(plain, axis=0).max()
    for chunks in ([samples], np.array_split(samples, 20), [samples[:0], torch.from_numpy(samples)]):
        parts = []
        for frames in model.stream(chunks, **options):
            assert frames.dtype == np.float32
            parts.append(frames)
            model.animate(TONE, 16000, steps=2, expressivity=0.3)  # in between, and without a trace
        np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert len(parts) > 1, "frames come before the speech has ended"
    # Bytes at another rate are what the command's standard input is.
    pcm = (samples * 32767).astype("<i2").tobytes()
    made = np.concatenate([*model.stream([pcm[:4000], pcm[4000:]], 24000, seed=4)])
    assert made.shape == (33, 5875, 3)
    assert list(model.stream([])) == []


@pytest.mark.parametrize(
    ("chunks", "options", "named"),
    [
        ([np.zeros((2, 9), np.float32)], {}, "chunks"),
        ([b"123"], {}, "chunks"),
        ([np.full(9, np.nan, np.float32)], {}, "chunks"),
        ([], {"rate": 3}, "rate"),
        ([], {"style": "F1_e99"}, "style F1_e99"),
        ([TONE], {"direction": "."}, "direction"),
    ],
)
def test_streams_that_cannot_be(
    chunks: list[object], options: dict[str, object], named: str, model: facediff.Animator
) -> None:
    with pytest.raises(facediff.FaceDiffError, match=named):
        list(model.stream(chunks, **options))  # type: ignore[arg-type]


def test_styles_of_every_kind_are_one(model: facediff.Animator, puppet_corpus: Path, speech: Path) -> None:
    clip = puppet_corpus / "vertices_npy" / "M2_t13.npy"

    def made(style: object) -> np.ndarray:
        return model.animate(speech, identity="F1", style=style).vertices  # type: ignore[arg-type]

    motion = facediff.read(clip, checkpoint=model, identity="M2")
    expected = made("M2_t13")
    assert not np.array_equal(expected, made(None))
    for style in (clip, str(clip), motion):
        np.testing.assert_array_equal(made(style), expected)
    vector = model.extract_style("M2_t13")
    assert vector.ndim == 1
    for style in (vector, Style("own", torch.from_numpy(vector)), model.extract_style([motion]), torch.tensor(vector)):
        np.testing.assert_allclose(made(style), expected, rtol=0, atol=1e-6)
    both = model.extract_style(["M2_t13", clip.with_name("F1_t01.npy")])
    np.testing.assert_allclose(both, (vector + model.extract_style("F1_t01")) / 2, rtol=0, atol=1e-6)
    # A bare array is a motion of the identity's own face.
    own = facediff.read(clip.with_name("F1_t01.npy"), checkpoint=model, identity="F1")
    np.testing.assert_array_equal(made(np.array(own.vertices)), made(own))


def test_several_samples_are_written_and_shown_as_one(model: facediff.Animator, speech: Path, tmp_path: Path) -> None:
    made = model.animate(speech, samples=2, seed=5)
    assert [each.metadata["seed"] for each in made] == ["5", "6"]
    np.testing.assert_allclose(made[1].vertices, model.animate(speech, seed=6).vertices, rtol=0, atol=1e-5)
    assert [path.name for path in made.save(tmp_path / "t.npy")] == ["t_sample1.npy", "t_sample2.npy"]
    assert [path.name for path in made.save(tmp_path / "t.html")] == ["t.html"]
    assert "sample 2" in str(made._repr_html_())
    page = made.compare(made[0], tmp_path / "c.html", labels=["truth", "a", "b"])
    assert page.truth == 0
    assert (tmp_path / "c.html").is_file()


def test_models_that_were_just_made_or_saved_animate_alike(
    model: facediff.Animator, speech: Path, tmp_path: Path
) -> None:
    plain = model.animate(speech, seed=3)
    model.save_pretrained(tmp_path / "folder")
    again = facediff.load(str(tmp_path / "folder"), device="auto")
    np.testing.assert_array_equal(again.animate(speech, seed=3).vertices, plain.vertices)
    wrapped = facediff.Animator(model.module)
    assert wrapped.animate(speech, seed=3).metadata["checkpoint"] == "DualPathDiffusion"
    for said in ("F1", "F4", "puppet (synthetic)", "5875 vertices", "cpu", "commercial use allowed"):
        assert said in repr(model)
    assert model.identities[0] == "F1"
    assert "F4" in model.other_identities


def test_threads_and_training_leave_a_model_as_it_was(saved_model: Path, speech: Path) -> None:
    model, jobs = facediff.load(saved_model, device="cpu"), [{}, {"steps": 2}, {"expressivity": 0.3}]

    def animate(options: dict[str, float]) -> np.ndarray:
        return model.animate(speech, seed=1, **options).vertices  # type: ignore[arg-type]

    expected = [animate(options) for options in jobs]
    with ThreadPoolExecutor(3) as pool:
        assert all(map(np.array_equal, pool.map(animate, 2 * jobs), 2 * expected))
    assert np.array_equal(animate({}), expected[0])
    model.module.train()
    assert np.array_equal(animate({}), expected[0])
    assert model.module.training
    model.frame_rate = 50.0
    with pytest.raises(FaceDiffError, match="Audio2Face"):
        animate({})


def test_a_list_and_a_folder_give_what_each_recording_gives_alone(
    model: facediff.Animator, speech: Path, tmp_path: Path
) -> None:
    alone = [model.animate(speech, seed=3, steps=2), model.animate(TONE, 16000, seed=3, steps=2)]
    together = model.animate([speech, (TONE, 16000)], seed=3, steps=2)
    assert isinstance(together, list)
    assert [animation.name for animation in together] == ["tone", "speech"]
    for animation, expected in zip(together, alone, strict=True):
        assert isinstance(animation, facediff.Animation)
        np.testing.assert_array_equal(animation.vertices, expected.vertices)
    several = model.animate([TONE, TONE[:9000]], 16000, samples=2, steps=1)
    assert [len(samples) for samples in several] == [2, 2]
    (tmp_path / "recordings").mkdir()
    for name in "ba":
        shutil.copy(speech, tmp_path / "recordings" / f"{name}.wav")
    assert [each.name for each in model.animate(tmp_path / "recordings", steps=1)] == ["a", "b"]
    for options in ({"alignment": "a.csv"}, {"name": "x"}):
        with pytest.raises(facediff.FaceDiffError, match=next(iter(options))):
            model.animate([speech, speech], **options)  # type: ignore[call-overload]
    assert model.animate([]) == []


@pytest.mark.slow
def test_progress_is_reported_to_a_function(model: facediff.Animator) -> None:
    reports: list[tuple[int, int]] = []
    model.animate(TONE, 16000, steps=3, progress=lambda done, total: reports.append((done, total)))
    assert reports == [(1, 3), (2, 3), (3, 3)]
    reports.clear()
    long = np.tile(TONE, 3)
    model.animate(long, 16000, steps=1, low_latency=True, progress=lambda *report: reports.append(report))
    assert reports == [(1, 3), (2, 3), (3, 3)], "seconds of speech"


def test_low_latency_gives_the_frames_of_its_stream(model: facediff.Animator) -> None:
    whole = model.animate(TONE, 16000, low_latency=True, seed=2)
    parts = [*model.stream(np.array_split(TONE, 9), low_latency=True, seed=2)]
    np.testing.assert_array_equal(np.concatenate(parts), whole.vertices)
    assert not np.array_equal(whole.vertices, model.animate(TONE, 16000, seed=2).vertices)


def test_data_type_is_the_precision_of_the_command(model: facediff.Animator) -> None:
    half = model.animate(TONE, 16000, steps=2, precision="bf16")
    assert half.metadata["precision"] == "bfloat16 and float32"
    for dtype in ("bfloat16", torch.bfloat16):
        np.testing.assert_array_equal(model.animate(TONE, 16000, steps=2, dtype=dtype).vertices, half.vertices)
    other = facediff.Animator(model.module, model.source)
    assert other.to("cpu", torch.bfloat16) is other
    np.testing.assert_array_equal(other.animate(TONE, 16000, steps=2).vertices, half.vertices)
    full = other.to("auto" if not torch.cuda.is_available() else "cpu", "float32").animate(TONE, 16000, steps=2)
    assert not np.array_equal(full.vertices, half.vertices)
    for options in ({"dtype": "float16"}, {"dtype": "float32", "precision": "bf16"}):
        with pytest.raises(facediff.FaceDiffError, match="dtype"):
            model.animate(TONE, 16000, **options)  # type: ignore[call-overload]
    with pytest.raises(facediff.FaceDiffError, match="device cuda:99"):
        other.to("cuda:99")


def test_random_seed_is_recorded(model: facediff.Animator) -> None:
    drawn = model.animate(TONE, 16000, steps=2, seed=None)
    again = model.animate(TONE, 16000, steps=2, seed=int(drawn.metadata["seed"]))
    np.testing.assert_array_equal(drawn.vertices, again.vertices)
    assert model.animate(TONE, 16000, steps=1, seed=None).metadata["seed"] != drawn.metadata["seed"]


def test_help_shows_every_keyword_with_its_text() -> None:
    signature = inspect.signature(facediff.Animator.animate)
    assert signature.parameters["steps"].default is None
    assert {*option_names(AnimateKeywords), "speech", "rate", "progress", "dtype"} <= {*signature.parameters}
    text = str(inspect.getdoc(facediff.Animator.stream))
    for name in option_names(StreamKeywords):
        assert f"    {name}: " in text
    with pytest.raises(TypeError, match=r"'stps'.*steps"):
        facediff.Animator.animate(None, TONE, stps=3)  # type: ignore[call-overload]


def option_names(keywords: type) -> list[str]:
    return list(typing.get_type_hints(keywords))
