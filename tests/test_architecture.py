"""The layout of the code: docs/developers/architecture.md and modules.md are true, and the rules hold that they state.

After a module is added, renamed or removed, `python tests/test_architecture.py` rewrites the tree of modules.md. The
tree keeps the descriptions; a new module gets the first line of its docstring, to be shortened by hand, without a
full stop.
"""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
TEXT = ROOT / "docs" / "developers" / "architecture.md"
DOCUMENT = TEXT.with_name("modules.md")
PACKAGE = ROOT / "jaxfit"
MODULES = sorted(PACKAGE.rglob("*.py"))
MOST_LINES, MOST_FUNCTION_LINES, MOST_ROOT_MODULES, MOST_FLOORS = 500, 60, 2, 100
TREE = re.compile(r"(?<=```\n)jaxfit/\n.*?(?=```)", re.DOTALL)


class Entry(NamedTuple):
    """A line of the document's tree."""

    line: int
    description: str


def paths_on_disk():
    """Return the folders (with a `/` at the end) and files of the package, in the order of the document's tree.

    Compiled files, the sources of the kernels and the `__init__.py` of every package but the root are omitted: the
    line of the folder describes the package.
    """
    omitted = re.compile(r"(^|/)(__pycache__|\.|_kernels\.)|.+/__init__\.py$|^raster/cpp/.+")
    paths = {path.relative_to(PACKAGE).as_posix() + "/" * path.is_dir() for path in PACKAGE.rglob("*")}
    floor = floors()

    def order(path):
        """Files before folders, packages from the lowest floor to the highest, else by name."""
        *folders, name = path.split("/")  # the name of a folder is the last but one: the last is empty
        keys = [(1, 0 if i else floor.get(folder, MOST_FLOORS), folder) for i, folder in enumerate(folders)]
        return [*keys, (0, int(name != "__init__.py"), name)] if name else keys

    return sorted((path for path in paths if not omitted.search(path)), key=order)


def paths_in_document():
    """Return the path of every line of the document's tree with its `Entry`."""
    text = DOCUMENT.read_text(encoding="utf-8")
    tree = TREE.search(text)
    first = text[: tree.start()].count("\n") + 1
    folders, entries = [], {}
    for number, line in enumerate(tree.group().splitlines()[1:], first + 1):
        name, _, description = line.strip().partition(" ")
        depth = (len(line) - len(line.lstrip())) // 2
        folders = [*folders[: depth - 1], name]
        entries["".join(folders)] = Entry(number, description.strip())
    return entries


def write_tree():
    """Rewrite the tree of the document from the files of the package."""
    known = paths_in_document()
    lines = ["jaxfit/"]
    for path in paths_on_disk():
        source = PACKAGE / path / ("__init__.py" if path.endswith("/") else "")
        described = known[path].description if path in known else _summary(source)
        name = "  " * path.rstrip("/").count("/") + path.rstrip("/").rsplit("/")[-1] + "/" * path.endswith("/")
        lines.append(f"  {name:<28} {described}".rstrip())
    text = DOCUMENT.read_text(encoding="utf-8")
    DOCUMENT.write_text(TREE.sub(lambda _: "\n".join([*lines, ""]), text), encoding="utf-8")


def _summary(source):
    if source.suffix == ".js":
        return source.read_text(encoding="utf-8").partition("\n")[0].removeprefix("// ").rstrip(".")
    if not source.exists():
        return ""
    text = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) if source.suffix == ".py" else ""
    return (text or "").partition("\n")[0]


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


def test_the_tree_of_the_document_is_the_tree_of_the_package():
    documented, present = paths_in_document(), paths_on_disk()
    wrong = [(entry.line, f"remove {path}") for path, entry in documented.items() if path not in present]
    wrong += [(entry.line, f"describe {path}") for path, entry in documented.items() if not entry.description]
    wrong += [(entry.line, f"shorten {path}") for path, entry in documented.items() if entry.description.endswith(".")]
    line = 0
    for path in present:
        if path not in documented:
            wrong.append((line, f"add {path} after this line"))
        line = documented[path].line if path in documented else line
    messages = [f"docs/developers/modules.md:{line}: {what}" for line, what in sorted(wrong)]
    assert not wrong, "\n".join([*messages, "or run: python tests/test_architecture.py"])


def test_paths_in_the_text_of_the_documents_exist():
    text = TEXT.read_text(encoding="utf-8") + TREE.sub("", DOCUMENT.read_text(encoding="utf-8"))
    named = re.findall(r"`([\w*./]+(?:/|\.py|\.cc|\.yaml))`", text)
    assert not [path for path in named if not any(list(folder.glob(path)) for folder in (PACKAGE, ROOT))]


def test_the_document_names_the_floor_of_every_package():
    present = {path.split("/")[0].removesuffix(".py") for path in paths_on_disk()} - {"__init__", "__init__.pyi"}
    lacking, removed = present - floors().keys(), floors().keys() - present
    assert not lacking | removed, f'modules.md, "Floors": add {lacking or "none"}, remove {removed or "none"}'


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


def test_functions_are_short():
    """The lines of a function do not count its docstring."""
    long = []
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
                lines = node.end_lineno - first.lineno + 1 + node.body[0].lineno - node.lineno
                if lines > MOST_FUNCTION_LINES:
                    long.append(f"{path.relative_to(ROOT)}:{node.lineno}: {node.name} has {lines} lines")
    assert not long, "\n".join(long)


def test_modules_are_short_and_few_at_the_root():
    long = {module_name(path): len(path.read_text(encoding="utf-8").splitlines()) for path in MODULES}
    assert not {name: lines for name, lines in long.items() if lines > MOST_LINES}
    assert len(list(PACKAGE.glob("*.py"))) <= MOST_ROOT_MODULES


def test_no_module_uses_private_parts_of_jax():
    assert not [str(path) for path in MODULES if "jax._src" in path.read_text(encoding="utf-8")]


if __name__ == "__main__":
    write_tree()
