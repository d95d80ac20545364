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
"""The script for Blender."""
PROGRAM, MODULE = "blender", "bpy"


def command() -> list[str] | None:
    """The command that runs the script, to which the script's own words are added; None where Blender is missing."""
    program = shutil.which(PROGRAM)
    if program is not None:
        return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(SCRIPT), "--"]
    return None if importlib.util.find_spec(MODULE) is None else [sys.executable, str(SCRIPT)]


def refuse_without_blender(path: Path) -> None:
    """Refuse a file if Blender is missing."""
    if command() is None:
        call = f"{PROGRAM} --background --python {SCRIPT.name} -- {path.stem}.glb {path.name}"
        raise FaceDiffError(
            f"{path}: Blender writes .fbx, and there is no program {PROGRAM} here; install it, or write "
            f"{path.stem}.glb and run `{call}` with {SCRIPT}"
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
    fbx = folder / path.name
    rate, frames = f"{animation.frame_rate:.9g}", f"{len(animation.vertices)}"
    arguments = [*(command() or []), str(glb), str(fbx), "--frame-rate", rate, "--frames", frames]
    process = subprocess.run(arguments, capture_output=True, text=True, errors="replace", check=False)  # noqa: S603
    if process.returncode != 0 or not fbx.is_file():
        last_line = (process.stderr.strip() or process.stdout.strip() or "no output").splitlines()[-1]
        raise FaceDiffError(
            f"{path}: {arguments[0]} ended with status {process.returncode} ({last_line[:200]}); run {SCRIPT} by hand"
        )
    return [fbx] if sound is None else [fbx, wav[0].rename(folder / sound)]
