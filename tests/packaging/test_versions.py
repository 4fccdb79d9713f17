"""The versions in pyproject.toml agree with each other."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]


def bounds(requirements, name):
    """Return the lowest version and the version that is excluded, of a package in a list of requirements."""
    (text,) = (text for text in requirements if re.match(rf"{name}\W", text))
    return re.search(r">=([\d.]+)", text)[1], (re.search(r"<([\d.]+)", text) or [None, None])[1]


def test_the_kernels_are_compiled_against_the_oldest_jax():
    """XLA refuses kernels that were compiled against later FFI headers than its own."""
    oldest, _ = bounds(PROJECT["dependencies"], "jax")
    lowest, excluded = bounds(PYPROJECT["build-system"]["requires"], "jax")
    major, minor = map(int, oldest.split("."))
    assert (lowest, excluded) == (oldest, f"{major}.{minor + 1}")


def test_wheels_are_built_for_all_versions_of_python_that_are_declared():
    pattern = r"Programming Language :: Python :: (\d)\.(\d+)"
    declared = [re.fullmatch(pattern, text) for text in PROJECT["classifiers"]]
    declared = [match.groups() for match in declared if match]
    assert PYPROJECT["tool"]["cibuildwheel"]["build"] == [f"cp{major}{minor}-*" for major, minor in declared]
    assert PROJECT["requires-python"] == f">={'.'.join(declared[0])}"
