"""Run the notebooks of the manual with the small settings of their test, and store what they print in them.

``python tools/notebook_outputs.py FOLDER`` works in an empty folder; the notebook of a person needs the model of a face
in ``FACEDIFF_FACE_MODEL``. Faces that play are stored as a line of text, since their pages are hundreds of kilobytes;
messages of Lightning and paths of this machine are left out.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from tests.docs.test_notebooks import NOTEBOOKS, PARAMETERS, SMALL  # noqa: E402 - of the checkout that this file is in

ANSI = re.compile(r"\x1b\[[0-9;]*m")


def printed(outputs: list[Any], folder: Path) -> list[Any]:
    """What a reader needs of a cell's outputs, as plain text; tables of Lightning's own go."""
    lines = []
    for output in outputs:
        if output.output_type == "stream" and output.name == "stderr":
            continue
        text = output.text if output.output_type == "stream" else output.data.get("text/plain", "")
        text = (
            ANSI.sub("", text)
            .replace(str(folder / "cache"), "~/.cache/facediff")
            .replace(f"{folder}/", "")
            .replace(f"{ROOT}/", "")
        )
        ours = not re.search("Trainable params|Name .*Params|Loading `train_dataloader`|`Trainer|litlogger", text)
        if ours and text.strip():
            lines.append(text.rstrip())
    text = "\n".join(lines)
    return [nbformat.v4.new_output("stream", name="stdout", text=f"{text}\n")] if text else []


def main() -> None:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="notebooks without .ipynb; all of them if none is given")
    options = parser.parse_args()
    folder = options.folder.resolve()
    os.environ.update(FACEDIFF_CACHE=str(folder / "cache"), PYTHONPATH=str(ROOT), OMP_NUM_THREADS="1")
    for path in (path for path in NOTEBOOKS if not options.names or path.stem in options.names):
        place = folder / path.stem
        place.mkdir(parents=True)
        notebook = nbformat.read(path, as_version=4)
        (cell,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
        source = cell.source
        names = [name for name in PARAMETERS if f"\n{name} = " in f"\n{source}"]
        cell.source += "".join(f"\n{name} = {PARAMETERS[name]!r}" for name in names)
        notebook.cells.insert(0, nbformat.v4.new_code_cell(f"%cd -q {place}\n{SMALL}"))
        NotebookClient(notebook, timeout=900, kernel_name="python3").execute()
        del notebook.cells[0]
        cell.source = source
        for number, code in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), 1):
            code.execution_count = number
            code.outputs = printed(code.outputs, folder)
            code.metadata.pop("execution", None)
        nbformat.write(notebook, path)
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
