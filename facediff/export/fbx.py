"""FBX by Blender: a .glb is written, and Blender, as a program or as the module ``bpy``, turns it into .fbx."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from facediff.animation import Animation
from facediff.errors import FaceDiffError

SCRIPT = Path(__file__).with_name("glb_to_fbx.py")
"""What Blender runs."""
PROGRAM, MODULE = "blender", "bpy"


def command() -> list[str] | None:
    """The command that runs the script, to which the script's own words are added; None where Blender is missing."""
    program = shutil.which(PROGRAM)
    if program is not None:
        return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(SCRIPT), "--"]
    return None if importlib.util.find_spec(MODULE) is None else [sys.executable, str(SCRIPT)]


def refuse_without_blender(path: Path) -> None:
    """Refuse a file that nothing here can write."""
    if command() is None:
        words = f"{PROGRAM} --background --python {SCRIPT.name} -- {path.stem}.glb {path.name}"
        raise FaceDiffError(
            f"{path}: Blender writes .fbx, and there is no program {PROGRAM} here; install it, or write "
            f"{path.stem}.glb and run `{words}` with {SCRIPT}"
        )


def write_fbx(
    path: Path, folder: Path, animation: Animation, sound: str | None, write_glb: Callable[[Path], list[Path]]
) -> list[Path]:
    """Write one animation; the sound lies next to it, since .fbx has no place for it.

    Args:
        path: the file.
        folder: hidden one, in which the files are written, to be moved to their places.
        animation: for its frame rate.
        sound: name of the file of its sound; None if there is none.
        write_glb: writes the .glb of that name, and returns its files.
    """
    refuse_without_blender(path)
    glb, *wav = write_glb(folder / f"{path.stem}.glb")
    made = folder / path.name
    rate = f"{animation.frame_rate:.9g}", f"{len(animation.vertices)}"
    words = [*(command() or []), str(glb), str(made), "--frame-rate", rate[0], "--frames", rate[1]]
    done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)  # noqa: S603
    if done.returncode != 0 or not made.is_file():
        said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        raise FaceDiffError(
            f"{path}: {words[0]} ended with status {done.returncode} ({said[:200]}); run {SCRIPT} by hand"
        )
    return [made] if sound is None else [made, wav[0].rename(folder / sound)]
