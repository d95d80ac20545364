"""A small Hugging Face hub on the loopback: what ``huggingface_hub`` asks of it to send and to fetch a model."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.parse import unquote, urlsplit

NAME = r"(?P<name>[\w.-]+/[\w.-]+)"


@dataclass
class Repository:
    """A model on the hub: its files at each commit, the newest last."""

    commits: list[tuple[str, dict[str, bytes]]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)
    gated: bool = False
    private: bool = False

    def commit(self, changes: dict[str, bytes]) -> str:
        files = {**(self.commits[-1][1] if self.commits else {}), **changes}
        name = hashlib.sha1(repr((len(self.commits), sorted(files.items()))).encode()).hexdigest()  # noqa: S324
        self.commits.append((name, files))
        return name

    def at(self, revision: str) -> tuple[str, dict[str, bytes]] | None:
        if revision == "main" and self.commits:
            return self.commits[-1]
        wanted = self.tags.get(revision, revision)
        return next((each for each in self.commits if each[0] == wanted), None)


@dataclass
class FakeHub:
    """The hub's state, and what was asked of it."""

    address: str = ""
    models: dict[str, Repository] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    sizes: dict[str, int] = field(default_factory=dict)  # what it says of a file, where that is not its true size
    cards: list[str] = field(default_factory=list)  # whose metadata it was asked to check
    token: str = "hf_of_a_test"  # noqa: S105 - the fake's own

    def answer(self, method: str, path: str, body: bytes, allowed: bool) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and content."""
        if found := re.fullmatch(rf"/{NAME}/resolve/(?P<revision>[^/]+)/(?P<file>.+)", path):
            return self.file(found["name"], unquote(found["revision"]), unquote(found["file"]))
        if method == "POST" and not allowed:
            return self.error(401, "", "Invalid username or password.")
        if path == "/api/validate-yaml":
            self.cards.append(json.loads(body)["content"])
            return self.json({"errors": [], "warnings": []})
        if method == "POST" and path == "/api/repos/create":
            wanted = json.loads(body)
            name = f"{wanted['organization']}/{wanted['name']}" if wanted.get("organization") else wanted["name"]
            if name in self.models:
                return self.error(409, "", "exists")
            self.models[name] = Repository(private=bool(wanted.get("private")))
            self.models[name].commit({".gitattributes": b""})
            return self.json({"url": f"{self.address}/{name}", "name": name, "id": name})
        if found := re.fullmatch(rf"/api/models/{NAME}/(?P<what>\w+)/(?P<rest>.+)", path):
            model = self.models.get(found["name"])
            if model is None:
                return self.error(404, "RepoNotFound", "Repository not found")
            return getattr(self, f"on_{found['what']}")(model, unquote(found["rest"]), body)
        if found := re.fullmatch(rf"/api/models/{NAME}", path):
            model = self.models.get(found["name"])
            return self.on_revision(model, "main", body) if model else self.error(404, "RepoNotFound", "not found")
        return self.error(404, "", f"the fake does not know {method} {path}")

    def file(self, name: str, revision: str, file: str) -> tuple[int, dict[str, str], bytes]:
        model = self.models.get(name)
        if model is None:
            return self.error(404, "RepoNotFound", "Repository not found")
        if model.gated:
            return self.error(403, "GatedRepo", "Access to this model is restricted")
        found = model.at(revision)
        if found is None:
            return self.error(404, "RevisionNotFound", "Invalid rev id")
        if file not in found[1]:
            return self.error(404, "EntryNotFound", "Entry not found")
        content = found[1][file]
        etag = hashlib.sha1(content).hexdigest()  # noqa: S324
        return (
            200,
            {"X-Repo-Commit": found[0], "ETag": f'"{etag}"', "Content-Type": "application/octet-stream"},
            content,
        )

    def on_revision(self, model: Repository, rest: str, body: bytes) -> tuple[int, dict[str, str], bytes]:
        found = model.at(rest)
        if found is None:
            return self.error(404, "RevisionNotFound", "Invalid rev id")
        files = [{"rfilename": name, "size": self.size(name, data)} for name, data in found[1].items()]
        name = next(key for key, value in self.models.items() if value is model)
        return self.json({"id": name, "modelId": name, "sha": found[0], "siblings": files, "private": model.private})

    def on_tree(self, model: Repository, rest: str, body: bytes) -> tuple[int, dict[str, str], bytes]:
        found = model.at(rest.strip("/"))
        if found is None:
            return self.error(404, "RevisionNotFound", "Invalid rev id")
        entries = [
            {"type": "file", "path": name, "size": self.size(name, data), "oid": hashlib.sha1(data).hexdigest()}  # noqa: S324
            for name, data in found[1].items()
        ]
        return self.json(entries)

    def on_preupload(self, model: Repository, rest: str, body: bytes) -> tuple[int, dict[str, str], bytes]:
        files = json.loads(body)["files"]
        answers = [{"path": file["path"], "uploadMode": "regular", "shouldIgnore": False} for file in files]
        return self.json({"files": answers})

    def on_commit(self, model: Repository, rest: str, body: bytes) -> tuple[int, dict[str, str], bytes]:
        changes = {}
        for line in body.splitlines():
            entry = json.loads(line)
            if entry["key"] == "file":
                changes[entry["value"]["path"]] = base64.b64decode(entry["value"]["content"])
        name = next(key for key, value in self.models.items() if value is model)
        commit = model.commit(changes)
        answer = {"success": True, "commitUrl": f"{self.address}/{name}/commit/{commit}", "commitOid": commit}
        return self.json(answer)

    def size(self, name: str, data: bytes) -> int:
        return self.sizes.get(name, len(data))

    @staticmethod
    def json(content: object) -> tuple[int, dict[str, str], bytes]:
        return 200, {"Content-Type": "application/json"}, json.dumps(content).encode()

    @staticmethod
    def error(status: int, code: str, message: str) -> tuple[int, dict[str, str], bytes]:
        headers = {"X-Error-Code": code, "X-Error-Message": message, "Content-Type": "application/json"}
        return status, headers, json.dumps({"error": message}).encode()


@contextmanager
def fake_hub() -> Iterator[FakeHub]:
    """A hub that runs as long as the context lasts."""
    hub = FakeHub()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def respond(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            path = urlsplit(self.path).path
            hub.asked.append(f"{self.command} {path}")
            allowed = self.headers.get("Authorization") == f"Bearer {hub.token}"
            status, headers, content = hub.answer(self.command, path, body, allowed)
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            size = hub.sizes.get(path.rpartition("/")[2], len(content)) if self.command == "HEAD" else len(content)
            self.send_header("Content-Length", str(size))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(content)

        do_GET = do_HEAD = do_POST = do_PUT = respond  # noqa: N815 - the standard library's names

        def log_message(self, *words: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    hub.address = f"http://127.0.0.1:{server.server_port}"
    Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
