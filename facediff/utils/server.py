"""Small servers of a page on this machine: bounded bodies, strict headers, and no foreign pages.

For the user study and for picking landmarks; both are ASGI applications of Starlette, run by uvicorn.
"""

from __future__ import annotations

import importlib
import re
import socket
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from facediff.errors import FaceDiffError, needs_extra
from facediff.utils.limits import brief
from facediff.utils.plain_files import parse_json

if TYPE_CHECKING:
    import uvicorn
    from starlette.middleware import Middleware
    from starlette.requests import Request

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Names by which only this machine reaches itself."""
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class RefusedError(Exception):
    """A request that is answered with an error of a status."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


def names_of(host: str) -> tuple[str, ...] | None:
    """The names under which a page is served that listens at an address; None if any may be right."""
    if host in ("", "0.0.0.0", "::"):  # noqa: S104 - a person has told the command so
        return None
    return tuple(dict.fromkeys((*LOOPBACK, host)))


_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[\w.-]+)(:\d{1,5})?")


def is_own_page(host: str, origin: str | None, hosts: Collection[str] | None, public_name: str | None = None) -> bool:
    """Whether a request is for a server under one of its own names, and no page from elsewhere sends it.

    A page from elsewhere can let its own name point to this machine; its requests then carry that name as their host.

    Args:
        host: of the request, with its port.
        origin: of the page with the script that sends it; None if none does.
        hosts: as of :func:`names_of`.
        public_name: name under which a web server in front offers the page, by HTTP or HTTPS.
    """
    names = {name.lower() for name in (*(hosts or LOOPBACK), *([public_name] if public_name else []))}
    if host and not _HOST.fullmatch(host):  # libraries take other parts of a:1.b and a\@b for the name
        return False
    try:
        name, page = urlsplit(f"//{host}").hostname or "", urlsplit(origin or "")
        public = public_name is not None and page.scheme in ("http", "https") and page.hostname == public_name.lower()
    except ValueError:
        return False
    if origin is not None and not public and origin.lower() != f"http://{host.lower()}":
        return False
    return (hosts is None and public_name is None) or name in names


class OwnPages:
    """Adds :data:`HEADERS` to every response of an ASGI application, and refuses what :func:`is_own_page` refuses."""

    def __init__(self, app: Any, hosts: Collection[str] | None, public_name: str | None = None) -> None:  # noqa: ANN401
        self.app, self.hosts, self.public_name = app, hosts, public_name

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401 - of ASGI
        """Answer a request."""
        from starlette.responses import JSONResponse

        async def answer(message: Any) -> None:  # noqa: ANN401
            if message["type"] == "http.response.start":
                added = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", []), *added]}
            await send(message)

        headers = {name.lower(): value.decode("latin-1") for name, value in scope.get("headers", [])}
        app = self.app
        if not is_own_page(headers.get(b"host", ""), headers.get(b"origin"), self.hosts, self.public_name):
            app = JSONResponse({"error": "only the page that this server shows may ask it"}, 403)
        await app(scope, receive, answer)


async def read_body(request: Request, most_bytes: int) -> dict[str, Any]:
    """The object that a request holds.

    Only JSON is taken: a page of another origin cannot send that without permission, which it never gets.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise RefusedError(415, "expected application/json")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > most_bytes:
            raise RefusedError(413, f"expected at most {most_bytes} bytes")
    content = parse_json(body, "request", remedy="expected an object")
    if not isinstance(content, dict):
        raise FaceDiffError("request: holds no object; expected one")
    return content


def own_page_only(hosts: Collection[str] | None, public_name: str | None = None) -> list[Middleware]:
    """Middleware of an application: :class:`OwnPages`, which takes these arguments."""
    from starlette.middleware import Middleware

    return [Middleware(OwnPages, hosts=hosts, public_name=public_name)]


def require_server(purpose: str, names: Collection[str] = ("starlette", "uvicorn"), extra: str = "study") -> None:
    """Refuse to begin where the server's packages are not installed."""
    for name in names:
        with needs_extra(name, extra, purpose):
            importlib.import_module(name)


def run_server(
    app_of: Callable[[Callable[[], None]], Any],
    *,
    host: str,
    port: int,
    ready: Callable[[str], object] | None = None,
) -> bool:
    """Serve an application until it is stopped; whether it was. Ctrl-C comes out as such.

    Args:
        app_of: makes the ASGI application; is given a function that stops the server after the present answer.
        host: address to listen at.
        port: 0 for any free one.
        ready: called with the page's address as soon as it can be opened.
    """
    import uvicorn

    stopped: list[bool] = []

    def stop() -> None:
        stopped.append(True)
        server.should_exit = True

    app = app_of(stop)
    try:
        listening = listen(host, port)
    except (OSError, ValueError) as error:  # a name that is none, or an address in use
        raise FaceDiffError(
            f"--host {host} --port {port}: cannot be listened at ({brief(error)}); choose another port, or 0 for any "
            f"free one"
        ) from error
    with listening:
        name, number = listening.getsockname()[:2]
        page = f"http://[{name}]:{number}/" if ":" in name else f"http://{name}:{number}/"
        config = uvicorn.Config(
            app, log_level="error", access_log=False, server_header=False, lifespan="off", ws="none"
        )
        server = make_server(config, lambda: ready(page) if ready is not None else None)
        server.run(sockets=[listening])
    return bool(stopped)


def listen(host: str, port: int) -> socket.socket:
    """A socket that others connect to."""
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    return socket.create_server(address, family=family, backlog=512)


def make_server(config: uvicorn.Config, ready: Callable[[], object]) -> uvicorn.Server:
    """A server that calls a function as soon as it takes requests."""
    import uvicorn

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets=sockets)
            ready()

    return Server(config)
