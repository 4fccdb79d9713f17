"""Registry of the terms of the objective: jaxfit's own terms, terms of other packages, and terms of a notebook."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar, overload

from jaxtyping import Array

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.plugins import entry_points, import_object
from jaxfit.objective.curvature import FrameBlocks

ENTRY_POINTS = "jaxfit.terms"
"""The entry-point group with which an installed package provides terms."""
FORM = "a term has the form `def name(window, *, setting=1.0): …`, and the default of each setting is a number"

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True, eq=False)
class Term:
    """A term of the objective: a pure function of the `PosedWindow`, and its properties."""

    name: str
    """Name of the term in configs."""
    function: Callable[..., Any]
    """The function (window, *, settings) → scalar."""
    settings: dict[str, float]
    """Keyword arguments of the function and their defaults."""
    positive: frozenset[str]
    """Settings that must be above 0; the other settings may be 0."""
    compares_masks: bool
    """Whether the term uses masks: only stages with such a term receive masks."""
    with_blocks: Callable[..., tuple[Array, FrameBlocks]] | None = None
    """The value and the Gauss-Newton blocks, a function of the same arguments, of a term that returns no residuals."""


_terms: dict[str, Term] = {}
"""Registered terms by name, and imported terms by name or path."""


@overload
def term(function: Function, /) -> Function: ...
@overload
def term(
    *,
    name: str | None = None,
    positive: Collection[str] = (),
    compares_masks: bool = False,
    with_blocks: Callable[..., tuple[Array, FrameBlocks]] | None = None,
) -> Callable[[Function], Function]: ...
def term(function=None, /, *, name=None, positive=(), compares_masks=False, with_blocks=None):
    """Register a term of the objective: a pure function of the window, with the settings as keyword arguments.

    After `@term def stillness(window, *, beta=1.0): …`, the configs of this session can use the term `stillness`. The
    decorator returns the function unchanged. Weights and settings are traced, so the function must work under `jit`
    and `vmap`: no Python `if` on values.

    Args:
        function: takes a `jaxfit.objective.posed_window.PosedWindow` and returns a scalar.
        name: name of the term in configs (default: the name of the function).
        positive: settings that must be above 0.
        compares_masks: whether the function uses `window.targets.mask`, which is empty in stages without such a term.
        with_blocks: for a function that cannot return residuals, such as a term of the silhouette: takes the same
            arguments, and returns the value and the Gauss-Newton blocks of the frames,
            `jaxfit.objective.curvature.FrameBlocks`. The solver `levenberg_marquardt` needs residuals or blocks.

    Raises:
        InputError: the function does not have the form of a term, or a term of another module has this name. A module
            may register its own names again, as a notebook does when a cell runs a second time.
    """

    def register(function):
        new = _term_of(name or function.__name__, function, positive, compares_masks)
        existing = _terms.get(new.name)
        if existing is not None and existing.function.__module__ != function.__module__:
            problem = f"is already the name of a term of {existing.function.__module__}"
            raise InputError(f"term {new.name!r}", problem, "choose another name")
        _terms[new.name] = replace(new, with_blocks=with_blocks)
        return function

    return register if function is None else register(function)


def find_term(name: str) -> Term:
    """Return a term by its registered name, by an entry point of the group `jaxfit.terms`, or by its path.

    The path is `package.module:function`. Such a function needs the decorator only if the term uses masks, has
    blocks, or has settings that must be above 0.

    Raises:
        KeyError: no term has this name.
        InputError: the module cannot be imported or has no such function, or the function does not have the form of a
            term.
    """
    if name in _terms and ":" not in name:
        return _terms[name]
    if ":" in name:
        path = name
    elif name in (paths := entry_points(ENTRY_POINTS)):
        path = paths[name]
    else:
        raise KeyError(name)
    function = import_object(f"term {name!r}", path)
    registered = next((known for known in _terms.values() if known.function is function), None)
    _terms[name] = registered or _term_of(name, function)
    return _terms[name]


def find_terms(names: Iterable[str]) -> dict[str, Term]:
    """Return name → term, with every term as `find_term` returns it."""
    return {name: find_term(name) for name in names}


def known_terms() -> list[str]:
    """Return the names of all terms that are registered or provided by installed packages; paths are not included."""
    return [name for name in dict.fromkeys([*_terms, *entry_points(ENTRY_POINTS)]) if ":" not in name]


def _term_of(name: str, function: Any, positive: Collection[str] = (), compares_masks: bool = False) -> Term:
    """Return the term of a function, without blocks.

    Raises:
        InputError: the function does not have the form of a term.
    """

    def require(holds: bool, problem: str) -> None:
        if not holds:
            raise InputError(f"term {name!r}", problem, FORM)

    require(callable(function), f"is not a function but a {type(function).__name__}")
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # some built-in functions have no signature
        parameters = []
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    require(bool(parameters) and parameters[0].kind in positional, "does not take the window as its first argument")
    settings = parameters[1:]
    for setting in settings:
        require(setting.kind is setting.KEYWORD_ONLY, f"takes {setting.name!r}, which is not keyword-only")
        default = setting.default
        is_number = isinstance(default, int | float) and not isinstance(default, bool) and math.isfinite(default)
        require(is_number, f"has a setting {setting.name!r}, but the default of the setting is not a finite number")
        require(setting.name != "weight", "has a setting named 'weight', a name that is reserved for the weight")
    unknown = sorted(set(positive) - {setting.name for setting in settings})
    require(not unknown, f"has no setting {', '.join(map(repr, unknown))}, which `positive` names")
    defaults = {setting.name: float(setting.default) for setting in settings}
    return Term(name, function, defaults, frozenset(positive), compares_masks)
