"""Run the notebooks. As a program (`make notebooks`): run them in place and store their outputs."""

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
RESET = "%reset_selective -f ^[^_]"
"""Removes the names of a notebook, but not `__spec__` of the main module: new processes need it."""


def read(path: Path) -> NotebookNode:
    return nbformat.read(path, as_version=4)


def parameters_cell(notebook: NotebookNode) -> NotebookNode:
    """Return the cell of parameters, which has papermill's tag."""
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    return cell


def set_parameters(notebook: NotebookNode, values: Mapping[str, Any]) -> NotebookNode:
    """Append assignments of other values to the cell of parameters."""
    cell = parameters_cell(notebook)
    cell.source = "\n".join([cell.source, *(f"{name} = {value!r}" for name, value in values.items())])
    return notebook


def execute(notebook: NotebookNode, folder: Path, allow_errors: bool = False) -> NotebookNode:
    """Run all cells in a folder; with `allow_errors`, errors become outputs.

    Raises:
        CellExecutionError: a cell failed and `allow_errors` is False.
    """
    profile = folder / ".ipython"  # a fresh profile: the user's profile is neither read nor changed
    profile.mkdir(exist_ok=True)
    client = NotebookClient(
        notebook,
        kernel_name="python3",
        timeout=3600,  # a training takes half an hour on a slow machine
        startup_timeout=300,
        record_timing=False,
        allow_errors=allow_errors,
        resources={"metadata": {"path": str(folder)}},
    )
    return client.execute(env={**os.environ, "IPYTHONDIR": str(profile)})


def execute_together(notebooks: list[NotebookNode], folder: Path) -> None:
    """Run notebooks one after the other in one process; errors become outputs.

    The notebooks share imports and compiled programs, which saves time. Names are reset before every notebook.
    """
    v4 = nbformat.v4
    cells = [cell for notebook in notebooks for cell in (v4.new_code_cell(RESET), *notebook.cells)]
    execute(v4.new_notebook(cells=cells), folder, allow_errors=True)


def without_run_metadata(notebook: NotebookNode) -> NotebookNode:
    """Remove the metadata that differ between runs and between machines."""
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
            notebook = without_run_metadata(execute(read(path), Path(folder)))
        path.write_text(nbformat.writes(notebook) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
