"""Which terms there are: the library's own, those of other packages, and those of a notebook, found in one way."""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any, TypeVar, overload

from jaxfit.errors import InputError
from jaxfit.objective.curvature import Curvature

__all__ = ["ENTRY_POINTS", "Term", "find_term", "find_terms", "known_terms", "term"]

ENTRY_POINTS = "jaxfit.terms"
"""The entry-point group by which an installed package offers terms."""
FORM = "a term is `def name(window, *, setting=1.0): …`, with one window and settings that are numbers"

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True, eq=False)
class Term:
    """A pure function of the `PosedWindow`, and what else is to be known of it."""

    name: str
    """What configs call it."""
    function: Callable[..., Any]
    settings: dict[str, float]
    """Its keyword arguments and their defaults."""
    positive: frozenset[str]
    """Settings that must be above 0; the others may be 0."""
    compares_masks: bool
    """Whether it looks at the silhouette: only stages with such a term are given masks."""
    curvature: Callable[..., Curvature] | None = None
    """Its curvature, of the same arguments; only then can Levenberg-Marquardt minimise it."""


_terms: dict[str, Term] = {}
"""By name: what was registered, and by its path what was imported."""


@overload
def term(function: Function, /) -> Function: ...
@overload
def term(
    *,
    name: str | None = None,
    positive: Collection[str] = (),
    compares_masks: bool = False,
    curvature: Callable[..., Curvature] | None = None,
) -> Callable[[Function], Function]: ...
def term(function=None, /, *, name=None, positive=(), compares_masks=False, curvature=None):
    """Register a term of the objective: a pure function of the window, whose keyword arguments are its settings.

    `@term def stillness(window, *, beta=1.0): …` is from then on what configs of this session call `stillness`. The
    function itself is returned as it is. Weights and settings are traced, so it must be written for
    `jit` and `vmap`: no Python `if` on values.

    Args:
        function: takes the `jaxfit.objective.posed_window.PosedWindow` and returns a scalar.
        name: what configs call it (default: the function's name).
        positive: its settings that must be above 0.
        compares_masks: whether it looks at `window.targets.mask`, which is empty in stages without such a term.
        curvature: takes what `function` takes and returns a `jaxfit.objective.curvature.Curvature`, for stages whose
            solver is `levenberg_marquardt`.

    Raises:
        InputError: not of a term's form, or a name that another module's term has. A module may register its own
            names anew, as a notebook does when its cell runs again.
    """

    def register(function):
        own = replace(_read(name or function.__name__, function, positive, compares_masks), curvature=curvature)
        before = _terms.get(own.name)
        if before is not None and before.function.__module__ != function.__module__:
            problem = f"is the name of a term of {before.function.__module__}"
            raise InputError(f"term {own.name!r}", problem, "choose another name")
        _terms[own.name] = own
        return function

    return register if function is None else register(function)


def find_term(name: str) -> Term:
    """A term by its registered name, by an entry point of the group `jaxfit.terms`, or by `package.module:function`.

    A function found by its path needs no decorator, unless it compares masks or has settings that must be above 0.

    Raises:
        KeyError: no term has this name.
        InputError: its module cannot be imported, or holds no such function, or it is not of a term's form.
    """
    if name in _terms and ":" not in name:
        return _terms[name]
    if ":" in name:
        path = name
    elif name in (offered := _offered()):
        path = offered[name]
    else:
        raise KeyError(name)
    function = _import(name, path)
    registered = next((known for known in _terms.values() if known.function is function), None)
    found = registered or _read(name, function)
    _terms[name] = found
    return found


def find_terms(names: Iterable[str]) -> dict[str, Term]:
    """Return terms by their names, as `find_term` finds each of them."""
    return {name: find_term(name) for name in names}


def known_terms() -> list[str]:
    """Names of all terms registered or offered by installed packages, but not of those found by their path."""
    return [name for name in dict.fromkeys([*_terms, *_offered()]) if ":" not in name]


def _offered() -> dict[str, str]:
    return {point.name: point.value for point in metadata.entry_points(group=ENTRY_POINTS)}


def _import(name: str, path: str) -> Any:
    """What stands at `package.module:function`."""
    module_name, _, attribute = path.partition(":")
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # whatever somebody's module does when it is run
        problem = f"cannot be imported from {module_name!r}: {type(error).__name__}: {error}"
        remedy = "write `package.module:function`, with its folder installed or in PYTHONPATH"
        raise InputError(f"term {name!r}", problem, remedy) from error
    try:
        return getattr(module, attribute)
    except AttributeError:
        raise InputError(f"term {name!r}", f"{module_name} has no function {attribute!r}", "check the name") from None


def _read(name: str, function: Any, positive: Collection[str] = (), compares_masks: bool = False) -> Term:
    """A term, once its function is of the right form."""

    def require(holds: bool, problem: str) -> None:
        if not holds:
            raise InputError(f"term {name!r}", problem, FORM)

    require(callable(function), f"is no function, but of type {type(function).__name__}")
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except ValueError:  # some of Python's own do not tell
        parameters = []
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    require(bool(parameters) and parameters[0].kind in positional, "takes no window")
    settings = parameters[1:]
    for setting in settings:
        require(setting.kind is setting.KEYWORD_ONLY, f"takes {setting.name!r} beside the window, not after a `*`")
        default = setting.default
        number = isinstance(default, int | float) and not isinstance(default, bool) and math.isfinite(default)
        require(number, f"has a setting {setting.name!r} whose default is no number")
        require(setting.name != "weight", "has a setting 'weight', which every term has already")
    unknown = sorted(set(positive) - {setting.name for setting in settings})
    require(not unknown, f"has no setting {', '.join(map(repr, unknown))} that could be positive")
    defaults = {setting.name: float(setting.default) for setting in settings}
    return Term(name, function, defaults, frozenset(positive), compares_masks)
