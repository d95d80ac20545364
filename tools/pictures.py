"""Make the manual's pictures again, by the model that comes with facediff and by the built-in corpus.

    export FACEDIFF_CHROMIUM=$(tools/browser/install.sh FOLDER)
    python tools/pictures.py                      # all of them, in about ten minutes on two cores
    python tools/pictures.py own_mesh viewer_overlay --scratch made

people needs Google's model of a face ($FACEDIFF_FACE_MODEL, docs/own_data.md).

Not made here: live_path.svg and architecture.svg, which were drawn by hand, and export_blender.png, by
tools/blender_check.py of version 1.1.0.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from facediff.animation import Animation, read_archive  # noqa: E402
from facediff.cli.demo import write_sheet  # noqa: E402
from facediff.data import Puppet  # noqa: E402
from facediff.editing.controls.direction import Direction, Key  # noqa: E402
from facediff.export import ExportOptions  # noqa: E402
from facediff.export.video import drawn_frames  # noqa: E402
from facediff.render import contact_sheet, save_image  # noqa: E402
from tests.fakes.heads import FAMILY  # noqa: E402

SPEECH = "facediff animate {root}/docs/examples/speech.wav"
HELLO = (f"{SPEECH} -o hello.npz",)
EXPRESSIVE = f"{SPEECH} --expressiveness upper_face=2.5,lips=1.4,all=1.3 -o expressive.npz"
CLIPS = ("F1_t01", "F1_t02", "F1_t03", "F1_t04")
TAKE = "facediff animate {speech} --identity F1 --style F1_neutral --suffix .npy"
TAKES = tuple(
    f"{TAKE} --expressivity {expressivity} -o {name}"
    for name, expressivity in (("mean", 0), ("half", 0.5), ("sample", 1), ("more", 1.5))
)
"""Four sentences of a speaker by their mean, by half, one and one and a half of a sample's distance from it."""
SAID = "{corpus}/wav/M5_t01.wav"
TRUTH = (
    f"facediff export {{corpus}}/vertices_npy/M5_t01.npy --checkpoint puppet --identity M5 --speech {SAID} "
    "-o truth.npz",
    f"facediff animate {SAID} --identity M5 --style M1_neutral -o facediff.npz",
)
PAGE = (*TRUTH, "facediff view facediff.npz --truth truth.npz -o page.html")
BROWSER = "python {root}/tools/browser/"
STUDY = (*TAKES, "facediff study make sample=sample mean=mean --truth puppet --max-clips 4 -o study --yes")
RATING = (
    BROWSER + "screenshot.py study/page/index.html {picture} --ready window.facediffStudy "
    "--script \"document.getElementById('agree').click(), document.getElementById('start').click()\" "
    "--until \"facediffStudy.current && [...document.querySelectorAll('video')].every((one) => one.readyState > 3)\""
)
KEYS = [
    Key(0.0, "expressiveness", 1.0),
    Key(3.8, "expressiveness", 2.4),
    Key(6.2, "expressiveness", 0.8),
    Key(0.5, "head.yaw", -8.0),
    Key(2.6, "head.yaw", 10.0, "step"),
    Key(5.0, "head.yaw", 0.0),
]

PICTURES: dict[str, tuple[str, ...]] = {
    "animation_controls.png": (
        *HELLO,
        EXPRESSIVE,
        f"{SPEECH} --blinks 26 --gaze 10 --sway 6 --controls-seed 55 -o alive.npz",
        "rows hello.npz expressive.npz alive.npz {picture}",
    ),
    "blendshapes.png": (*HELLO, "facediff blendshapes hello.npz -o weights.csv --shapes puppet --show {picture}"),
    "browser.png": (BROWSER + "talking_page.py puppet {root}/docs/examples/speech.wav --picture {picture} --frame 96",),
    "demo.png": (*TRUTH, "sheet truth.npz facediff.npz {picture}"),
    "export_glb.png": (
        *HELLO,
        "facediff export hello.npz -o hello.glb",
        "python {root}/tools/glb_sheet.py hello.glb {picture} --times 0 0.32 0.6 0.92 1.24 1.6",
    ),
    "expressivity.png": (
        *TAKES,
        "facediff figure heatmap 0=mean puppet --method 0.5=half --method 1=sample --method 1.5=more "
        "--dpi 110 -o {picture}",
    ),
    "figure_frames.png": (
        *TAKES,
        "facediff figure frames sample=sample puppet --method mean=mean --clip F1_t01 --phonemes b m z oʊ p "
        "--dpi 100 -o {picture}",
    ),
    "figure_lips.png": (
        *TAKES,
        "facediff figure lips sample=sample puppet --method mean=mean --clip F1_t01 --dpi 150 -o {picture}",
    ),
    "live_page.png": (BROWSER + "live_picture.py {picture}",),
    "own_mesh.png": (
        *HELLO,
        "head avatar_head face.obj",
        "facediff retarget hello.npz --target-mesh face.obj -o mine.glb --correspondence map.npz --show {picture}",
    ),
    "own_mesh_picking.png": (BROWSER + "picking_picture.py {picture}",),
    "people.webp": (
        f"facediff animate {' '.join(f'{{corpus}}/wav/F1_e{number:02d}.wav' for number in range(1, 25))} --identity F1 "
        "--sway 6 --size 384 --suffix .mp4 -o ada",
        "facediff data track ada --name ada -o ada_corpus --preview look.mp4",
        "facediff person ada --name ada -o ada.ckpt",
        f"{SPEECH} --checkpoint ada.ckpt -o spoken.npz",
        "facediff blendshapes --write-puppet-shapes m2 --identity M2",
        "facediff retarget spoken.npz --target-mesh m2/neutral.obj -o on_face.npz",
        "python {root}/tools/people_picture.py look.mp4 ada_corpus on_face.npz {picture}",
    ),
    "puppet_head.webp": ("python {root}/tools/puppet_sheet.py {picture}",),
    "study_narrow.png": (*STUDY, f"{RATING} --width 390 --height 844"),
    "study_wide.png": (*STUDY, f"{RATING} --width 1200 --height 760"),
    "talking_face.webp": (
        *TRUTH,
        "facediff export truth.npz facediff.npz --size 512 -o both.mp4",
        "python {root}/tools/moving_picture.py both.mp4 {picture}",
    ),
    "viewer_direction.png": (
        "keys keys.json",
        f"{SPEECH} --direction keys.json -o directed.npz",
        "facediff view directed.npz -o directed.html",
        BROWSER + "screenshot.py directed.html {picture} --width 1000 --height 800 --frame 96 "
        '--script "facediff.direct(true)"',
    ),
    "viewer_narrow_light.png": (
        *PAGE,
        BROWSER + "screenshot.py page.html {picture} --width 390 --height 844 --frame 46",
    ),
    "viewer_overlay.png": (
        *HELLO,
        EXPRESSIVE,
        "facediff view expressive.npz hello.npz --labels expressive plain -o two.html",
        BROWSER + "screenshot.py two.html {picture} --width 768 --height 700 --frame 96 "
        """--script "facediff.compare('overlay')" """,
    ),
    "viewer_wide_dark.png": (
        *PAGE,
        BROWSER + "screenshot.py page.html {picture} --width 1000 --height 800 --frame 46 --dark "
        '--script "facediff.heat(true)"',
    ),
}


def main() -> None:
    """Run the commands of the pictures that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="without its suffix; all of them if none is given")
    parser.add_argument("--scratch", type=Path, help="keep what the pictures are made of in this folder")
    parser.add_argument("--output", type=Path, default=ROOT / "docs/images")
    given = parser.parse_args()
    known = {Path(name).stem: name for name in PICTURES}
    if unknown := set(given.names) - set(known):
        parser.error(f"{', '.join(unknown)}: there is no such picture; known are {', '.join(known)}")
    data = Puppet()
    data.prepare_data()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.scratch or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        speech = " ".join(f"{data.root}/wav/{clip}.wav" for clip in CLIPS)
        done: set[str] = set()
        for name in (known[each] for each in given.names or known):
            began = time.monotonic()
            for line in PICTURES[name]:
                command = line.format(
                    root=ROOT, corpus=data.root, speech=speech, picture=(given.output / name).resolve()
                )
                if command not in done:
                    run(shlex.split(command), folder)
                    done.add(command)
            print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)


def run(words: list[str], folder: Path) -> None:
    """Run a command in the folder."""
    if words[0] in ("rows", "sheet"):
        *names, picture = words[1:]
        animations = [replace(read_archive(folder / name), name=Path(name).stem) for name in names]
        if words[0] == "rows":
            rows(animations, Path(picture))
        else:
            write_sheet(Path(picture), animations)
    elif words[0] == "keys":
        (folder / words[1]).write_text(Direction(KEYS).text(), encoding="utf-8")
    elif words[0] == "head":
        head = FAMILY[words[1].replace("_", " ")]()
        trimesh.Trimesh(head.vertices, head.faces, process=False).export(folder / words[2], include_normals=False)
    else:
        given = words[1:] if words[0] == "python" else ["-m", *words]
        if subprocess.run([sys.executable, *given], cwd=folder, check=False, stdout=subprocess.DEVNULL).returncode:
            raise SystemExit(f"failed: {shlex.join(words)}")


def rows(animations: list[Animation], picture: Path) -> None:
    """A row for each animation, at four moments."""
    picks = [int(frame) for frame in np.linspace(0.2, 0.8, 4) * len(animations[0].vertices)]
    frames = [frame for each in animations for frame in drawn_frames([each.part(picks)], ExportOptions(size=224))]
    save_image(picture, contact_sheet(frames, len(picks)))


if __name__ == "__main__":
    main()
