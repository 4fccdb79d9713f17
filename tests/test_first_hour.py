"""docs/first_hour.md: its commands run in the order of the page, and print and write what the page says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.unchanged import REASON, is_unchanged

PAGE = Path(__file__).resolve().parents[1] / "docs" / "first_hour.md"
BLOCK = re.compile(r"^```(sh|python|text)\n(.*?)^```", re.DOTALL | re.MULTILINE)
INSTALLATION = ("make install", "source ", "python3 -m venv ", "pip install jaxfit_birds-", "mkdir ", "cd ")
"""Beginnings of the lines that install jaxfit, as `.ci/run` and `make wheel` do."""


def run(command, folder):
    """Run a command as a user does, with the programs of this environment, and return what it prints."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    ours = ("JAX_DISABLE", "JAX_PERSISTENT", "XLA_FLAGS", "PYTHONPATH")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(ours)}
    environment |= {"PATH": path, "COLUMNS": "200"}
    done = subprocess.run(
        command, cwd=folder, env=environment, shell=isinstance(command, str), stdout=subprocess.PIPE, text=True
    )
    assert done.returncode == 0, command
    return done.stdout


def steps():
    """Return the commands (kind, code, the output that the page shows) without those of the installation."""
    found = []
    for kind, block in BLOCK.findall(PAGE.read_text(encoding="utf-8")):
        if kind == "python":
            found.append((kind, block, ""))
        elif kind == "text":
            found[-1] = (*found[-1][:2], block)
        else:
            lines = [line for line in block.splitlines() if not line.startswith(INSTALLATION)]
            assert all(re.match(r"jaxfit \w", line) for line in lines), lines
            found += [(kind, line, "") for line in lines]
    return found


def without_numbers(text):
    """Return an output in one line and with # for numbers, which differ between processors."""
    return re.sub(r"\d+(\.\d+)?", "#", " ".join(text.split())).replace("poses", "pose")


@pytest.mark.extended
@pytest.mark.skipif(is_unchanged(PAGE), reason=REASON)
def test_the_first_hour(tmp_path):
    for kind, code, shown in steps():
        printed = run([sys.executable, "-c", code] if kind == "python" else code, tmp_path)
        missing = [line for line in shown.splitlines() if without_numbers(line) not in without_numbers(printed)]
        assert not missing, f"{code} printed:\n{printed}"
    text = PAGE.read_text(encoding="utf-8")
    named = re.findall(r"`((?:[\w-]+/)*[\w-]+\.(?:html|mp4|png|jpg|csv|glb|json|npz))`", text)
    assert named
    assert not [name for name in named if not (tmp_path / name).exists()]


def test_the_test_sees_every_block():
    text = PAGE.read_text(encoding="utf-8")
    assert len(re.findall("^```", text, re.MULTILINE)) == 2 * len(BLOCK.findall(text))
    assert len(steps()) >= 10
