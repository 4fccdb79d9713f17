"""Messages are one line of at most 300 characters, whatever the data, the arguments and the libraries print."""

import logging
import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from rich.table import Table

from jaxfit.cli import main as cli
from jaxfit.cli.main import OneLine, main
from jaxfit.cli.tables import right_aligned, show, show_facts
from jaxfit.foundation.errors import MAX_MESSAGE_CHARACTERS

NASTY = "[bold]x[/]\x1b[31m\n\udcc5:bird:"


def test_logged_messages():
    record = logging.LogRecord("jaxfit", logging.WARNING, "", 1, "%s is damaged", (NASTY * 99,), None)
    line = OneLine().format(record)
    assert line.isprintable()
    assert line.startswith("jaxfit: [bold]x[/]\\x1b[31m\\n\\udcc5")
    assert line.endswith("is damaged")
    assert len(line) == MAX_MESSAGE_CHARACTERS


def test_names_from_files_contain_no_markup(capsys):
    table: Table = right_aligned("name")
    table.add_row(NASTY)
    for output in (NASTY, table):
        show(output)
    show_facts({"name": NASTY, "[/]": [NASTY]})
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert said.count("[bold]x[/]") == 4
    assert said.count(":bird:") == 4


def test_an_unexpected_error_of_the_system(monkeypatch, capsys):
    def fails(_):
        raise PermissionError(13, "Permission denied", b"\xc5" + b"x" * 999)

    monkeypatch.setattr("jaxfit.cli.models.model_info", fails)
    assert main(["model", "info", "murre"]) == 2
    assert "Permission denied (check the path)" in capsys.readouterr().err
    monkeypatch.setattr("jaxfit.cli.models.model_info", lambda _: (_ for _ in ()).throw(OSError("no file")))
    with pytest.raises(OSError, match="no file"):
        main(["model", "info", "murre"])


CODE = """
import logging, os, sys, warnings
from jaxfit.cli import main as cli

def main():
    cli._prepare_logging(verbose="-v" in sys.argv)
    os.write(2, b"libpng error: text of a library\\n")
    warnings.warn("a warning\\nof Python", stacklevel=1)
    logging.getLogger("jax._src.compiler").warning("a warning of JAX")
    logging.getLogger("jaxfit.video").warning("a warning of\\njaxfit")
    print("\\udcc5", file=sys.stdout)
    print("\\udcc5", file=sys.stderr)
    return 0

cli.main = main
cli.run()
"""


def test_the_output_of_libraries_is_shown_only_on_request():
    done = [
        subprocess.run([sys.executable, "-c", CODE, *more], capture_output=True, text=True, check=False)
        for more in ([], ["-v"])
    ]
    assert [d.returncode for d in done] == [0, 0]
    assert (done[0].stdout, done[0].stderr) == ("\\udcc5\n", "jaxfit: a warning of\\njaxfit\n\\udcc5\n")
    for text in ("libpng error", "a warning\\nof Python", "a warning of JAX", "a warning of\\njaxfit"):
        assert text in done[1].stderr


def test_the_cache_of_compiled_programs(tmp_path, monkeypatch):
    """Programs are stored for later runs. Without a usable folder, programs are compiled and not stored."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cli.use_cache()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "cache" / "jaxfit")
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    cli.use_cache()
    assert float(jax.jit(lambda x: np.pi * x + os.getpid())(0.0)) == os.getpid()
