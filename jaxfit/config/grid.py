"""Settings of an ablation: the runs of a grid, and the claims that the runs test."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from jaxfit.config.checks import require

__all__ = ["ClaimConfig", "CrossConfig", "GridConfig"]


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
            require(isinstance(values, list), where, f"is {values!r}", "expected a list of values")
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
