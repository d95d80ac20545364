"""``facediff blendshapes``: from the puppet's shapes to a table and back, and what it says when something is wrong."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from facediff.animation import Animation, write_archive
from facediff.cli.app import main
from facediff.editing.blendshapes import solve
from facediff.editing.controls.procedural import move_head
from facediff.editing.shapes import read_shapes
from facediff.export import pictures
from facediff.mesh import read_mesh
from facediff.spaces import Space
from facediff.spaces.arkit import ARKIT
from facediff.spaces.visemes import visemes
from tests.fakes.small_face import small_shapes, write_small_shapes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("shapes") / "puppet"
    write_small_shapes(made)
    return made


@pytest.fixture(scope="module")
def known() -> dict[str, np.ndarray]:
    frames = np.arange(12)
    return {
        "jawOpen": 0.5 + 0.4 * np.sin(frames / 2),
        "eyeBlinkLeft": (frames % 5 == 0) * 1.0,
        "mouthPucker": frames / 15,
    }


@pytest.fixture(scope="module")
def animation(folder: Path, known: dict[str, np.ndarray]) -> Animation:
    mesh = read_mesh(folder / "neutral.obj")
    moved = sum(
        (read_mesh(folder / f"{name}.obj").vertices - mesh.vertices) * weights[:, None, None]
        for name, weights in known.items()
    )
    return Animation(
        "a", (mesh.vertices + moved).astype(np.float32), mesh.vertices.astype(np.float32), 25.0, faces=mesh.faces
    )


@pytest.fixture
def archive(animation: Animation, tmp_path: Path) -> Path:
    write_archive(tmp_path / "take.npz", animation)
    return tmp_path / "take.npz"


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_shapes_are_arkits(folder: Path) -> None:
    neutral, faces, shapes = small_shapes()
    made = read_shapes(folder, neutral)
    assert set(made.names) == set(shapes) == set(ARKIT)
    assert made.still == ("tongueOut",)
    assert made.extra == ()
    assert np.array_equal(read_mesh(folder / "neutral.obj").faces, faces)
    # Left shapes move the left half only (x points to the face's left), and mirror the right ones.
    left, right = (made.deltas[made.names.index(f"mouthSmile{side}")] for side in ("Left", "Right"))
    assert np.abs(left[neutral[:, 0] < -0.0051]).max() < 1e-8
    assert np.abs(right[neutral[:, 0] > 0.0051]).max() < 1e-8
    assert np.abs(left).max() == pytest.approx(np.abs(right).max(), rel=1e-3)


def test_a_table_of_known_weights(
    folder: Path, archive: Path, known: dict[str, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "weights.csv"
    words = ["blendshapes", str(archive), "-o", str(out), "--shapes", str(folder), "--smoothness", "0"]
    assert main([*words, "--show", str(tmp_path / "check.png")]) == 0
    table = rows(out)
    for name, weights in known.items():
        assert [float(row[name[0].upper() + name[1:]]) for row in table[: len(weights)]] == pytest.approx(
            weights, abs=1e-3
        )
    assert [row["Timecode"] for row in table[:2]] == ["00:00:00:00.000", "00:00:00:02.400"]
    said = capsys.readouterr().out
    assert "absent, so that" not in said
    assert "move no vertex, so that their weights stay 0: tongueOut" in said
    assert "residual: median" in said
    assert (tmp_path / "check.png").read_bytes()[:4] == b"\x89PNG"
    assert json.loads((tmp_path / "weights.json").read_text())["still"] == ["tongueOut"]


def test_the_picture_of_the_worst_frame_leaves_the_heads_motion_out(
    folder: Path, animation: Animation, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[pictures.DrawnFace] = []
    monkeypatch.setattr(pictures, "_draw", lambda path, panels: drawn.extend(panels))
    shapes = read_shapes(folder, animation.template)
    turns = np.full((len(animation.vertices), 3), 0.3)
    turned = move_head(animation, turns, 0 * turns)
    weights = solve(turned, shapes)
    pictures.draw_worst_frame(Path("worst.png"), turned, shapes, weights)
    (truth, built, residual) = drawn
    assert np.linalg.norm(truth.vertices - built.vertices, axis=1).max() < 1e-3
    assert f"0 to {weights.residual_max_mm[weights.residual_rms_mm.argmax()]:.2g} mm" in residual.label


def test_shapes_of_another_topology_are_carried(
    folder: Path, archive: Path, known: dict[str, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The shapes' vertices in another order are another topology."""
    order = np.random.default_rng(0).permutation(1008)
    other = tmp_path / "other"
    other.mkdir()
    for name in ("neutral", *known):
        mesh = read_mesh(folder / f"{name}.obj")
        points = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in 100 * mesh.vertices[order])
        triangles = "".join(f"f {a} {b} {c}\n" for a, b, c in np.argsort(order)[mesh.faces] + 1)
        (other / f"{name}.obj").write_text(points + triangles)
    out = tmp_path / "weights.csv"
    words = ["blendshapes", str(archive), "-o", str(out), "--shapes", str(other), "--smoothness", "0"]
    assert main(words) == 2
    assert "another order" in capsys.readouterr().err
    assert not out.exists()
    assert main([*words, "--carry"]) == 0
    table = rows(out)
    for name, weights in known.items():
        assert [float(row[name[0].upper() + name[1:]]) for row in table[: len(weights)]] == pytest.approx(
            weights, abs=1e-3
        )


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["take.npz", "-o", "w.csv"], "expected an animation, -o and --shapes"),
        (["nan.npy", "-o", "w.csv", "--shapes", "shapes", "--frame-rate", "25"], "frame 1 holds NaN"),
        (["small.npy", "-o", "w.csv", "--shapes", "shapes", "--frame-rate", "25"], "1008 vertices and the"),
        (["take.npz", "-o", "w.csv", "--shapes", "shapes", "--bounds", "1", "0"], "bounds 1 to 0"),
        (["take.npz", "-o", "w.csv", "--shapes", "shapes", "--region", "lips"], 'there is no region "lips"'),
        (["take.npz", "-o", "mine.csv", "--shapes", "shapes"], "mine.json: is a file that facediff did not write"),
        (["bare.npy", "-o", "w.csv", "--shapes", "shapes", "--frame-rate", "25", "--show", "a.png"], "without a mesh"),
        (["take.npz", "--write-puppet-shapes", "new"], "has no effect with animation; omit it"),
        (["--write-puppet-shapes", "shapes"], "shapes: is not empty"),
        (["--write-puppet-shapes", "new", "--identity", "F9"], 'no speaker "F9": known are'),
    ],
)
def test_what_is_wrong_is_one_sentence_and_nothing_is_written(
    words: list[str],
    says: str,
    folder: Path,
    archive: Path,
    animation: Animation,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "shapes").symlink_to(folder)
    spoilt = animation.vertices[:3].copy()
    spoilt[1, 2] = np.nan
    for name, array in (
        ("nan", spoilt),
        ("empty", animation.vertices[:0]),
        ("small", animation.vertices[:, :99]),
        ("bare", animation.vertices),
    ):
        np.save(tmp_path / f"{name}.npy", array)
    (tmp_path / "mine.json").write_text("{}")
    before = sorted(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    assert main(["blendshapes", *words]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "mine.json").read_text() == "{}"


def test_shapes_without_a_column_take_no_motion_from_those_of_the_table(
    folder: Path, archive: Path, known: dict[str, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(folder, mine)
    for name in ("mouthOpen", "viseme_aa"):  # as avatars have them: the jaw once more
        shutil.copy(folder / "jawOpen.obj", mine / f"{name}.obj")
    words = [str(archive), "--shapes", str(mine), "--smoothness", "0", "--sparsity", "0"]
    assert main(["blendshapes", *words, "-o", str(tmp_path / "a.csv")]) == 0
    assert "left out" in capsys.readouterr().out
    assert main(["export", *words[:3], "-o", str(tmp_path / "b.csv")]) == 0
    for table, within in (("a.csv", 2e-3), ("b.csv", 0.1)):
        jaw = [float(row["JawOpen"]) for row in rows(tmp_path / table)[:12]]
        assert jaw == pytest.approx(known["jawOpen"], abs=within)
    assert main(["blendshapes", *words, "-o", str(tmp_path / "p.csv"), "--plain"]) == 0
    assert "viseme_aa" in rows(tmp_path / "p.csv")[0]


def test_tracks_of_visemes_from_the_weights(
    folder: Path, archive: Path, known: dict[str, np.ndarray], tmp_path: Path
) -> None:
    words = [str(archive), "--shapes", str(folder), "--tracks", "vrm"]
    assert main(["blendshapes", *words, "-o", str(tmp_path / "a.csv"), "--smoothness", "0", "--sparsity", "0"]) == 0
    table = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    assert table.dtype.names[:7] == ("time", "A", "I", "U", "E", "O", "Blink")
    space = Space("arkit", tuple(name for name in known if name in ARKIT))
    values = np.stack([known[name] for name in space.channels], axis=1)
    assert table["A"] == pytest.approx(visemes(values, space, "vrm")[0][:, 0], abs=2e-3)
    assert main(["export", *words, "-o", str(tmp_path / "b.csv")]) == 0
    assert (tmp_path / "b.csv").read_text().startswith("time,A,I,U,E,O,Blink,Blink_L,Blink_R,")
    assert main(["export", str(archive), "-o", str(tmp_path / "b.ply"), "--tracks", "vrm"]) == 2
