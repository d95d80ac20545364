"""Landmarks that a person picks: what the server takes, and the page in a real browser."""

from __future__ import annotations

import json
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import uvicorn

from facediff.editing.landmarks import NAMES, read_landmarks
from facediff.export.viewer.picking import MOST_BYTES, Picking, make_app, picking_page
from facediff.mesh import Mesh
from facediff.utils.server import LOOPBACK, names_of
from tests.fakes.chromium import Chromium, Page
from tests.fakes.heads import LONG, lower_face, nearest_vertices, talking, talking_second
from tests.fakes.serving import ask, servers
from tests.fakes.small_face import LANDMARKS, build_face, build_rig

FACE, MARKS = build_face(), LANDMARKS


def other_face() -> Mesh:
    """Another speaker's face in millimetres, whose vertices and triangles run backwards."""
    count = len(FACE.vertices)
    faces = count - 1 - FACE.faces[::-1, :]
    return Mesh(1000.0 * build_rig(LONG).neutral[::-1], faces.astype(np.int32))


def own(name: str) -> int:
    """The vertex of a name on the other face."""
    return len(FACE.vertices) - 1 - MARKS[name]


Serve = Callable[[str], str]


@pytest.fixture
def picking(tmp_path: Path) -> Picking:
    return Picking(talking(), other_face(), ("mine", "<b>other</b>\udcff.obj"), tmp_path / "map.landmarks.json")


@pytest.fixture
def serve(picking: Picking) -> Iterator[Serve]:
    """Serves a page on a free port until it is stopped; gives its address without a slash at its end."""
    with servers() as running:

        def start(page: str) -> str:
            stops: list[uvicorn.Server] = []
            url, server = running.start(
                make_app(picking, page, LOOPBACK, lambda: setattr(stops[0], "should_exit", True))
            )
            stops.append(server)
            return url

        yield start


def ask_until_it_ends(url: str) -> None:
    while True:
        ask(url)
        time.sleep(0.01)


def pairs(**changed: object) -> dict[str, object]:
    """What the page sends."""
    rows = [{"name": name, "source": MARKS[name], "target": own(name)} for name in list(NAMES)[:4]]
    counts = {"source_vertices": 1008, "target_vertices": 1008}
    return {"format": "facediff landmarks 1", **counts, "landmarks": rows, **changed}


def test_what_the_page_sends_is_saved_and_ends_the_server(serve: Serve, picking: Picking) -> None:
    address = serve("the page")
    assert ask(f"{address}/")[::2] == (200, b"the page")
    status, _, answer = ask(f"{address}/api/landmarks", pairs(), Origin=address)
    assert (status, json.loads(answer)) == (200, {"saved": 4, "file": "map.landmarks.json"})
    found = read_landmarks(picking.file)
    assert nearest_vertices(found) == [[MARKS[name], own(name)] for name in list(NAMES)[:4]]
    with pytest.raises(OSError, match="refused|reset|closed"):
        ask_until_it_ends(f"{address}/")


WRONG: dict[str, object] = {
    "no object": [1],
    "another format": pairs(format="facediff landmarks 9"),
    "too few pairs": pairs(landmarks=[{"name": "a", "source": 1, "target": 2}]),
    "a vertex that does not exist": pairs(landmarks=[{"name": "a", "source": 1, "target": 1008}] * 3),
    "another mesh": pairs(target_vertices=1007),
    "weights that are none": pairs(
        landmarks=[{"name": "a", "source": 1, "target": {"corners": [1, 2, 3], "weights": [1e300, 0, 0]}}] * 3
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_the_page_does_not_send_is_refused_and_not_saved(name: str, serve: Serve, picking: Picking) -> None:
    address = serve("the page")
    assert ask(f"{address}/api/landmarks", WRONG[name])[0] == 400
    assert not picking.file.exists()
    assert ask(f"{address}/")[0] == 200


def test_other_pages_other_bodies_and_other_paths_are_refused(serve: Serve, picking: Picking) -> None:
    address = serve("the page")
    url, port = f"{address}/api/landmarks", address.rpartition(":")[2]
    for host in ("evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", "[::1", ""):
        assert ask(f"{address}/", Host=host)[0] in (400, 403)
        assert ask(url, pairs(), Host=host)[0] in (400, 403)
    for origin in ("http://evil.example", "null", f"https://127.0.0.1:{port}", "http://127.0.0.1:1"):
        assert ask(url, pairs(), Origin=origin)[0] == 403
    assert ask(f"{address}/", Host=f"localhost:{port}")[0] == 200
    assert ask(url, raw=b"{")[0] == 400
    assert ask(url, raw=b"\xff\xfe{")[0] == 400
    assert ask(url, raw=b'{"format": NaN}')[0] == 400
    assert ask(url, raw=b"[" + b"0," * (MOST_BYTES // 2) + b"0]")[0] == 413
    assert ask(url, raw=b"{}", **{"Content-Type": "text/plain"})[0] == 415
    assert ask(url)[0] == 405
    for path in ("api", "map.landmarks.json", "api/../../etc/passwd", "..%2f..%2fetc%2fpasswd", "docs", "openapi.json"):
        assert ask(f"{address}/{path}")[0] == 404
    assert not picking.file.exists()
    with urllib.request.urlopen(f"{address}/", timeout=20) as response:  # noqa: S310 - our own server
        assert response.headers["X-Frame-Options"] == "DENY"
        assert response.headers["Server"] is None
    assert names_of("0.0.0.0") is None  # noqa: S104
    assert "10.0.0.7" in (names_of("10.0.0.7") or ())


def test_a_mesh_that_the_alignment_has_shrunk_is_shown_as_in_its_file(tmp_path: Path) -> None:
    """Its mouth was found in its place, and then the alignment made a dot of 5 mm of it."""
    head, source = lower_face(), talking_second()
    mask = Mesh(head.vertices, head.faces.astype(np.int32))
    page = "".join(picking_page(Picking(source, mask, ("a", "b"), tmp_path / "map.json")))
    *_, extent = re.findall(r'"whole": ?\{.*?"extent": ?\[([^]]*)\]', page)  # of the target
    assert max(map(float, extent.split(","))) > 500 * np.ptp(source.template, axis=0).max() * 0.9


# In a browser.


def click(page: Page, name: str, vertex: int) -> None:
    """Click where a vertex of one of the faces is seen."""
    part = f"facediffPicking.positions('{name}').slice({3 * vertex}, {3 * vertex + 3})"
    x, y = page.evaluate(f"facediffPicking.seen('{name}', {part})")
    for kind in ("mousePressed", "mouseReleased"):
        page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)


def choose(page: Page, name: str) -> None:
    page.evaluate(f"document.querySelectorAll('#list button')[{list(NAMES).index(name)}].click()")


def places(page: Page, side: str) -> dict[str, np.ndarray]:
    """Where the points are in the mesh's own coordinates, by name."""
    rest = talking().template if side == "source" else other_face().vertices
    return {
        point["name"]: np.array(point[side]["weights"]) @ rest[point[side]["corners"]]
        for point in page.evaluate("facediffPicking.points")
        if point[side]
    }


@pytest.mark.slow
def test_points_are_picked_mirrored_taken_back_and_saved(serve: Serve, picking: Picking, browser: Chromium) -> None:
    page = browser.open(f"{serve(''.join(picking_page(picking)))}/", width=1100, height=800)
    page.wait_for("window.facediffPicking && document.body.classList.contains('ready')")
    assert page.evaluate("document.querySelector('#target .file').textContent") == "<b>other</b>\udcff.obj"
    assert page.evaluate("document.getElementById('save').disabled")
    # The face's points are found by its shape, so that they lie near its vertices.
    found = places(page, "source")
    assert len(found) > 5
    for name, place in found.items():
        assert np.linalg.norm(place - talking().template[MARKS[name]]) < 0.005, name
    rest = other_face().vertices
    for name in ("nose_tip", "mouth_corner_left", "eye_outer_left"):
        choose(page, name)
        click(page, "target", own(name))
    found = places(page, "target")
    assert set(found) == {"nose_tip", "mouth_corner_left", "eye_outer_left"}
    # A pixel of the window is half a millimetre; the rim of an eye may hide what is behind it.
    assert all(np.linalg.norm(place - rest[own(name)]) < 2.0 for name, place in found.items())
    # A mirror image lies where the same point of the other side is.
    choose(page, "mouth_corner_left")
    page.press("m")
    assert np.linalg.norm(places(page, "target")["mouth_corner_right"] - rest[own("mouth_corner_right")]) < 2.0
    page.press("u")
    assert "mouth_corner_right" not in places(page, "target")
    choose(page, "mouth_corner_left")
    page.press("m")
    # A point without a name, by keys alone: to the face, a cross, and Enter.
    page.press("f")
    for side in ("source", "target"):
        page.evaluate(f"document.querySelector('#{side} .face').focus()")
        for key in ("Enter", "ArrowDown", "Enter"):
            page.press(key)
    assert {"point 1"} <= set(places(page, "source")) & set(places(page, "target"))
    page.press("f")
    page.press("Delete")
    assert len(page.evaluate("facediffPicking.points")) == len(NAMES) + 1
    page.resize(375, 740)
    assert page.evaluate("document.documentElement.scrollWidth") == 375
    # A graphics card that comes back shows the faces without a move, and two quick clicks save once.
    page.evaluate(
        "window.view = document.querySelector('#target canvas'), window.card = view.getContext('webgl2')"
        ".getExtension('WEBGL_lose_context'), card.loseContext(), null"
    )
    page.wait_for("view.getContext('webgl2').isContextLost()")
    page.evaluate(
        "(window.drawn = 0, window.paper = view.getContext('webgl2'), paper.drawElements = function (...given) {"
        " drawn += 1; WebGL2RenderingContext.prototype.drawElements.apply(this, given); }, card.restoreContext(), null)"
    )
    page.wait_for("window.drawn")
    page.evaluate(
        "(window.sent = 0, window.fetched = window.fetch,"
        " window.fetch = (...given) => (sent += 1, fetched(...given)), null)"
    )
    page.evaluate("(document.getElementById('save').click(), document.getElementById('save').click())")
    page.wait_for("facediffPicking.saved")
    assert page.evaluate("sent") == 1
    assert page.problems == page.evaluate("facediffPicking.errors") == []
    assert {url.split("/")[2] for url in page.requests if url.startswith("http")} == {page.evaluate("location.host")}
    saved = read_landmarks(picking.file)
    assert set(saved.names) == {"nose_tip", "mouth_corner_left", "mouth_corner_right", "eye_outer_left", "point 1"}
    for name, point in zip(saved.names, saved.target.points(rest), strict=True):
        if name != "point 1":
            assert np.linalg.norm(point - rest[own(name)]) < 2.0
    page.close()
