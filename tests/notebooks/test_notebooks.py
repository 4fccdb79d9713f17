"""Each notebook runs from end to end with small parameters, and its stored outputs show pictures and no machine."""

import ast
import base64
import json
import re

import cv2
import numpy as np
import pytest
from support.notebook_runs import (
    NOTEBOOKS,
    execute_together,
    parameters_cell,
    read,
    set_parameters,
    without_run_metadata,
)
from support.unchanged import REASON, is_unchanged

pytestmark = pytest.mark.extended

SMALL_SCENE = {"BIRDS": 1, "FRAMES": 10, "SIZE": (640, 376), "KEYPOINT_STEPS": 3, "MASK_STEPS": 2}
SMALL = {
    "01_fit_a_window": SMALL_SCENE,
    "02_ablation": SMALL_SCENE | {"WEIGHTS": [10, 100]},
    "03_new_prior": SMALL_SCENE | {"WEIGHTS": [0, 10]},
    "04_from_video": SMALL_SCENE,
    "05_your_own_footage": SMALL_SCENE | {"BIRDS": 2, "FRAMES": 30, "LABELLED": 8, "SCENES": 1, "STEPS": 10},
    "06_your_own_species": SMALL_SCENE | {"PHOTOGRAPHS": 5, "ROUNDS": (2, 2)},
}
"""Parameters that keep the run of every notebook short."""
PICTURES = {
    "01_fit_a_window": 3,
    "02_ablation": 1,
    "03_new_prior": 1,
    "04_from_video": 3,
    "05_your_own_footage": 2,
    "06_your_own_species": 2,
}
"""Number of pictures that every notebook shows."""
every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def pictures(notebook):
    """Return the decoded pictures of all outputs."""
    data = [output.data for cell in code_cells(notebook) for output in cell.outputs if "data" in output]
    encoded = [d[kind] for d in data for kind in ("image/png", "image/jpeg") if kind in d]
    return [cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR) for text in encoded]


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def assert_shows_pictures(notebook, name):
    shown = pictures(notebook)
    assert len(shown) == PICTURES[name]
    for picture in shown:
        assert min(picture.shape[:2]) >= 150
        assert len(np.unique(picture)) > 30, "a blank picture"


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """Return every changed notebook by its name, run with small parameters."""
    changed = [path for path in NOTEBOOKS if not is_unchanged(path)]
    notebooks = {path.stem: set_parameters(read(path), SMALL[path.stem]) for path in changed}
    for notebook in notebooks.values():
        for cell in code_cells(notebook):
            cell.outputs = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # optimisation takes longer than these few steps
        execute_together(list(notebooks.values()), tmp_path_factory.mktemp("notebooks"))
    return notebooks


def test_every_notebook_has_small_parameters():
    assert [path.stem for path in NOTEBOOKS] == list(SMALL)


@every_notebook
def test_notebook_runs_and_shows_pictures(path, request):
    if is_unchanged(path):
        pytest.skip(REASON)
    executed = request.getfixturevalue("executed")
    outputs = [output for cell in code_cells(executed[path.stem]) for output in cell.outputs]
    assert not ["".join(output.traceback) for output in outputs if output.output_type == "error"]
    assert not [output.text for output in outputs if output.output_type == "stream"]
    assert_shows_pictures(executed[path.stem], path.stem)


@every_notebook
def test_stored_outputs_show_pictures_and_no_machine(path):
    notebook = read(path)
    assert_shows_pictures(notebook, path.stem)
    assert path.stat().st_size < 600_000
    outputs = [
        [{**output, "data": _without_pictures(output.get("data", {}))} for output in cell.outputs]
        for cell in code_cells(notebook)
    ]
    text = json.dumps(outputs)
    assert not re.search(r"/(home|root|tmp|usr|work|Users|opt|var)/|[A-Z]:\\\\|https?://", text)
    assert not re.search(r"Traceback|[Ww]arning", text)
    assert without_run_metadata(read(path)) == notebook, "the notebook holds metadata of a run: make notebooks"
    assert [cell.execution_count for cell in code_cells(notebook)] == list(range(1, len(code_cells(notebook)) + 1))


def _without_pictures(data):
    return {kind: text for kind, text in data.items() if not kind.startswith("image/")}


@every_notebook
def test_parameters_come_first(path):
    notebook = read(path)
    assert notebook.cells[0].cell_type == "markdown"
    first = code_cells(notebook)[0]
    assert parameters_cell(notebook) == first
    names = {node.id for node in ast.walk(ast.parse(first.source)) if isinstance(node, ast.Name)}
    assert set(SMALL[path.stem]) <= names


def test_the_new_term_has_at_most_ten_lines_and_needs_public_names_only():
    path = next(path for path in NOTEBOOKS if path.stem == "03_new_prior")
    cells = code_cells(read(path))
    assert not [cell.source for cell in cells if "from jaxfit" in cell.source or "import jaxfit." in cell.source]
    trees = [ast.parse(cell.source) for cell in cells]
    (term,) = (node for tree in trees for node in tree.body if isinstance(node, ast.FunctionDef))
    assert [ast.unparse(decorator) for decorator in term.decorator_list] == ["jaxfit.term"]
    assert term.end_lineno - term.decorator_list[0].lineno + 1 <= 10
