"""3DMEAD in miniature: EMOTE's distribution with MEAD's sound, ProbTalk3D's, and the prepared layout.

The names are the true ones, so that both of the field's splits apply. A tone's loudness opens the jaw.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import soundfile

EMOTIONS = ("neutral", "happy", "sad", "surprised", "fear", "disgusted", "angry", "contempt")
CLIPS = (
    *("M003_001_0_0", "M003_002_0_0", "M003_033_0_0", "M003_037_0_0"),
    *("M003_001_1_0", "M003_024_1_2", "M003_025_1_1", "M003_028_1_0"),
    *("W009_001_0_0", "W009_032_0_0", "W009_003_6_2", "W009_010_6_0", "W009_030_6_1"),
    *("M032_001_0_0", "M032_002_0_0", "M037_001_0_0", "M037_002_7_2", "W040_030_7_2", "W040_029_7_1"),
)
"""By sentence, M003 and W009 train, validate and are test A; by identity, M032 validates, M037 and W040 are test B."""
SOUND_RATE = 44_100


def frames_of(name: str) -> int:
    """Lengths differ from clip to clip."""
    return 14 + (3 * int(name[5:8]) + int(name[9]) + int(name[1:4])) % 9


def loudness(name: str) -> np.ndarray:
    """0 … 1 for each frame at 25 frames a second."""
    rate = 1.2 + (int(name[5:8]) + int(name[1:4])) % 7 / 4
    return 0.5 - 0.5 * np.cos(2 * np.pi * rate * np.arange(frames_of(name)) / 25)


def parameters_of(name: str) -> dict[str, np.ndarray]:
    """``shape`` (T, 300), which trembles as a reconstructed one does, ``exp`` (T, 100) and ``jaw`` (T, 3), float32."""
    rng = np.random.default_rng([int(name[1:4]), int(name[5:8]), int(name[9]), int(name[11])])
    own = np.random.default_rng(int(name[1:4])).normal(0, 1, 300)
    frames, loud = frames_of(name), loudness(name)
    time = np.arange(frames)[:, None]
    expression = rng.normal(0, 1, 100) + 0.5 * np.sin(time / 3 + np.arange(100))
    jaw = np.stack([0.25 * loud, 0.01 * np.sin(time[:, 0] / 4), np.zeros(frames)], 1)
    parts = {"shape": own + rng.normal(0, 0.2, (frames, 300)), "exp": expression, "jaw": jaw}
    return {key: value.astype(np.float32) for key, value in parts.items()}


def speech_of(name: str, rate: int = SOUND_RATE) -> np.ndarray:
    """A tone (S,) of the clip's own pitch, as loud as the jaw is open, with just the motion's length."""
    frames = frames_of(name)
    pitch = 250 + (31 * int(name[1:4]) + 7 * int(name[5:8]) + 3 * int(name[9]) + int(name[11])) % 100
    samples = round(frames * rate / 25)
    loud = np.interp(np.arange(samples) / rate * 25, np.arange(frames), loudness(name))
    return 0.6 * loud * np.sin(2 * np.pi * pitch * np.arange(samples) / rate)


def emote_folder(name: str, place: str = "front") -> str:
    """``M003/front/neutral/level_1/001``."""
    return f"{name[:4]}/{place}/{EMOTIONS[int(name[9])]}/level_{int(name[11]) + 1}/{name[5:8]}"


def write_hdf5(path: Path, parts: dict[str, np.ndarray], form: Literal["flat", "hickle"] = "flat") -> None:
    """A file of reconstructions: one dataset for each part, with a batch of one in front."""
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        group = file
        if form == "hickle":
            file.attrs["HICKLE_VERSION"] = "5.0.2"
            group = file.create_group("data")
            group.attrs["base_type"] = b"dict"
        for key, value in parts.items():
            group.create_dataset(f'"{key}"' if form == "hickle" else key, data=value[None])


def write_m4a(path: Path, speech: np.ndarray, rate: int = SOUND_RATE) -> None:
    """AAC in an MP4 container, as MEAD's sound is."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="ipod") as container:
        sound = container.add_stream("aac", rate=rate, layout="mono")
        for start in range(0, len(speech), 1024):
            block = np.ascontiguousarray(speech[None, start : start + 1024], dtype=np.float32)
            frame = av.AudioFrame.from_ndarray(block, format="fltp", layout="mono")
            frame.sample_rate, frame.pts = rate, start
            container.mux(sound.encode(frame))
        container.mux(sound.encode(None))


def write_wav(path: Path, speech: np.ndarray, rate: int = SOUND_RATE) -> None:
    """16-bit wav."""
    path.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(path, speech, rate, subtype="PCM_16")


def write_raw_emote(
    root: Path,
    *,
    clips: Sequence[str] = CLIPS,
    form: Literal["flat", "hickle"] = "flat",
    audio: Literal["m4a", "wav", "none"] = "m4a",
) -> Path:
    """Write ``EMICA-MEAD_flame2020/`` as EMOTE's archive unpacks, and ``MEAD/`` with MEAD's own sound."""
    for name in clips:
        parts = parameters_of(name)
        frames = len(parts["jaw"])
        place = root / "EMICA-MEAD_flame2020" / emote_folder(name)
        turned = {"global_pose": np.full((frames, 3), 0.3, np.float32), "cam": np.ones((frames, 3), np.float32)}
        write_hdf5(place / "shape_pose_cam.hdf5", parts | turned, form)
        light = {"tex": np.zeros((frames, 50), np.float32), "light": np.zeros((frames, 9, 3), np.float32)}
        write_hdf5(place / "appearance.hdf5", light, form)
        sound = root / "MEAD" / f"{emote_folder(name, 'audio')}.{audio}"
        if audio == "m4a":
            write_m4a(sound, speech_of(name))
        elif audio == "wav":
            write_wav(sound, speech_of(name))
    return root


def write_raw_probtalk3d(root: Path, *, clips: Sequence[str] = CLIPS) -> Path:
    """Write ``param/`` with (1, T, 403) arrays and ``wav/``."""
    (root / "param").mkdir(parents=True)
    for name in clips:
        parts = parameters_of(name)
        np.save(root / "param" / f"{name}.npy", np.concatenate([parts["shape"], parts["exp"], parts["jaw"]], 1)[None])
        write_wav(root / "wav" / f"{name}.wav", speech_of(name))
    return root
