"""Executes the notebooks; as a program, in place, so that what is stored shows what they give (`make notebooks`)."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def read(path: Path) -> NotebookNode:
    return nbformat.read(path, as_version=4)


def parameters(notebook: NotebookNode) -> NotebookNode:
    """The cell of values to choose, as papermill marks it."""
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    return cell


def choose(notebook: NotebookNode, values: Mapping[str, Any]) -> NotebookNode:
    """With other values after those of the parameters' cell."""
    cell = parameters(notebook)
    cell.source = "\n".join([cell.source, *(f"{name} = {value!r}" for name, value in values.items())])
    return notebook


def execute(notebook: NotebookNode, folder: Path, go_on: bool = False) -> NotebookNode:
    """Run all cells in a folder; `go_on` leaves errors among the outputs.

    Raises:
        CellExecutionError: a cell failed.
    """
    profile = folder / ".ipython"  # nothing of the user's, and nothing left there
    profile.mkdir(exist_ok=True)
    client = NotebookClient(
        notebook,
        kernel_name="python3",
        timeout=900,
        startup_timeout=300,
        record_timing=False,
        allow_errors=go_on,
        resources={"metadata": {"path": str(folder)}},
    )
    return client.execute(env={**os.environ, "IPYTHONDIR": str(profile)})


def execute_together(notebooks: list[NotebookNode], folder: Path) -> None:
    """Run notebooks one after the other in one process, each without the names of those before, errors among the
    outputs: they share what importing and compiling takes."""
    v4 = nbformat.v4
    cells = [cell for each in notebooks for cell in (v4.new_code_cell("%reset -f"), *each.cells)]
    execute(v4.new_notebook(cells=cells), folder, go_on=True)


def clean(notebook: NotebookNode) -> NotebookNode:
    """Without what differs from run to run and from machine to machine."""
    notebook.metadata = NotebookNode(
        kernelspec={"display_name": "Python 3", "language": "python", "name": "python3"},
        language_info={"name": "python"},
    )
    for cell in notebook.cells:
        cell.metadata = NotebookNode({"tags": cell.metadata.tags} if "tags" in cell.metadata else {})
    return notebook


def main(names: list[str]) -> None:
    for path in [FOLDER / Path(name).name for name in names] or NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            notebook = clean(execute(read(path), Path(folder)))
        path.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
