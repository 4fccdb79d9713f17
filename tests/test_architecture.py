"""The layout of the code: the rules of docs/developers/architecture.md hold."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCUMENT = ROOT / "docs" / "developers" / "architecture.md"
PACKAGE = ROOT / "jaxfit"
MODULES = sorted(PACKAGE.rglob("*.py"))


def floors():
    """Return the floor of every package and root module, from the numbered list of the document."""
    rows = re.findall(r"^(\d+)\. ((?:`\w+`(?:, )?)+)", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)
    return {name: int(number) for number, names in rows for name in re.findall(r"\w+", names)}


def module_name(path):
    """Return the dotted name of a module of the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path):
    """Return the modules of the package that a module imports, anywhere in its text, each with its line."""
    names = {module_name(each) for each in MODULES}
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            inside = [f"{node.module}.{alias.name}" for alias in node.names]
            found += [(name if name in names else node.module, node.lineno) for name in inside]
    return [(name, line) for name, line in found if name in names and name != "jaxfit"]


def test_paths_in_the_text_of_the_documents_exist():
    text = DOCUMENT.read_text(encoding="utf-8")
    named = re.findall(r"`([\w*./]+(?:/|\.py|\.cc|\.yaml))`", text)
    assert not [path for path in named if not any(list(folder.glob(path)) for folder in (PACKAGE, ROOT))]


def test_the_document_names_the_floor_of_every_package():
    present = {path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in MODULES} - {"__init__"}
    lacking, removed = present - floors().keys(), floors().keys() - present
    assert not lacking | removed, f'architecture.md, "Floors": add {lacking or "none"}, remove {removed or "none"}'


def test_modules_import_from_lower_floors_only():
    floor = floors()
    wrong = []
    for path in MODULES:
        own = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for name, line in imports(path) if own != "__init__" else []:
            other = name.split(".")[1]
            if other != own and floor[other] >= floor[own]:
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {own} (floor {floor[own]}) imports {name}")
    assert not wrong, "\n".join(wrong)


def test_no_modules_import_each_other():
    graph = {module_name(path): {name for name, _ in imports(path)} for path in MODULES}
    del graph["jaxfit"]  # names the home of every public name; no module imports it back
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        raise AssertionError("a circle of imports: " + " → ".join(reversed(error.args[1]))) from None


def test_no_module_uses_private_parts_of_jax():
    assert not [str(path) for path in MODULES if "jax._src" in path.read_text(encoding="utf-8")]
