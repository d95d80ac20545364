"""An exported model as a web site: a page in which it animates recordings and the microphone, by WebAssembly.

The site is a folder of plain files: the page, the worker that computes, ONNX Runtime for browsers, and the model. Any
web server can offer it. The one here listens at this machine only, and sends the headers that let WebAssembly use
threads.
"""

from __future__ import annotations

import hashlib
import html
import shutil
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from facediff.animation import Animation
from facediff.animation.archives import FORMAT as ARCHIVE
from facediff.errors import FaceDiffError
from facediff.export.format import outward
from facediff.export.viewer.packing import Blobs, millimetres, pack_mesh
from facediff.export.viewer.page import assemble, script_of
from facediff.runtime.folder import ARRAYS, DESCRIPTION, Arrays, Description, read_folder
from facediff.runtime.graph_check import check_graph
from facediff.speech.audio import read_recording
from facediff.speech.voice_activity import OFF, QUICK_GATE, USUAL_GATE, EnergyGate, read_gate
from facediff.speech.windows import LOW_LATENCY_AHEAD
from facediff.utils.checksums import sha256
from facediff.utils.files import atomic_folder, valid_text
from facediff.utils.server import HEADERS as SERVED
from facediff.utils.server import own_page_only

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

FORMAT = "facediff site 1"
PAGE = "index.html"
SCRIPTS = (
    *("motion", "surface", "clock", "camera", "scene", "stage", "plot", "waveform"),
    *("dialogs", "report", "archive", "glb", "windows", "frame_clock", "resample", "microphone", "talk"),
)
"""Parts of the page's script; each uses only the parts before it."""
WORKER = ("archive", "npz", "noise", "windows", "voice_gate", "frame_clock", "exported", "generating", "talk_worker")
"""Parts of the worker's script."""
DELAYS: tuple[dict[str, float | bool], ...] = (
    {**vars(LOW_LATENCY_AHEAD), "quick": True},
    {**vars(LOW_LATENCY_AHEAD), "quick": True, "seconds": 4 / 30},  # a third of the work
    {"seconds": 1.0, "overlap": 0.4},
)
"""Windows for a microphone that answer sooner than the model's own; quick ones take few denoising steps. A page begins
with the first, and goes on with the next where the machine is too slow."""

GATE_OPTIONS = "margin", "attack", "lead", "hold", "release"

LOADS = "connect-src 'self'; worker-src 'self'; img-src data:; media-src blob:"
"""Loads of the page besides its own scripts: its worker, and sound that the reader has opened."""
WORKER_POLICY = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; connect-src 'self'"
"""What scripts of the site may load: themselves, compiled WebAssembly, and files of the site."""
HEADERS = {
    # With the opener policy of every page, these give a page shared memory, without which WebAssembly has one thread.
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Permissions-Policy": "microphone=(self)",
    "Cache-Control": "no-cache",
}
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".wasm": "application/wasm",
    ".txt": "text/plain; charset=utf-8",
}

Site = Mapping[str, bytes | Path]
"""The files of a site by their paths in it: bytes, or paths of existing files."""


def make_site(folder: Path, runtime: Mapping[str, Path], recordings: Sequence[Path] = ()) -> Site:
    """The site of an exported model.

    Args:
        folder: of ``facediff export-model``.
        runtime: ONNX Runtime's files, as :func:`facediff.runtime.onnxruntime_web.web_runtime` gives them.
        recordings: that a visitor can try the model with, listed by their names.
    """
    description, arrays = read_folder(folder)
    # A page takes styles by their names: what encodes them from motion is left out.
    graphs = [graph for graph in description.graphs if graph != "style"]
    for graph in graphs:
        check_graph(folder / f"{graph}.onnx")
    examples: dict[str, Path] = {}
    for path in recordings:
        read_recording(path)
        if (name := valid_text(path.name)) in examples:
            raise FaceDiffError(f"--recordings {path}: two have this name; rename one")
        examples[name] = path
    files: dict[str, bytes | Path] = {
        PAGE: page(valid_text(folder.resolve().name), description, arrays, list(examples)).encode(),
        "worker.js": script_of(WORKER).encode(),
        "capture.js": script_of(("capture",)).encode(),
        "_headers": headers_file().encode(),
        # ONNX Runtime for browsers has the licence of the one that is installed.
        "onnxruntime/LICENCE.txt": Path(str(resources.files("onnxruntime").joinpath("LICENSE"))),
    }
    files |= {f"recordings/{name}": path for name, path in examples.items()}
    files |= {f"onnxruntime/{name}": path for name, path in runtime.items()}
    files |= {f"model/{name}": folder / name for name in (DESCRIPTION, ARRAYS, *(f"{graph}.onnx" for graph in graphs))}
    return files


def page(title: str, description: Description, arrays: Arrays, recordings: Sequence[str] = ()) -> str:
    """The page of a model, with the names of recordings to try."""
    if not description.motion_space.is_vertices:
        raise FaceDiffError(
            f"{title}: moves channels ({description.motion_space.kind}), and the page plays models of vertices only; "
            f"use `facediff live {title} --to browser`"
        )
    if "faces" not in arrays:
        raise FaceDiffError(
            f"{title}: holds no triangles, which a picture needs; export a model of a corpus with a mesh"
        )
    name, blobs = description.known[0], Blobs()
    number = description.faces.index(name)
    template = arrays["templates"][number].astype(np.float32)
    colours = arrays.get("colours")
    if colours is not None and colours.ndim == 3:
        colours = colours[number]
    triangles = arrays["faces"].astype(np.int32)
    face = Animation(title, template[None], template, description.frame_rate, faces=triangles, unit=description.unit)
    mesh = pack_mesh(millimetres(face) * template, outward(face), colours, blobs)
    facts: dict[str, Any] = {
        "format": FORMAT,
        "archive": ARCHIVE,
        "checkpoint": title,
        "millimetres": millimetres(face),
        "face": {**mesh, "name": name, "frameRate": description.frame_rate},
        "delays": DELAYS,
        "recordings": recordings,
        "rests": description.voice_gate != OFF,
        "gates": {"usual": gate_facts(USUAL_GATE), "quick": gate_facts(QUICK_GATE)},
    }
    values = {"title": html.escape(title)}
    styles = "style.css", "talk.css"
    return "".join(assemble("talk.html", styles, SCRIPTS, values, facts, blobs, loads=LOADS, own_scripts=True))


def gate_facts(text: str) -> dict[str, float]:
    """Settings of the page's voice gate, from a gate's name and options."""
    gate = cast(EnergyGate, read_gate(text))
    return {**{name: getattr(gate, name) for name in GATE_OPTIONS}, "ahead": gate.look_ahead}


def headers_file(pages: str = "/*") -> str:
    """The headers of some pages in the form in which several hosts of static files take them from a site's root."""
    lines = [pages, *(f"  {name}: {value}" for name, value in {**SERVED, **HEADERS}.items())]
    return "\n".join(lines) + "\n"


def write_site(site: Site, folder: Path) -> int:
    """Write a site as a folder for any web server; how many bytes it has."""
    with atomic_folder(folder) as staged:
        for name, content in site.items():
            path = staged / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, bytes):
                path.write_bytes(content)
            else:
                shutil.copyfile(content, path)
        return sum(path.stat().st_size for path in staged.rglob("*") if path.is_file())


def make_app(site: Site, hosts: tuple[str, ...] | None) -> Starlette:
    """The ASGI application that offers a site under names of hosts (None for any), and nothing else."""
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.middleware.gzip import GZipMiddleware
    from starlette.responses import FileResponse, PlainTextResponse, Response
    from starlette.routing import Route

    async def show(request: Request) -> Response:
        name = request.path_params["name"] or PAGE
        content = site.get(name)
        if content is None:
            return PlainTextResponse("no such file", 404)
        kind = TYPES.get(Path(name).suffix, "application/octet-stream")
        # The page states its policy itself; scripts that run in workers have only this one.
        headers = HEADERS if name == PAGE else {**HEADERS, "Content-Security-Policy": WORKER_POLICY}
        tag = sha256(content) if isinstance(content, Path) else hashlib.sha256(content).hexdigest()
        headers |= {"ETag": f'"{tag}"'}
        if request.headers.get("if-none-match") == headers["ETag"]:
            return Response(status_code=304, headers=headers)
        if isinstance(content, bytes):
            return Response(content, media_type=kind, headers=headers)
        return FileResponse(content, media_type=kind, headers=headers)

    return Starlette(
        routes=[Route("/{name:path}", show)],
        # WebAssembly takes a quarter of its room so, and the model's numbers three quarters.
        middleware=[*own_page_only(hosts), Middleware(GZipMiddleware, compresslevel=5)],
    )
