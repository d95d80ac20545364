"""The page: template, style, script and data put together in one HTML file."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.archives import FORMAT as ARCHIVE
from facediff.animation.options import ExportOptions
from facediff.editing.acting import speech_16k
from facediff.editing.controls import direction
from facediff.editing.controls.expressiveness import ALL, region_factors
from facediff.editing.controls.procedural import neck
from facediff.errors import FaceDiffError
from facediff.export.format import Format, check_animation, outward, speech_wav
from facediff.export.viewer.packing import (
    CHUNK_FRAMES,
    STEP,
    Blobs,
    bounds,
    heat_scale_end,
    millimetres,
    mouth_opening,
    pack_mesh,
    pack_motion,
)
from facediff.export.viewer.posing import acted_curves, channel_facts, moods, pose_fields, sounds
from facediff.registry import export_format
from facediff.utils import SAMPLE_RATE
from facediff.utils.files import atomic, check_writable
from facediff.utils.html_pages import fill, hash_source, script_data

FORMAT = "facediff page 1"
MOST_ANIMATIONS = 4
SCRIPTS = (
    *("motion", "surface", "clock", "camera", "scene"),
    *("plot", "curve", "waveform", "dialogs", "panels", "compare"),
    *("archive", "direction", "lanes", "preview", "glb", "takes", "editor", "report", "player"),
)
"""Parts of the script; each uses only the parts before it."""

UNITS = {"brows": "mm", "blinks": "a minute", "gaze": "degrees", "sway": "degrees", "head": "degrees"}
"""Units of channels of keys; the others are factors."""
USUAL = {"head": (-10.0, 10.0)}
"""First range of a lane, where the full range is far larger than usual values."""
REST = {"expressiveness": 1.0, "acting": 1.0}
"""Values of channels without keys, and of their first key; 0 for the others."""
PREVIEWED = ("expressiveness", "head")
POSED = ("brows", "lids", "shape")
"""Channels that the page previews without the model: for any face, and for faces with known displacements."""


@export_format.register("html")
class PageFormat(Format):
    """A page that plays in any browser, without a server."""

    next_step = "open it in a browser; `facediff view` has more options"
    holds_several = True
    speech = "in the file"
    units = "none"
    up_axes = ()

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write a page that shows all animations next to each other."""
        shown = [animation if not options.no_speech else replace(animation, speech=None) for animation in animations]
        write_page(path, shown)


def write_page(path: Path, animations: Sequence[Animation], *, truth: int | None = None) -> None:
    """Write one self-contained HTML file that plays animations side by side with their speech.

    It loads nothing: no script, font or picture from elsewhere; its content security policy forbids it. Positions are
    rounded by at most 0.0433 mm. It needs a browser with WebGL 2 and ``DecompressionStream``: Chrome or Edge 111,
    Firefox 113, Safari 16.4 or newer.

    Args:
        path: the .html file.
        animations: 1 to 4 animations of one frame rate and one length, each with its own mesh. The page plays the
            speech of the first animation that has any.
        truth: number of the reference animation, from 0; others of its topology get a heat map of the Euclidean
            distance of each vertex from it.
    """
    check_writable(path)
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as stream:
        stream.writelines(page_parts(animations, truth=truth))


def page_parts(animations: Sequence[Animation], *, truth: int | None = None) -> Iterator[str]:
    """The text of the page in pieces, in order, as :func:`write_page` writes it."""
    check_page(animations)
    blobs = Blobs()
    facts = _page_facts(animations, truth, blobs)
    values = {"title": html.escape(" · ".join(animation.name for animation in animations))}
    return assemble("page.html", ("style.css",), SCRIPTS, values, facts, blobs, loads="img-src data:; media-src blob:")


def check_page(animations: Sequence[Animation]) -> None:
    """Refuse animations of different length or frame rate, or too many of them."""
    if not 1 <= len(animations) <= MOST_ANIMATIONS:
        raise FaceDiffError(
            f"a page shows 1 to {MOST_ANIMATIONS} animations side by side, not {len(animations)}; choose among them"
        )
    first = animations[0]
    for animation in animations:
        if animation.frame_rate != first.frame_rate or len(animation.vertices) != len(first.vertices):
            raise FaceDiffError(
                f"{animation.name}: has {len(animation.vertices)} frames at {animation.frame_rate:g} a second and "
                f"{first.name} {len(first.vertices)} at {first.frame_rate:g}; animations on one page need the same "
                f"length and frame rate: cut them, as `facediff view --shortest` does"
            )
        check_animation(animation)


def _page_facts(animations: Sequence[Animation], truth: int | None, blobs: Blobs) -> dict[str, Any]:
    """The JSON that the script reads: numbers, names, and the numbers of arrays among the blobs."""
    speaking = next((animation for animation in animations if animation.speech is not None), None)
    sound = None
    if speaking is not None:  # it is stored as it is, three times as large at 48 kHz
        sound = speech_wav(replace(speaking, speech=speech_16k(speaking), sample_rate=SAMPLE_RATE))
    compared: list[int] = []
    heat = None
    if truth is not None:
        # Only vertices of the truth's own topology have a distance from it.
        compared = [
            number
            for number, animation in enumerate(animations)
            if number != truth and np.array_equal(animation.triangles, animations[truth].triangles)
        ]
    if truth is not None and compared:
        from facediff.render.panels import heat_ramp

        end = heat_scale_end(animations[truth], [animations[number] for number in compared])
        heat = {"ramp": blobs.add(heat_ramp().tobytes()), "highest": end}
    return {
        "format": FORMAT,
        "frameRate": animations[0].frame_rate,
        "frames": len(animations[0].vertices),
        "step": STEP,
        "chunkFrames": CHUNK_FRAMES,
        "sound": None if sound is None else blobs.add_pieces(sound),
        "sounds": sounds(animations),
        "truth": truth,
        "heat": heat,
        "archive": ARCHIVE,
        "direction": _direction_facts(),
        "animations": [
            _animation_facts(animation, number in compared, blobs) for number, animation in enumerate(animations)
        ],
    }


def _direction_facts() -> dict[str, Any]:
    """Facts of the file of keys and of the channels, for the editor."""
    channels: dict[str, dict[str, Any]] = {}
    for name, channel in direction.CHANNELS.items():
        if name in direction.ENDED:
            continue
        limits = channel.range
        rest = min(max(REST.get(name, 0.0), limits.least), limits.most) if limits else ""
        facts = {
            "range": [limits.least, limits.most] if limits else None,
            "rest": rest,
            "usual": USUAL.get(name),
            "unit": UNITS.get(name, ""),
            "regions": channel.regions,
            "preview": "always" if name in PREVIEWED else "posed" if name in POSED else "never",
        }
        channels |= {f"{name}.{part}": facts for part in channel.parts} or {name: facts}
    return {
        "format": direction.FORMAT,
        "version": direction.VERSION,
        "insteadOf": direction.INSTEAD_OF,
        "stepSeconds": direction.STEP_SECONDS,
        "moods": moods(),
        "channels": channels,
    }


def _animation_facts(animation: Animation, compared: bool, blobs: Blobs) -> dict[str, Any]:
    """One animation: its arrays in mm among the blobs, and its names and numbers."""

    def number(array: npt.ArrayLike | None, kind: str) -> int | None:
        return None if array is None or not np.size(array) else blobs.add(np.asarray(array).astype(kind).tobytes())

    template = np.asarray(animation.template, np.float64) * millimetres(animation)
    centre, extent = bounds(template, animation.triangles)
    made_with = direction.direction_of(animation)
    regions = animation.regions
    # How much each vertex belongs to each region, in 255ths, for the preview of expressiveness.
    shares = {name: 255 * region_factors(animation.template, regions, {name: 1.0, ALL: 0.0}) for name in regions}
    head = animation.head
    return {
        "name": animation.name,
        "vertices": len(animation.template),
        "triangles": len(animation.triangles),
        **pack_mesh(template, outward(animation), animation.colours, blobs),
        "opening": number(mouth_opening(animation), "<f4"),
        "chunks": pack_motion(animation, blobs),
        "centre": centre,
        "extent": extent,
        "compared": compared,
        "pairs": number(animation.inner_lip_pairs, "<i4"),
        "regions": {name: blobs.add(np.asarray(indices, "<i4").tobytes()) for name, indices in regions.items()},
        "head": None if head is None else number(head * np.repeat([1.0, millimetres(animation)], 3), "<f4"),
        "fields": pose_fields(animation, blobs),
        "acted": acted_curves(animation, blobs),
        "weighted": channel_facts(animation, blobs),
        "weights": {name: number(np.rint(share), "u1") for name, share in shares.items()},
        "neck": (neck(animation.template) * millimetres(animation)).round(3).tolist(),
        "direction": None if made_with is None else made_with.rows(),
        "insteadOf": [] if made_with is None else list(made_with.instead_of),
        "metadata": {str(key): str(value) for key, value in animation.metadata.items()},
    }


def assemble(
    page: str,
    styles: Sequence[str],
    scripts: Sequence[str],
    values: Mapping[str, str],
    facts: Mapping[str, object],
    blobs: Blobs,
    *,
    loads: str,
    own_scripts: bool = False,
) -> Iterator[str]:
    """A page of this package's assets in pieces, in order.

    Args:
        page: the template of its body, with places for script, facts, blobs and further values.
        styles: files of its style.
        scripts: parts of its script, as :func:`script_of` takes them.
        values: further values of the template, as HTML: the title, and the browser tab's (``tab``) if it differs.
        facts: JSON that the script reads.
        blobs: the binary parts.
        loads: sources that the page may load, in the words of its content security policy.
        own_scripts: whether scripts from the page's own server may be loaded too, as audio worklets must be.
    """
    style = "\n".join(_without_comments(_asset(name)) for name in styles)
    script = script_of(scripts)
    server = " 'self'" if own_scripts else ""
    filled = {
        "tab": values["title"],
        **values,
        # Lets this script and this style run, and nothing else be loaded.
        "policy": f"default-src 'none'; script-src {hash_source(script)}{server}; style-src {hash_source(style)}; "
        f"{loads}; base-uri 'none'; form-action 'none'",
        "style": style,
        "facts": script_data(facts),
        "script": script,
    }
    template = _asset("head.html") + _asset(page)
    before, after = (fill(part, filled) for part in template.split("{{blobs}}"))
    yield before
    yield from blobs.elements()
    yield after


def script_of(parts: Sequence[str]) -> str:
    """Parts of a script, without the suffix, as one; each uses only the parts before it."""
    return "(() => {\n" + "\n".join(_without_comments(_asset(f"{name}.js")) for name in parts) + "\n})();\n"


def _without_comments(source: str) -> str:
    """A script or style without indentation and without comments that have lines of their own: three quarters of it."""
    source = re.sub(r"^[ \t]*/\*(?:(?!\*/)[\s\S])*\*/[ \t]*\n", "", source, flags=re.MULTILINE)
    return re.sub(r"^[ \t]*(//.*)?\n|^[ \t]+", "", source, flags=re.MULTILINE)


def _asset(name: str) -> str:
    return resources.files("facediff.export.viewer").joinpath("assets", name).read_text(encoding="utf-8")
