"""A small server of a study: the page and its videos, and answers into an SQLite file. Nothing else leaves or enters.

Raters are nobody's friends until proven otherwise: bodies are bounded before they are read, everything in them is
checked by :mod:`facediff.study.answers`, and only the videos that the study names are served.
"""

from __future__ import annotations

import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.study.answers import (
    LONGEST_CODE,
    MOST_RATERS,
    check_answer,
    check_comments,
    check_language,
    check_study,
    check_token,
    clean,
)
from facediff.study.definition import DATABASE, PAGE_FOLDER, VIDEO_FOLDER, Study, read_study
from facediff.study.page import PAGE
from facediff.study.store import FullError, Store
from facediff.utils.limits import brief
from facediff.utils.plain_files import parse_json

if TYPE_CHECKING:
    import uvicorn
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

MOST_BYTES = 32_768
"""Of a body; the longest comment in any script, and more."""
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class RefusedError(Exception):
    """A request that is answered with an error."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


def make_app(folder: Path, study: Study, store: Store) -> Starlette:
    """The ASGI application.

    Args:
        folder: the study's folder.
        study: what it asks.
        store: where answers go.

    Raises:
        MissingExtraError: if Starlette is not installed.
    """
    try:
        from starlette.applications import Starlette
        from starlette.concurrency import run_in_threadpool
        from starlette.middleware import Middleware
        from starlette.responses import FileResponse, JSONResponse
        from starlette.routing import Route
    except ImportError as error:
        raise MissingExtraError("starlette", "study", "serving a study") from error
    videos = set(study.videos())

    async def page(_: Request) -> Response:
        return FileResponse(
            folder / PAGE_FOLDER / PAGE, media_type="text/html; charset=utf-8", headers={"Cache-Control": "no-cache"}
        )

    async def video(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in videos:
            return JSONResponse({"error": "no such video"}, 404)
        return FileResponse(folder / PAGE_FOLDER / VIDEO_FOLDER / name, headers={"Cache-Control": "max-age=86400"})

    async def about(_: Request) -> Response:
        return JSONResponse({"id": study.id}, headers={"Cache-Control": "no-store"})

    def register(content: dict[str, Any]) -> dict[str, Any]:
        token, language = check_token(content, "request"), check_language(content, "request")
        if content.get("agreed") is not True:
            raise FaceDiffError("request: agreed is not true; expected a rater who has agreed to take part")
        code = clean(content.get("code", ""), "code", "request", LONGEST_CODE)
        return {"number": store.register(token, language, code)}

    def known(content: dict[str, Any]) -> tuple[str, int]:
        token = check_token(content, "request")
        number = store.number(token)
        if number is None:
            raise RefusedError(404, "there is no such rater; begin again")
        return token, number

    def answer(content: dict[str, Any]) -> dict[str, Any]:
        token, number = known(content)
        return {"new": store.save(token, check_answer(content, study, number, "request"))}

    def finish(content: dict[str, Any]) -> dict[str, Any]:
        token, _ = known(content)
        if not store.finish(token, check_comments(content.get("comments", {}), study, "request")):
            raise RefusedError(409, "answers are missing; send them first")
        return {"finished": True}

    def taking(work: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            try:
                content = await read_body(request)
                check_study(content, study, "request")
                return JSONResponse(await run_in_threadpool(work, content))
            except RefusedError as error:
                return JSONResponse({"error": str(error)}, error.status)
            except FullError as error:
                return JSONResponse({"error": str(error)}, 403)
            except FaceDiffError as error:
                stored = isinstance(error.__cause__, OSError) or "sqlite" in type(error.__cause__).__module__
                return JSONResponse({"error": str(error) if not stored else "cannot be stored"}, 503 if stored else 400)

        return endpoint

    return Starlette(
        routes=[
            Route("/", page),
            Route(f"/{VIDEO_FOLDER}/{{name}}", video),
            Route("/api/study", about),
            Route("/api/raters", taking(register), methods=["POST"]),
            Route("/api/answers", taking(answer), methods=["POST"]),
            Route("/api/finish", taking(finish), methods=["POST"]),
        ],
        middleware=[Middleware(WithHeaders)],
    )


class WithHeaders:
    """Adds :data:`HEADERS` to every response."""

    def __init__(self, app: Any) -> None:  # noqa: ANN401 - any ASGI application
        self.app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401 - of ASGI
        """Answer a request."""

        async def answer(message: Any) -> None:  # noqa: ANN401
            if message["type"] == "http.response.start":
                added = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", []), *added]}
            await send(message)

        await self.app(scope, receive, answer)


async def read_body(request: Request) -> dict[str, Any]:
    """The object that a request holds.

    Only JSON is taken: a page of another origin cannot send that without asking, and nobody tells it that it may.

    Raises:
        RefusedError: if it is of another type or too large.
        FaceDiffError: if it is no JSON.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise RefusedError(415, "expected application/json")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MOST_BYTES:
            raise RefusedError(413, f"expected at most {MOST_BYTES} bytes")
    content = parse_json(body, "request", remedy="expected an object")
    if not isinstance(content, dict):
        raise FaceDiffError("request: holds no object; expected one")
    return content


def serve(
    folder: Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    most_raters: int | None = None,
    ready: Callable[[str], object] | None = None,
) -> Store:
    """Serve a study until Ctrl-C; where its answers are.

    Args:
        folder: the study's folder; answers go into ``answers.sqlite`` there.
        host: address to listen at; by default nobody but this machine reaches it.
        port: to listen at; 0 for any free one.
        most_raters: raters that the study takes; no limit if None.
        ready: called with the page's address as soon as it can be opened.

    Raises:
        FaceDiffError: if the study is not complete, or the address cannot be used.
        MissingExtraError: if the server's packages are not installed.
    """
    try:
        import uvicorn
    except ImportError as error:
        raise MissingExtraError("uvicorn", "study", "serving a study") from error

    study = check_folder(folder)
    store = Store(folder / DATABASE, study, most_raters=most_raters or MOST_RATERS)
    app = make_app(folder, study, store)
    try:
        listening = _listen(host, port)
    except (OSError, ValueError) as error:  # a name that is none, or an address in use
        reason = getattr(error, "strerror", None) or brief(error)
        raise FaceDiffError(
            f"--host {host} --port {port}: cannot be listened at ({reason}); choose another port, or 0 for any free one"
        ) from error
    with listening:
        name, number = listening.getsockname()[:2]
        shown = f"[{name}]" if ":" in name else name
        config = uvicorn.Config(
            app, log_level="error", access_log=False, server_header=False, lifespan="off", ws="none"
        )
        server = make_server(config, lambda: ready(f"http://{shown}:{number}/") if ready is not None else None)
        with suppress(KeyboardInterrupt):
            server.run(sockets=[listening])
    return store


def _listen(host: str, port: int) -> socket.socket:
    family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    listening = socket.socket(family[0], socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(family[4])
        listening.listen(128)
    except BaseException:
        listening.close()
        raise
    return listening


def make_server(config: uvicorn.Config, ready: Callable[[], object]) -> uvicorn.Server:
    """A server that calls a function as soon as it takes requests."""
    import uvicorn

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets=sockets)
            ready()

    return Server(config)


def check_folder(folder: Path) -> Study:
    """The study of a folder whose page and videos are all there.

    Raises:
        FaceDiffError: naming the file that is missing.
    """
    study = read_study(folder)
    page = folder / PAGE_FOLDER
    for path in (page / PAGE, *(page / VIDEO_FOLDER / name for name in study.videos())):
        if not path.is_file():
            raise FaceDiffError(f"{path}: no such file; run `facediff study make` again, which continues")
    return study
