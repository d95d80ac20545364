"""A small server of a study: the page and its videos, and answers into an SQLite file. Nothing else leaves or enters.

Requests are not trusted: their size is bounded before they are read, their content is checked by
:mod:`facediff.study.answers`, and only the study's videos are served.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facediff.errors import FaceDiffError
from facediff.study.answers import (
    MOST_RATERS,
    Answer,
    RatingsEnd,
    Registration,
    check_answer,
    check_comments,
    check_study,
    clean,
)
from facediff.study.definition import DATABASE, PAGE_FOLDER, VIDEO_FOLDER, Study, read_study
from facediff.study.page import PAGE
from facediff.study.store import AnswerStore, FullError
from facediff.utils.records import read_record
from facediff.utils.server import (
    LOOPBACK,
    RefusedError,
    names_of,
    own_page_only,
    read_body,
    require_server,
    run_server,
)

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

MOST_BYTES = 32_768
"""Of a body; the longest comment in any script, and more."""


def make_app(
    folder: Path,
    study: Study,
    store: AnswerStore,
    *,
    hosts: tuple[str, ...] | None = LOOPBACK,
    public_name: str | None = None,
) -> Starlette:
    """The ASGI application."""
    from starlette.applications import Starlette
    from starlette.concurrency import run_in_threadpool
    from starlette.responses import FileResponse, JSONResponse
    from starlette.routing import Route

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
        rater = read_record(Registration, content, "request", strict=False)
        return {"number": store.register(rater.rater, rater.language, clean(rater.code))}

    def number_of(token: object) -> int:
        number = store.number(str(token))
        if number is None:
            raise RefusedError(404, "there is no such rater; begin again")
        return number

    def answer(content: dict[str, Any]) -> dict[str, Any]:
        record = read_record(Answer, content, "request", strict=False)
        check_answer(record, study, number_of(content.get("rater")), "request")
        return {"new": store.save(content["rater"], record)}

    def finish(content: dict[str, Any]) -> dict[str, Any]:
        end = read_record(RatingsEnd, content, "request", strict=False)
        number_of(end.rater)
        if not store.finish(end.rater, check_comments(end.comments, study, "request")):
            raise RefusedError(409, "answers are missing; send them first")
        return {"finished": True}

    def taking(work: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            try:
                content = await read_body(request, MOST_BYTES)
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
        middleware=own_page_only(hosts, public_name),
    )


def serve(
    folder: Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    name: str | None = None,
    most_raters: int | None = None,
    ready: Callable[[str], object] | None = None,
) -> AnswerStore:
    """Serve a study until Ctrl-C; the store of its answers.

    ``name`` is the host name of a web server in front: requests under other names are refused. ``ready`` is called with
    the page's address as soon as it can be opened.
    """
    require_server("serving a study")
    study = check_folder(folder)
    store = AnswerStore(folder / DATABASE, study, most_raters=most_raters or MOST_RATERS)
    with suppress(KeyboardInterrupt):
        run_server(
            lambda _: make_app(folder, study, store, hosts=names_of(host), public_name=name),
            host=host,
            port=port,
            ready=ready,
        )
    return store


def check_folder(folder: Path) -> Study:
    """The study of a folder with its page and videos."""
    study = read_study(folder)
    page = folder / PAGE_FOLDER
    for path in (page / PAGE, *(page / VIDEO_FOLDER / name for name in study.videos())):
        if not path.is_file():
            raise FaceDiffError(f"{path}: no such file; run `facediff study make` again, which continues")
    return study
