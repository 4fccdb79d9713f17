"""The public names: all there, where type checkers look for them too, and imported only when they are used."""

import ast
import inspect
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jaxfit


def test_every_public_name_is_the_one_of_its_module():
    """What runs, what type checkers read and what is promised are three lists of the same names."""
    tree = ast.parse(inspect.getsource(jaxfit))
    typed = next(node for node in tree.body if isinstance(node, ast.If))  # if TYPE_CHECKING
    static = {(alias.name, node.module) for node in typed.body for alias in node.names}
    assert sorted(name for name, _ in static) == jaxfit.__all__
    for name, module in static:
        assert getattr(jaxfit, name) is getattr(import_module(module), name)
    assert set(jaxfit.__all__) <= set(dir(jaxfit))
    with pytest.raises(AttributeError, match="'jaxfit' has no attribute 'reconstrcut'"):
        jaxfit.reconstrcut  # noqa: B018


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--help"], 0, "COMMAND"),
        (["--version"], 0, jaxfit.__version__),
        (["fit"], 2, "required: OBS.json"),
        (["simulate", "--out", "x", "--codec", "av1"], 2, "invalid choice: 'av1'"),
    ],
)
def test_what_needs_no_library_loads_none(arguments, code, said):
    script = Path(sys.executable).with_name("jaxfit")
    command = [sys.executable, "-X", "importtime", script, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    lines = done.stderr.splitlines()
    loaded = {line.rsplit("|")[-1].strip() for line in lines if line.startswith("import time:")}
    assert "jaxfit.cli.main" in loaded
    assert not loaded & {"jax", "numpy", "cv2", "av", "scipy", "yaml"}
    assert done.returncode == code
    assert said in done.stdout + "".join(line for line in lines if not line.startswith("import time:"))


def test_commands_load_what_they_need():
    """No command waits for the video libraries or the objective unless it uses them."""
    code = "import pkgutil, sys, jaxfit.cli as c\n"
    code += "for m in pkgutil.iter_modules(c.__path__): __import__(f'jaxfit.cli.{m.name}')\n"
    code += "print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "jaxfit.model.files" in loaded
    assert not set(loaded) & {"av", "cv2", "trimesh", "jaxfit.objective.objective", "jaxfit.evaluation.evaluate"}
