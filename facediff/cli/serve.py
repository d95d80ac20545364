"""``facediff serve``: an exported model on a page that animates in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from facediff.cli.options import PageServer
from facediff.cli.process import tell
from facediff.errors import FaceDiffError
from facediff.utils.files import example_recordings
from facediff.utils.hub import is_audio2face, model_or_bundled
from facediff.utils.option import Option
from facediff.utils.server import names_of, require_server, run_server


def serve(
    model: Annotated[Path | None, Option(metavar="FOLDER", reads=True)] = None,
    *,
    output: Annotated[Path | None, Option(also="-o", metavar="OUT", writes="folder", new=True)] = None,
    runtime: Annotated[Path | None, Option(metavar="PACKAGE", reads=True)] = None,
    recordings: Annotated[list[Path] | None, Option(metavar="FILE", many=True, reads=True)] = None,
    page: PageServer,
) -> None:
    """Serve a page that animates recordings and the microphone in the browser, until Ctrl-C.

    Everything is computed in the page, by WebAssembly; no sound leaves the machine. ONNX Runtime for browsers (20 MB)
    is fetched from the npm registry once, and kept in facediff's cache.

    For example:
      facediff serve --open
      facediff serve puppet-onnx -o site      # a folder for any web server

    Args:
        model: folder of `facediff export-model` (default: the model that comes with facediff)
        output: folder to write in place of serving: page, model and ONNX Runtime, for any web server
        runtime: npm's package onnxruntime-web (.tgz) or a folder with its files, for machines without network
        recordings: that the page offers to try the model with (default: three that come with facediff)
        page: where it is served.
    """
    if output is None:
        require_server("serving a page", extra="serve")
    from facediff.runtime.folder import read_folder
    from facediff.runtime.onnxruntime_web import web_runtime
    from facediff.runtime.site import make_app, make_site, write_site

    model = model_or_bundled(model)
    if is_audio2face(model):
        raise FaceDiffError(f"{model}: the page has no Audio2Face-3D; animate with it by `facediff animate` or `live`")
    read_folder(model)  # before anything is fetched
    site = make_site(model, web_runtime(runtime, say=tell), recordings or example_recordings())
    if output is not None:
        size = write_site(site, output)
        tell(f"wrote {output}: {size / 1e6:.1f} MB; offer it by any web server, e.g. python -m http.server -d {output}")
        return
    announce = page.announce(
        f"animates with {model}; Ctrl-C ends it", "open the page; without https it gets no microphone"
    )
    port = 8010 if page.port is None else page.port
    run_server(lambda _: make_app(site, names_of(page.host)), host=page.host, port=port, ready=announce)
