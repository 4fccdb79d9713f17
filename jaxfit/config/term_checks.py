"""Checks of the terms that a config names, and of their weights and settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxfit.config.checks import ConfigKeyError, is_number, require
from jaxfit.config.messages import known_names, shown
from jaxfit.errors import InputError
from jaxfit.limits import CONFIG_NUMBER
from jaxfit.objective.registry import Term, find_term, known_terms

__all__ = ["check_terms", "require_term", "term_settings"]


def check_terms(key: str, terms: Mapping[str, Any]) -> None:
    """Check a mapping of term names to weights, or to weights and settings.

    Args:
        key: the config key of the mapping, for messages.
        terms: term name → weight, or → `{weight: …, setting: …}`.

    Raises:
        ConfigKeyError: an unknown term or setting, or a value that is not a number in the allowed range.
    """
    for name, value in terms.items():
        term = require_term(f"{key}.{name}", name)
        known = ("weight", *term.settings)
        for setting, number in (value if isinstance(value, dict) else {"weight": value}).items():
            path = f"{key}.{name}.{setting}"
            if setting not in known:
                raise ConfigKeyError(path, "is not a setting of this term", known_names(setting, known))
            expected = f"expected a number from 0 to {CONFIG_NUMBER:g}"
            require(is_number(number), path, f"is {shown(number)}", expected)
            require(setting not in term.positive or number > 0, path, f"is {number!r}", "expected a number above 0")


def require_term(key: str, name: str) -> Term:
    """Return the term of a name.

    Args:
        key: the config key that holds the name, for messages.
        name: a registered term, or `package.module:function`.

    Raises:
        ConfigKeyError: there is no such term, or the term cannot be imported.
    """
    try:
        return find_term(name)
    except KeyError:
        remedy = f"{known_names(name, known_terms())}; or package.module:function"
        raise ConfigKeyError(key, f"names an unknown term {name!r}", remedy) from None
    except InputError as error:
        raise ConfigKeyError(key, f"names a {error.source}, which {error.problem}", error.remedy) from error


def term_settings(value: Any) -> dict[str, float]:
    """Return the settings that a config gives for a term; a plain number is the term's weight."""
    return {key: float(number) for key, number in (value if isinstance(value, dict) else {"weight": value}).items()}
