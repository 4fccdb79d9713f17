"""Functions that other packages and notebooks provide by name: entry points and import paths."""

from __future__ import annotations

import importlib
from importlib import metadata
from typing import Any

from jaxfit.foundation.errors import InputError


def entry_points(group: str) -> dict[str, str]:
    """Return name → path of what installed packages provide in a group of entry points."""
    return {point.name: point.value for point in metadata.entry_points(group=group)}


def import_object(what: str, path: str) -> Any:
    """Import the object at `package.module:name`.

    Args:
        what: what the object is to its user, for messages, such as `term 'stillness'`.
        path: the path.

    Raises:
        InputError: the module cannot be imported or has no such object.
    """
    module_name, _, attribute = path.partition(":")
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a foreign module may raise any exception, and may end Python
        problem = f"cannot be imported: {type(error).__name__}: {error}"
        remedy = "its folder must be in PYTHONPATH, or its package installed"
        raise InputError(what, problem, remedy) from error
    try:
        return getattr(module, attribute)
    except (Exception, SystemExit):  # a module can compute its attributes
        raise InputError(what, f"{module_name} has no function {attribute!r}", "check the name") from None
