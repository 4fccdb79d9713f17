"""Grids of configs, crossed into runs; their keys."""

from __future__ import annotations

import itertools
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from jaxfit.config.build import config_dataclass, get_value, get_values, plain_config, with_values
from jaxfit.config.checks import ConfigKeyError, known_names, require, shown
from jaxfit.config.fit import FitConfig, load_config
from jaxfit.config.yaml_file import read_config
from jaxfit.foundation.errors import InputError, one_line, shortened

GRID_RUNS = 10_000
"""Most runs of a grid or a sweep. The grid of the paper has 34 runs."""


@config_dataclass
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


@config_dataclass
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


@config_dataclass
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


_logger = logging.getLogger(__name__)


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


def load_grid(source: str | Path) -> tuple[tuple[Run, ...], tuple[ClaimConfig, ...]]:
    """Read a grid file and return its runs and its claims. Runs with equal configs are merged.

    Args:
        source: `ablation`, the name of the shipped grid, or the path of a YAML file.

    Raises:
        InputError: the file cannot be read, a key is unknown, a value is invalid, a cross has no run, or a claim is
            about a key that does not vary.
    """
    grid = read_config(GridConfig, source)
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
                raise InputError(source, problem, known_names(path, runs[0].levels))
    return runs, grid.claims


def cross(base: FitConfig, points: Sequence[Mapping[str, Any]], source: object) -> tuple[Run, ...]:
    """Return a run for each point; runs with equal configs are merged.

    Args:
        base: the config that every run starts from. Weights are not learnt before a fit, because runs vary weights.
        points: for each run, path of a config key → value that replaces the value of the base.
        source: the grid file, for error messages.

    Raises:
        InputError: a key is unknown, or a value is invalid.
    """
    if base.learns_first:
        _logger.warning("%s: the runs learn no weights, because an ablation sets the weights itself", source)
        base = replace(base, learn_weights=())
    kept: dict[Any, tuple[FitConfig, Mapping[str, Any]]] = {}
    repeated = []
    for point in points:
        try:
            config = with_values(base, point)
        except ConfigKeyError as error:
            raise InputError(source, error.problem, error.remedy) from None
        if kept.setdefault(_hashable(plain_config(config)), (config, point))[0] is not config:
            repeated.append(point)
    if repeated:
        text = shortened(one_line(dict(repeated[0])), 100)
        times = f"{len(repeated)} times, " if len(repeated) > 1 else ""
        _logger.warning("%s: %stwo runs have the same config, one run is kept: %s", source, times, text)
    configs = [config for config, _ in kept.values()]
    written = [point for _, point in kept.values()]
    paths = dict.fromkeys(path for point in written for path in point)
    try:
        values = [get_values(config, paths) for config in configs]
    except ConfigKeyError as error:  # a run renames a stage that a path of another run names
        raise InputError(source, error.problem, error.remedy) from None
    varied = [path for path in paths if any(each[path] != values[0][path] for each in values)]
    digits = len(str(len(configs)))
    return tuple(
        Run(
            f"{r + 1:0{digits}d}_{_name({path: values[r][path] for path in varied})}",
            {path: written[r].get(path, values[r][path]) for path in varied},
            config,
        )
        for r, config in enumerate(configs)
    )


def _name(values: Mapping[str, Any]) -> str:
    parts = [f"{path.rpartition('.')[2]}={short(value)}" for path, value in values.items()]
    # ASCII only: a file name has at most 255 bytes
    return re.sub(r"[^\w.,=+-]", "-", ",".join(parts), flags=re.ASCII)[:120] or "only"


def _hashable(plain: Any) -> Any:
    """Return a value that can be a key and is equal for equal plain values of `plain_config`."""
    if isinstance(plain, dict):
        return frozenset((key, _hashable(value)) for key, value in plain.items())
    return tuple(map(_hashable, plain)) if isinstance(plain, list) else plain


def short(value: Any) -> str:
    """Return a short text of a value: 10000, 1e6, true."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value).lower()
    return re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")
