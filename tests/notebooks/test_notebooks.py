"""The notebooks: each runs from end to end on small settings; what is stored shows pictures, and no machine."""

import ast
import base64
import json
import re

import cv2
import numpy as np
import pytest
from support.notebook_runs import NOTEBOOKS, choose, clean, execute_together, parameters, read

SCENE = {"BIRDS": 1, "FRAMES": 10, "SIZE": (640, 376), "KEYPOINT_STEPS": 3, "MASK_STEPS": 2}
SMALL = {
    "01_fit_a_window": SCENE,
    "02_ablation": SCENE | {"WEIGHTS": [10, 100]},
    "03_new_prior": SCENE | {"WEIGHTS": [0, 10]},
    "04_from_video": SCENE,
}
PICTURES = {"01_fit_a_window": 3, "02_ablation": 1, "03_new_prior": 1, "04_from_video": 3}
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def pictures(notebook):
    """All pictures that were shown, decoded."""
    data = [output.data for cell in code(notebook) for output in cell.outputs if "data" in output]
    shown = [d[kind] for d in data for kind in ("image/png", "image/jpeg") if kind in d]
    return [cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR) for text in shown]


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def assert_shown(notebook, name):
    found = pictures(notebook)
    assert len(found) == PICTURES[name]
    for picture in found:
        assert min(picture.shape[:2]) >= 150
        assert len(np.unique(picture)) > 30, "a blank picture"


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """Every notebook by its name, run on small settings."""
    notebooks = {path.stem: choose(read(path), SMALL[path.stem]) for path in NOTEBOOKS}
    for notebook in notebooks.values():
        for cell in code(notebook):
            cell.outputs = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # which a few steps do not repay
        execute_together(list(notebooks.values()), tmp_path_factory.mktemp("notebooks"))
    return notebooks


def test_there_are_four():
    assert [path.stem for path in NOTEBOOKS] == list(SMALL)


@each
def test_it_runs_and_shows_pictures(path, executed):
    outputs = [output for cell in code(executed[path.stem]) for output in cell.outputs]
    assert not ["".join(output.traceback) for output in outputs if output.output_type == "error"]
    assert not [output.text for output in outputs if output.output_type == "stream"]
    assert_shown(executed[path.stem], path.stem)


@each
def test_what_is_stored_shows_pictures_and_no_machine(path):
    notebook = read(path)
    assert_shown(notebook, path.stem)
    assert path.stat().st_size < 600_000
    outputs = json.dumps([[{**o, "data": _words(o.get("data", {}))} for o in cell.outputs] for cell in code(notebook)])
    assert not re.search(r"/(home|root|tmp|usr|work|Users|opt|var)/|[A-Z]:\\\\|https?://", outputs)
    assert not re.search(r"Traceback|[Ww]arning", outputs)
    assert clean(read(path)) == notebook, "stored with metadata of a run: make notebooks"
    assert [cell.execution_count for cell in code(notebook)] == list(range(1, len(code(notebook)) + 1))


def _words(data):
    return {kind: text for kind, text in data.items() if not kind.startswith("image/")}


@each
def test_values_to_choose_stand_first(path):
    notebook = read(path)
    assert notebook.cells[0].cell_type == "markdown"
    first = code(notebook)[0]
    assert parameters(notebook) == first
    chosen = {node.id for node in ast.walk(ast.parse(first.source)) if isinstance(node, ast.Name)}
    assert set(SMALL[path.stem]) <= chosen


def test_the_new_term_has_at_most_ten_lines():
    path = next(path for path in NOTEBOOKS if path.stem == "03_new_prior")
    trees = [ast.parse(cell.source) for cell in code(read(path))]
    (term,) = (node for tree in trees for node in tree.body if isinstance(node, ast.FunctionDef))
    assert [ast.unparse(decorator) for decorator in term.decorator_list] == ["jaxfit.term"]
    assert term.end_lineno - term.decorator_list[0].lineno + 1 <= 10
