"""A grid of runs: values of config keys, crossed."""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxfit.config import FitConfig, load_config
from jaxfit.config_file import ConfigKeyError, read_config, require
from jaxfit.config_paths import get_value, with_values
from jaxfit.errors import InputError

__all__ = ["CrossConfig", "GridConfig", "Run", "load_grid"]

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CrossConfig:
    """Runs that are every combination of some values."""

    cross: Mapping[str, Any]
    """Path of a config key → its values; the last key changes fastest. `=path` stands for the value there."""
    set: Mapping[str, Any] = field(default_factory=dict)
    """Path of a config key → the value that all of these runs have."""


@dataclass(frozen=True)
class GridConfig:
    """What an ablation runs."""

    crosses: tuple[CrossConfig, ...]
    """One after the other."""
    config: str = "paper"
    """The config of a fit that every run starts from: a shipped one's name or a YAML file's path."""

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
    """One point of a grid."""

    name: str
    """Made from the varied values; a folder's name."""
    varied: Mapping[str, Any]
    """The values of all keys that differ between runs of the grid, by their paths."""
    config: FitConfig


def load_grid(source: str | Path) -> list[Run]:
    """Read a grid by the name of the shipped one (`ablation`) or the path of a YAML file, and cross it.

    Runs that come out equal are one.

    Raises:
        InputError: an unreadable file, an unknown key, a value that makes no sense, a cross without a run.
    """
    grid = read_config(GridConfig, source, "ablation")
    base = load_config(grid.config)
    configs: list[FitConfig] = []
    paths: dict[str, None] = {}
    for i, each in enumerate(grid.crosses):
        paths |= dict.fromkeys((*each.set, *each.cross))
        for values in itertools.product(*each.cross.values()):
            try:
                config = with_values(base, {**each.set, **dict(zip(each.cross, values, strict=True))})
            except ConfigKeyError as error:
                raise InputError(source, f"crosses[{i}]: {error.problem}", error.remedy) from None
            if config in configs:
                _logger.warning("%s: two runs are the same (%s): kept once", source, dict(zip(each.cross, values)))
            else:
                configs.append(config)
    values = {path: [get_value(config, path) for config in configs] for path in paths}
    varied = {path: each for path, each in values.items() if any(value != each[0] for value in each)}
    runs = [
        Run(_name({path: each[r] for path, each in varied.items()}), {p: v[r] for p, v in varied.items()}, config)
        for r, config in enumerate(configs)
    ]
    return [Run(f"{r + 1:0{len(str(len(runs)))}d}_{run.name}", run.varied, run.config) for r, run in enumerate(runs)]


def _name(varied: Mapping[str, Any]) -> str:
    parts = [f"{path.rpartition('.')[2]}={_short(value)}" for path, value in varied.items()]
    return re.sub(r"[^\w.,=+-]", "-", ",".join(parts))[:120] or "only"


def _short(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value).lower()
    return re.sub(r"e\+?(-?)0*", r"e\1", f"{value:g}")
