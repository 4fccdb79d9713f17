"""A grid of runs: all combinations of values of config keys."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxfit.config.paths import get_value, with_values
from jaxfit.config.schema import FitConfig, load_config
from jaxfit.config.yaml_file import ConfigKeyError, read_config, require
from jaxfit.errors import InputError

__all__ = ["ClaimConfig", "CrossConfig", "Grid", "GridConfig", "Run", "cross", "load_grid", "short"]

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CrossConfig:
    """Runs that are every combination of some values."""

    cross: Mapping[str, Any]
    """Path of a config key → its values; the last key changes fastest. `=path` stands for the value there."""
    set: Mapping[str, Any] = field(default_factory=dict)
    """Path of a config key → the value that all of these runs have."""


@dataclass(frozen=True)
class ClaimConfig:
    """Something that a grid can show: runs of one kind are better than runs of another."""

    claim: str
    """In words."""
    better: Mapping[str, Any]
    """Path of a config key → the value, as the grid writes it, of those that should be better."""
    worse: Mapping[str, Any]
    """The same of those that they are compared with: runs with equal values of all keys that neither names."""
    harmless: bool = False
    """Whether no difference is enough."""


@dataclass(frozen=True)
class GridConfig:
    """What an ablation runs, and what it is to show."""

    crosses: tuple[CrossConfig, ...]
    """One after the other."""
    config: str = "paper"
    """The config of a fit that every run starts from: a shipped one's name or a YAML file's path."""
    claims: tuple[ClaimConfig, ...] = ()
    """What to compare; any number, in words of one's own."""

    def __post_init__(self):
        require(len(self.crosses) > 0, "crosses", "is empty", "an ablation needs a cross")
        for i, each in enumerate(self.crosses):
            require(len(each.cross) > 0, f"crosses[{i}].cross", "is empty", "name a key and its values")
            for path, values in each.cross.items():
                where = f"crosses[{i}].cross.{path}"
                require(isinstance(values, list), where, f"is {values!r}", "a list of values is expected")
                require(len(values) > 0, where, "is empty, so that the cross has no run", "give it a value")
                require(path not in each.set, where, "stands in `set` too", "keep one of them")


@dataclass(frozen=True)
class Run:
    """One config of a grid."""

    name: str
    """Made from the position and the varied values; also the name of the folder of the run."""
    levels: Mapping[str, Any]
    """Path of every key that differs between runs → its value, as the grid file writes it (also as `=path`)."""
    config: FitConfig

    def value(self, path: str) -> Any:
        """Return the value of a key in the config of this run."""
        return get_value(self.config, path)


@dataclass(frozen=True)
class Grid:
    """The runs and claims of a grid."""

    runs: tuple[Run, ...]
    claims: tuple[ClaimConfig, ...]


def load_grid(source: str | Path) -> Grid:
    """Read a grid file and return its runs and claims.

    Runs with equal configs are merged.

    Args:
        source: `ablation`, the name of the shipped grid, or the path of a YAML file.

    Raises:
        InputError: the file cannot be read, a key is unknown, a value is invalid, a cross has no run, or a claim is
            about a key that does not vary.
    """
    grid = read_config(GridConfig, source, "ablation")
    base = load_config(grid.config)
    levels = [
        {**each.set, **dict(zip(each.cross, values, strict=True))}
        for each in grid.crosses
        for values in itertools.product(*each.cross.values())
    ]
    runs = cross(base, levels, source)
    for i, claim in enumerate(grid.claims):
        for path in (*claim.better, *claim.worse):
            if path not in runs[0].levels:
                problem = f"`claims[{i}]` is about `{path}`, which does not vary"
                raise InputError(source, problem, f"these do: {', '.join(runs[0].levels)}")
    return Grid(runs, grid.claims)


def cross(base: FitConfig, points: Sequence[Mapping[str, Any]], source: object) -> tuple[Run, ...]:
    """Return a run for each point; runs with equal configs are merged.

    Args:
        base: the config that every run starts from.
        points: for each run, path of a config key → value that replaces the value of the base.
        source: the grid file, for error messages.

    Raises:
        InputError: a key is unknown, or a value is invalid.
    """
    configs: list[FitConfig] = []
    kept: list[Mapping[str, Any]] = []
    for point in points:
        try:
            config = with_values(base, point)
        except ConfigKeyError as error:
            raise InputError(source, error.problem, error.remedy) from None
        if config in configs:
            _logger.warning("%s: two runs have the same config, one run is kept: %s", source, point)
        else:
            configs.append(config)
            kept.append(point)
    paths = dict.fromkeys(path for point in kept for path in point)
    values = {path: [get_value(config, path) for config in configs] for path in paths}
    varied = [path for path, each in values.items() if any(value != each[0] for value in each)]
    digits = len(str(len(configs)))
    return tuple(
        Run(
            f"{r + 1:0{digits}d}_{_name({path: values[path][r] for path in varied})}",
            {path: kept[r].get(path, values[path][r]) for path in varied},
            config,
        )
        for r, config in enumerate(configs)
    )


def _name(values: Mapping[str, Any]) -> str:
    parts = [f"{path.rpartition('.')[2]}={short(value)}" for path, value in values.items()]
    return re.sub(r"[^\w.,=+-]", "-", ",".join(parts))[:120] or "only"


def short(value: Any) -> str:
    """Return a short text of a value: 10000, 1e6, true."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value).lower()
    return re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")
