"""Settings of an ablation: the runs of a grid, and the claims that the runs test."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from jaxfit.config.checks import require
from jaxfit.config.messages import shown
from jaxfit.limits import GRID_RUNS

__all__ = ["ClaimConfig", "CrossConfig", "GridConfig", "require_runs"]


@dataclass(frozen=True)
class CrossConfig:
    """Runs for all combinations of some values."""

    cross: Mapping[str, Any]
    """Path of a config key → list of values; the last key changes fastest. `=path` is the value at another path."""
    set: Mapping[str, Any] = field(default_factory=dict)
    """Path of a config key → the value of all these runs."""

    def __post_init__(self):
        require(len(self.cross) > 0, "cross", "is empty", "name a config key and its values")
        for path, values in self.cross.items():
            where = f"cross.{path}"
            require(isinstance(values, list), where, f"is {shown(values)}", "expected a list of values")
            require(len(values) > 0, where, "is empty, so the cross has no runs", "add a value")
            require(path not in self.set, where, "is also a key of `set`", "remove one of the two")


@dataclass(frozen=True)
class ClaimConfig:
    """A claim that a grid can test: runs with some values are better than runs with other values."""

    claim: str
    """The claim in words."""
    better: Mapping[str, Any]
    """Path of a config key → value (as written in the grid) of the runs that should be better."""
    worse: Mapping[str, Any]
    """Path of a config key → value of the runs for comparison; a pair of runs agrees in all keys that neither `better`
    nor `worse` names."""
    harmless: bool = False
    """Whether the claim also holds if there is no difference."""


@dataclass(frozen=True)
class GridConfig:
    """The runs of an ablation and the claims that the runs test."""

    shipped: ClassVar[str] = "ablation"

    crosses: tuple[CrossConfig, ...]
    """Sets of runs, one after the other."""
    config: str = "paper"
    """Config of a fit that every run starts from: the name of a shipped config or the path of a YAML file."""
    claims: tuple[ClaimConfig, ...] = ()
    """Claims to test, in any number."""

    def __post_init__(self):
        require(len(self.crosses) > 0, "crosses", "is empty", "an ablation needs at least one cross")
        require_runs("crosses", [list(each.cross.values()) for each in self.crosses])


def require_runs(key: str, crosses: Sequence[Sequence[Sequence[Any]]]) -> None:
    """Check the number of runs of a grid before the runs are made.

    Args:
        key: the config key of the crosses, for messages.
        crosses: for each cross, the values of each of its keys.

    Raises:
        ConfigKeyError: more than `GRID_RUNS` runs.
    """
    runs = sum(math.prod(map(len, cross)) for cross in crosses)
    count = f"{runs:,}" if runs < 10**15 else "more than 10^15"
    require(runs <= GRID_RUNS, key, f"makes {count} runs", f"expected at most {GRID_RUNS:,}")
