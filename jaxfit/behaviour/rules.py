"""Keys of a behaviour config: the rules by which bouts of behaviour are found."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import field
from math import inf, isfinite
from pathlib import Path
from typing import ClassVar, NamedTuple

from pydantic import NonNegativeFloat

from jaxfit.behaviour.registry import Feature, find_feature
from jaxfit.config.build import config_dataclass
from jaxfit.config.checks import ConfigKeyError, require
from jaxfit.config.yaml_file import read_config
from jaxfit.foundation.errors import InputError

OTHER = "other"
"""State of a bird that shows no behaviour of the config."""
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_BETWEEN = re.compile(rf"\s*({_NUMBER}) to ({_NUMBER})\s*")
_BEYOND = re.compile(rf"\s*([<>])\s*({_NUMBER})\s*")


class Range(NamedTuple):
    """Values that a condition accepts."""

    low: float
    high: float


def read_range(text: str) -> Range | None:
    """Return the range of a condition: `> 3`, `< 3` or `-3 to 3`; None for another text."""
    if between := _BETWEEN.fullmatch(text):
        low, high = float(between[1]), float(between[2])
        return Range(low, high) if -inf < low < high < inf else None
    beyond = _BEYOND.fullmatch(text)
    if beyond and isfinite(limit := float(beyond[2])):
        return Range(limit, inf) if beyond[1] == ">" else Range(-inf, limit)
    return None


@config_dataclass
class BehaviourRule:
    """When a bird shows a behaviour."""

    definition: str
    """One sentence for people."""
    begins: Mapping[str, str] = field(default_factory=dict)
    """Feature → condition: `> 3`, `< 3` or `-3 to 3`. A bout has at least one frame with all these conditions. Lengths
    are in body lengths."""
    lasts: Mapping[str, str] | None = None
    """Feature → condition, in all frames of a bout; null: as `begins`."""
    start_of: str | None = None
    """Instead of conditions: the start of each bout of this behaviour, if the bird was seen before it."""
    end_of: str | None = None
    """Instead of conditions: the end of each bout of this behaviour, if the bird is seen after it."""
    around_s: NonNegativeFloat = 0.3
    """With `start_of` and `end_of`: time before and after the start or the end, seconds."""
    least_s: NonNegativeFloat = 0.0
    """Shorter bouts do not count, seconds."""
    bridge_s: NonNegativeFloat = 0.2
    """Shorter interruptions, also without a pose, are part of the bout, seconds. With `start_of` and `end_of`: longest
    pause of the video between both sides of the start or the end."""
    partner: bool = False
    """Whether the nearest neighbour is the partner of the behaviour."""

    def __post_init__(self):
        require(bool(self.definition.strip()), "definition", "is empty", "say in one sentence what the bird does")
        ways = [bool(self.begins), self.start_of is not None, self.end_of is not None]
        remedy = "give one of them; `begins: {}` and `start_of: null` leave out what the base gives"
        require(sum(ways) == 1, "", f"has {sum(ways)} of begins, start_of and end_of", remedy)
        require(bool(self.begins) or self.lasts is None, "lasts", "is given without begins", "give begins, or no lasts")
        _check_conditions("begins", self.begins)
        _check_conditions("lasts", self.lasts or {})

    def conditions(self) -> tuple[dict[str, Range], dict[str, Range]]:
        """Return feature → range, of `begins` and of `lasts`."""
        lasts = self.begins if self.lasts is None else self.lasts

        def ranges(conditions: Mapping[str, str]) -> dict[str, Range]:
            found = {find_feature(name).name: read_range(text) for name, text in conditions.items()}
            return {name: limits for name, limits in found.items() if limits}

        return ranges(self.begins), ranges(lasts)


def _check_conditions(key: str, conditions: Mapping[str, str]) -> None:
    """Raise ConfigKeyError if a condition cannot be read, or if two conditions have features of one name."""
    names: list[str] = []
    for name, text in conditions.items():
        path, found = f"{key}.{name}", read_range(text)
        require(found is not None, path, f"is {text!r}", "write for example '> 3', '< 3' or '-3 to 3'")
        try:
            names.append(find_feature(name).name)
        except InputError as error:
            raise ConfigKeyError(path, f"cannot be used: {error.source}: {error.problem}", error.remedy) from None
        problem = f"is a condition of the feature {names[-1]!r}, which is defined twice"
        require(names.count(names[-1]) == 1, path, problem, "remove one condition, or rename one of the functions")


@config_dataclass
class BehaviourConfig:
    """The behaviours that jaxfit distinguishes. A frame in which several apply has the first of them."""

    shipped: ClassVar[str] = "behaviour"
    whole: ClassVar[tuple[str, ...]] = ("begins", "lasts")
    """Keys whose mapping replaces that of the base: conditions that a user does not see must not stay."""
    removable: ClassVar[str] = "behaviours"
    """Key of the mapping from which null removes an entry of the base."""

    behaviours: Mapping[str, BehaviourRule]
    """Name → rule, the most important behaviour first."""

    def __post_init__(self):
        require(len(self.behaviours) > 0, "behaviours", "has no rules", "give at least one")
        for name, rule in self.behaviours.items():
            path = f"behaviours.{name}"
            require(re.fullmatch(r"[a-z][a-z0-9_]*", name) is not None, path, "is no name", "use a to z, 0 to 9 and _")
            require(name != OTHER, path, "is the name of frames without a behaviour", "choose another name")
            for key in ("start_of", "end_of"):
                other = getattr(rule, key)
                known = other is None or (other in self.behaviours and bool(self.behaviours[other].begins))
                problem = f"names {other!r}, which is no behaviour with begins"
                require(known, f"{path}.{key}", problem, f"name another behaviour, or remove {name} by `{name}: null`")

    @property
    def features(self) -> tuple[Feature, ...]:
        """The features of all conditions."""
        rules = self.behaviours.values()
        names = dict.fromkeys(name for rule in rules for part in (rule.begins, rule.lasts or {}) for name in part)
        return tuple(dict.fromkeys(map(find_feature, names)))


def load_behaviour_config(source: str | Path = "behaviour") -> BehaviourConfig:
    """Read a behaviour config.

    Args:
        source: the name of a shipped config (`behaviour`) or the path of a YAML file, which may name a `base`.

    Raises:
        InputError: see `jaxfit.config.yaml_file.read_config`.

    A rule of the file replaces the keys of a rule of the base; `begins` and `lasts` are replaced as a whole, and null
    instead of a rule removes that of the base.
    """
    return read_config(BehaviourConfig, source)
