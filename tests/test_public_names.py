"""The public names exist, also for type checkers, and each name is imported at its first use."""

import ast
import pydoc
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jaxfit


def test_every_public_name_comes_from_its_module():
    """The names at run time and those of the stub, which type checkers read, are the same."""
    stub = ast.parse(Path(jaxfit.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    listed = {alias.asname: f"jaxfit.{node.module}" for node in imports for alias in node.names}
    assert sorted(listed) == jaxfit.__all__ == dir(jaxfit)
    for name, module in listed.items():
        assert getattr(jaxfit, name) is getattr(import_module(module), name)
    with pytest.raises(AttributeError, match="reconstrcut"):
        jaxfit.reconstrcut  # noqa: B018


def test_help_is_a_map_of_the_public_names():
    text = pydoc.render_doc(jaxfit, renderer=pydoc.plaintext)
    assert len(text.splitlines()) < 120
    assert set(jaxfit.__all__) <= set(re.findall(r"\w+", text))
    assert "Args:" in pydoc.render_doc(jaxfit.fit)
    names: dict = {}
    exec("from jaxfit import *", names)
    assert names.keys() >= {*jaxfit.__all__}


@pytest.mark.parametrize(
    ("arguments", "code", "output"),
    [
        (["--help"], 0, "COMMAND"),
        (["--version"], 0, jaxfit.__version__),
        (["fit"], 2, "required: OBS"),
        (["simulate", "--out", "x", "--codec", "av1"], 2, "invalid choice: 'av1'"),
    ],
)
def test_help_and_wrong_arguments_load_no_library(arguments, code, output):
    script = Path(sys.executable).with_name("jaxfit")
    command = [sys.executable, "-X", "importtime", script, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = done.stderr.splitlines()
    loaded = {line.rsplit("|")[-1].strip() for line in lines if line.startswith("import time:")}
    assert "jaxfit.cli.main" in loaded
    assert not loaded & {"jax", "numpy", "cv2", "av", "scipy", "yaml"}
    assert done.returncode == code
    assert output in done.stdout + "".join(line for line in lines if not line.startswith("import time:"))


def test_commands_load_what_they_need():
    """Only commands that use the video libraries or the objective import them; `jaxfit demo` uses everything."""
    code = "import pkgutil, sys, jaxfit.cli as c\n"
    code += "names = [m.name for m in pkgutil.iter_modules(c.__path__) if m.name != 'demo']\n"
    code += "for name in names: __import__(f'jaxfit.cli.{name}')\n"
    code += "print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "jaxfit.model.files" in loaded
    assert not set(loaded) & {"av", "cv2", "trimesh", "jaxfit.objective.objective", "jaxfit.evaluation.evaluate"}


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(jaxfit.InputError, match=r'pip install "\.\[report\]" in the checkout'):
        jaxfit.ablate("a.json", "b.json", "out")
