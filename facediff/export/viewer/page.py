"""The page: template, style, script and data put together in one file."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from facediff.animation import Animation
from facediff.errors import FaceDiffError
from facediff.export.format import ExportOptions, Format
from facediff.export.viewer.packing import (
    CHUNK_FRAMES,
    STEP,
    Blobs,
    bounds,
    check_animations,
    comparable,
    first_sound,
    millimetres,
    opening,
    pack_motion,
    scale_end,
)
from facediff.registry import export_format
from facediff.utils.files import atomic, check_writable

FORMAT = "facediff page 1"
SCRIPTS = (
    "motion.js",
    "surface.js",
    "clock.js",
    "camera.js",
    "scene.js",
    "curve.js",
    "dialogs.js",
    "panels.js",
    "player.js",
)
"""Parts of the script; each uses only what stands before it."""
MEGABYTE = 1_000_000


def write_page(path: Path, takes: Sequence[Animation], *, max_mb: float = 30.0, truth: int | None = None) -> None:
    """Write one self-contained HTML file that plays takes side by side with their speech.

    It loads nothing: no script, font or picture from elsewhere; its content security policy forbids it. Positions are
    rounded by at most 0.0433 mm. It needs a browser with WebGL 2 and ``DecompressionStream``: Chrome or Edge 111,
    Firefox 113, Safari 16.4 or newer.

    Args:
        path: the .html file.
        takes: 1 to 4 takes of one frame rate and one length, each with its own mesh. The speech is that of the first
            take that has any.
        max_mb: the largest file that is written, in megabytes (10⁶ bytes).
        truth: number of the take, from 0, that the others are compared with; those of its topology get a heat map of
            the Euclidean distance of each vertex from it.

    Raises:
        FaceDiffError: if the takes do not make a page, or the file would be too large or cannot be written. Nothing
            is left half-written.
        MissingExtraError: for a heat map without OpenCV.
    """
    check_writable(path)
    check_animations(takes, truth)
    blobs = Blobs()
    facts = page_facts(takes, truth, blobs)
    parts = page_parts(facts, blobs)
    size = sum(len(part.encode()) for part in parts) / MEGABYTE
    if size > max_mb:
        raise FaceDiffError(
            f"{path}: would have {size:.1f} MB, more than the limit of {max_mb:g} MB; show fewer or shorter takes, or "
            f"raise the limit (`facediff view --max-mb`)"
        )
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(parts)


@export_format.register("html")
class Page(Format):
    """A page that plays in any browser, without a server."""

    next_step = "open it in a browser; `facediff view` has more options"
    holds_several = True
    speech = "in the file"
    units = "none"
    up_axes = ()

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write a page that shows all animations next to each other."""
        write_page(path, [a if options.speech else replace(a, speech=None) for a in animations])


def page_facts(takes: Sequence[Animation], truth: int | None, blobs: Blobs) -> dict[str, Any]:
    """What the script reads: numbers and names, and under which numbers arrays are among the blobs."""
    sound = first_sound(takes)
    alike = [
        number
        for number, animation in enumerate(takes)
        if truth is not None and number != truth and comparable(animation, takes[truth])
    ]
    return {
        "format": FORMAT,
        "frameRate": takes[0].frame_rate,
        "frames": len(takes[0].vertices),
        "step": STEP,
        "chunkFrames": CHUNK_FRAMES,
        "sound": None if sound is None else blobs.add(sound),
        "truth": truth,
        "heat": None if truth is None or not alike else heat_facts(takes[truth], [takes[i] for i in alike], blobs),
        "takes": [animation_facts(animation, number in alike, blobs) for number, animation in enumerate(takes)],
    }


def heat_facts(truth: Animation, others: Sequence[Animation], blobs: Blobs) -> dict[str, Any]:
    """The heat map's scale, and its 256 colours as bytes of sRGB."""
    from facediff.render.panels import heat_ramp

    return {"ramp": blobs.add(heat_ramp().tobytes()), "highest": scale_end(truth, others)}


def animation_facts(animation: Animation, compared: bool, blobs: Blobs) -> dict[str, Any]:
    """One take: its arrays in mm among the blobs, and words about it."""
    from facediff.render.rasteriser import face_outward

    # The script takes what is wound clockwise for the hollow of the mouth.
    outside = face_outward(animation.triangles.astype(np.int32), np.asarray(animation.template, np.float64))
    centre, extent = bounds(animation)
    curve = opening(animation)
    template = np.asarray(animation.template, np.float64) * millimetres(animation)
    return {
        "name": animation.name,
        "vertices": len(animation.template),
        "triangles": len(animation.triangles),
        "template": blobs.add(template.astype("<f4").tobytes()),
        "faces": blobs.add(outside.astype("<u4").tobytes()),
        "colours": None if animation.colours is None else blobs.add(animation.colours.astype(np.uint8).tobytes()),
        "opening": None if curve is None else blobs.add(curve.astype("<f4").tobytes()),
        "chunks": pack_motion(animation, blobs),
        "centre": centre,
        "extent": extent,
        "compared": compared,
        "metadata": {str(key): str(value) for key, value in animation.metadata.items()},
    }


def page_parts(facts: dict[str, Any], blobs: Blobs) -> list[str]:
    """The text of the page in pieces, in order."""
    style = read_text("style.css")
    script = "(() => {\n" + "\n".join(read_text(name) for name in SCRIPTS) + "\n})();\n"
    values = {
        "title": html.escape(" · ".join(animation["name"] for animation in facts["takes"])),
        "policy": policy(script, style),
        "style": style,
        "facts": safe_json(facts),
        "script": script,
    }
    before, after = read_text("page.html").split("{{blobs}}")
    data = [
        f'<script type="text/plain" id="blob-{number}">{text}</script>\n' for number, text in enumerate(blobs.texts)
    ]
    return [fill(before, values), *data, fill(after, values)]


def fill(template: str, values: dict[str, str]) -> str:
    """Put values into the places {{name}}; what stands in a value is not looked at again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


def policy(script: str, style: str) -> str:
    """A content security policy that lets this script and this style run, and nothing be loaded."""
    return (
        f"default-src 'none'; script-src '{digest(script)}'; style-src '{digest(style)}'; "
        f"img-src data:; media-src blob:; base-uri 'none'; form-action 'none'"
    )


def digest(text: str) -> str:
    """A text's hash as a content security policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


def safe_json(value: object) -> str:
    """JSON that cannot end the element it stands in, whatever names are in it."""
    text = json.dumps(value, allow_nan=False)  # without characters beyond ASCII
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def read_text(name: str) -> str:
    """A file of the page."""
    return resources.files("facediff.export.viewer").joinpath("assets", name).read_text(encoding="utf-8")
