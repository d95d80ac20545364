"""The notebooks run from top to bottom, with a small corpus and a few steps of training, and hold small outputs."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import nbformat
import pytest
from jupyter_client.manager import KernelManager, start_new_kernel
from nbclient import NotebookClient
from nbformat import NotebookNode

from facediff.data.track.options import VARIABLE

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))

SMALL = """
from facediff.synthetic import corpus

# 42 clips instead of 420
corpus.TRAIN_EACH = corpus.REFERENCES_EACH = 3
corpus.TEST_EACH = corpus.TEST_C_EACH = 1
corpus.TRAIN = corpus.TRAIN[:4]  # so that all say the same ones
"""
"""Runs before a notebook."""

OPTIONS = ["--trainer.limit_train_batches=2", "--trainer.limit_val_batches=1", "--trainer.enable_progress_bar=false"]
OPTIONS += ["--trainer.callbacks=[]", "--model.dim=32", "--model.sampler.steps=2"]
PARAMETERS = {"epochs": 1, "options": OPTIONS, "clips": ["F1_t01", "M1_t10"], "sentences": 4, "steps": 3}
"""What a notebook's cell with the tag ``parameters`` may set, and what it is here."""


@pytest.fixture(scope="module")
def kernel(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KernelManager]:
    """One kernel for all notebooks, so that torch is imported once."""
    folder = tmp_path_factory.mktemp("notebooks")
    environment = {"FACEDIFF_CACHE": str(folder / "cache"), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    manager, client = start_new_kernel(kernel_name="python3", env={**os.environ, **environment}, cwd=str(folder))
    client.stop_channels()
    yield manager
    manager.shutdown_kernel(now=True)


def run(path: Path, kernel: KernelManager, folder: Path) -> NotebookNode:
    """The notebook with what it shows, run in a folder of its own."""
    notebook = nbformat.read(path, as_version=4)
    (cell,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    names = [name for name in PARAMETERS if f"\n{name} = " in f"\n{cell.source}"]
    cell.source += "".join(f"\n{name} = {PARAMETERS[name]!r}" for name in names)
    # First into a folder that is there: that of the notebook before went with its test.
    first = f"import os; os.chdir({str(folder)!r})\n%reset -f\n{SMALL}"
    notebook.cells.insert(0, nbformat.v4.new_code_cell(first))
    runner = NotebookClient(notebook, timeout=240, km=kernel)
    try:
        return runner.execute()
    finally:
        runner.kc.stop_channels()  # the client of a kernel that is used on leaves them open


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebook_runs(path: Path, kernel: KernelManager, tmp_path: Path) -> None:
    if VARIABLE in path.read_text() and not os.environ.get(VARIABLE):
        pytest.skip(f"needs the model of a face in {VARIABLE}")
    shown = run(path, kernel, tmp_path)
    text = "\n".join(
        output.data.get("text/html", "")
        for cell in shown.cells
        for output in cell.get("outputs", [])
        if "data" in output
    )
    # What animates shows a face that plays: a page that loads nothing from elsewhere.
    assert ("animate(" in path.read_text()) == ("<iframe srcdoc=" in text)
    assert 'src="http' not in text


def test_the_notebooks_are_committed_with_small_outputs() -> None:
    assert len(NOTEBOOKS) >= 4
    needs = [need for need in metadata.requires("facediff") or () if not re.search("extra == .(?:dev|docs|test)", need)]
    packages = {re.split(r"[^\w-]", need)[0].replace("-", "_") for need in needs} | sys.stdlib_module_names
    for path in NOTEBOOKS:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)), path
        assert sum(bool(cell.outputs) for cell in cells) >= 1, path
        text = path.read_text(encoding="utf-8")
        assert len(text) < 30_000, path
        assert not re.search(r"/(?:tmp|home|root|work|opt|Users)/", text), path
        imported = set(re.findall(r'^ *"(?:from|import) (\w+)', text, re.MULTILINE))
        first_line = next(line for line in text.splitlines() if "You need `pip install" in line)
        assert {name for name in imported - packages if name not in first_line} == set(), path
