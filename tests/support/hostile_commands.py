"""Functions that tests call in bounded children (`support.hostile`), with arguments that JSON can carry."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys

from jaxfit.cli.main import main
from jaxfit.foundation.errors import InputError

# The server imports these modules once, so that its children need neither the time nor the memory.
for _name in (
    "jaxfit.evaluation.ablation.ablate",
    "jaxfit.data.formats.coco",
    "jaxfit.evaluation.detection_noise",
    "jaxfit.evaluation.evaluate",
    "jaxfit.fitting.fit",
    "jaxfit.pipeline",
    "jaxfit.view.overlay",
):
    importlib.import_module(_name)


class WrongEndingError(Exception):
    """A command did not end as the command line promises."""


def run_command(*arguments: str) -> None:
    """Run one command of the command line.

    Raises:
        InputError: the command ended with exit code 2 and one line; the message is this line without `jaxfit: `.
        WrongEndingError: the command ended in another way, or printed more than one line.
    """
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main(list(arguments))
        except SystemExit as stop:
            code = stop.code
    lines = errors.getvalue().splitlines()
    if code == 0:
        return
    if code != 2 or len(lines) != 1 or not lines[0].startswith("jaxfit: ") or len(lines[0]) > 300:
        raise WrongEndingError(f"code {code}: {errors.getvalue()}")
    raise InputError.__new__(InputError, lines[0].removeprefix("jaxfit: "))


def run_command_beside(modules: str, *arguments: str) -> None:
    """Run one command as `run_command` does, with a folder of modules that Python can import."""
    sys.path.insert(0, modules)
    run_command(*arguments)
