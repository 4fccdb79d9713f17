"""Registry of features: jaxfit's own definitions, those of other packages, and those of a notebook."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, overload

import numpy as np
from jaxtyping import Float

from jaxfit.behaviour.birds import Birds, times_known
from jaxfit.config.checks import known_names
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.plugins import entry_points, import_object

ENTRY_POINTS = "jaxfit.features"
"""The entry-point group with which an installed package provides features."""
FORM = "a feature has the form `def name(birds): …` and returns an array with a value for each bird and frame"
UNITS = {
    "deg": ("deg", "°"),
    "deg/s": ("deg_s", "°/s"),
    "Hz": ("hz", "Hz"),
    "length": ("{length}", "{length}"),
    "length/s": ("{length}_s", "{length}/s"),
    "1": ("", ""),
    "id": ("", ""),
}
"""Unit of a feature → end of its column name, and the unit as people read it; lengths: `m`, or `bl`, body lengths.

Values of the unit `id` are positions of birds in `Birds.track_id`; tables hold the tracks at these positions.
"""
NEEDS = {
    "level": "the vertical is unknown",
    "ledge": "the ledge is unknown",
    "time": "the times of the frames are unknown, or there is one frame",
    "neighbours": "the result has one bird, or photographs",
}
"""What a feature may need of a result → what the command says where it is missing."""
MODULES = ("posture", "wings", "motion", "neighbours")
"""Modules of this package with jaxfit's own features, in the order of the columns."""

Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True, eq=False)
class Feature:
    """A value of each bird in each frame: a pure function of `Birds`, and its properties."""

    name: str
    function: Callable[[Birds], Float[np.ndarray, "N T"]]
    unit: str
    """A key of `UNITS`."""
    keypoints: tuple[str, ...]
    """Keypoints of the model that the function uses."""
    joints: tuple[str, ...]
    """Joints of the model that the function uses."""
    needs: tuple[str, ...]
    """Keys of `NEEDS`."""
    circular: bool
    """Whether the values are directions, 180° next to −180°."""

    @property
    def of_one_frame(self) -> bool:
        """Whether the value of a frame depends on the poses of this frame only."""
        return "time" not in self.needs

    @property
    def definition(self) -> str:
        """The definition for people: the docstring of the function, without the line breaks."""
        return " ".join((inspect.getdoc(self.function) or "").split())

    def column(self, length: str) -> str:
        """Return the name of the column, with its unit.

        Args:
            length: the unit of lengths, `m` or `bl`.
        """
        end = UNITS[self.unit][0].format(length=length)
        return f"{self.name}_{end}" if end else self.name

    def shown_unit(self, length: str) -> str:
        """Return the unit as people read it."""
        return UNITS[self.unit][1].format(length={"bl": "body lengths"}.get(length, length))

    def missing(self, birds: Birds) -> str | None:
        """Return why birds do not have this feature; None if they have it."""
        for kind, wanted, known in (
            ("keypoint", self.keypoints, birds.keypoint_names),
            ("joint", self.joints, birds.joint_names),
        ):
            absent = [name for name in wanted if name not in known]
            if absent:
                return f"the model has no {kind} {absent[0]}"
        there = {
            "level": birds.level,
            "ledge": bool(np.isfinite(birds.contact).any()),
            "time": times_known(birds.time_s),
            "neighbours": birds.together and len(birds.track_id) > 1,
        }
        return next((NEEDS[need] for need in self.needs if not there[need]), None)


_features: dict[str, Feature] = {}
_imported: dict[str, Feature] = {}
"""Features that no decorator registered, by the name or path that they were looked up by."""


@overload
def feature(function: Function, /) -> Function: ...
@overload
def feature(
    *,
    unit: str = "1",
    keypoints: Sequence[str] = (),
    joints: Sequence[str] = (),
    needs: Collection[str] = (),
    circular: bool = False,
    name: str | None = None,
) -> Callable[[Function], Function]: ...
def feature(function=None, /, *, unit="1", keypoints=(), joints=(), needs=(), circular=False, name=None):
    """Register a feature: a pure function of `Birds` that returns a value of each bird in each frame.

    After `@feature(unit="deg", keypoints=("left_eye", "right_eye")) def head_roll(birds): …`, the command `describe
    --feature module:head_roll` has the column `head_roll_deg`. The docstring is the definition that tables state. The
    decorator returns the function unchanged.

    Args:
        function: takes `Birds` and returns (N, T), NaN where the value is not defined.
        unit: a key of `UNITS`; angles are in degrees, lengths in the unit of the birds.
        keypoints, joints: names that the function uses. A model without them has no such column.
        needs: keys of `NEEDS`. A function that compares frames needs `time`.
        circular: whether the values are directions, 180° next to −180°.
        name: name of the feature (default: the name of the function).

    Raises:
        InputError: the function does not have the form of a feature, or a feature of another module has this name. A
            module may register its own names again, as a notebook does when a cell runs a second time.
    """

    def register(function):
        new = _feature_of(name or function.__name__, function, unit, keypoints, joints, needs, circular)
        existing = _features.get(new.name)
        if existing is not None and existing.function.__module__ != function.__module__:
            problem = f"is already the name of a feature of {existing.function.__module__}"
            raise InputError(f"feature {new.name!r}", problem, "choose another name")
        _features[new.name] = new
        return function

    return register if function is None else register(function)


def own_features() -> list[Feature]:
    """Return jaxfit's own features, in the order of their columns."""
    for module in MODULES:
        importlib.import_module(f"jaxfit.behaviour.{module}")
    own = {f"jaxfit.behaviour.{module}" for module in MODULES}
    return [each for each in _features.values() if each.function.__module__ in own]


def find_feature(name: str) -> Feature:
    """Return a feature by its registered name, by an entry point of the group `jaxfit.features`, or by its path.

    The path is `package.module:function`. Such a function needs the decorator only if its values have a unit, or if it
    uses keypoints, joints or times.

    Raises:
        InputError: no feature has this name, the module cannot be imported or has no such function, or the function
            does not have the form of a feature.
    """
    own_features()
    if name in _features or name in _imported:
        return _features.get(name) or _imported[name]
    path = name if ":" in name else entry_points(ENTRY_POINTS).get(name)
    if path is None:
        remedy = f"{known_names(name, _features)}; or package.module:function"
        raise InputError(f"feature {name!r}", "is not known", remedy)
    function = import_object(f"feature {name!r}", path)
    known = next((each for each in _features.values() if each.function is function), None)
    _imported[name] = known or _feature_of(path.rpartition(":")[2] if ":" in name else name, function)
    return _imported[name]


def _feature_of(
    name: str,
    function: Any,
    unit: str = "1",
    keypoints: Sequence[str] = (),
    joints: Sequence[str] = (),
    needs: Collection[str] = (),
    circular: bool = False,
) -> Feature:
    """Return the feature of a function.

    Raises:
        InputError: the function does not have the form of a feature.
    """

    def require(holds: bool, problem: str, remedy: str = FORM) -> None:
        if not holds:
            raise InputError(f"feature {name!r}", problem, remedy)

    require(callable(function), f"is not a function but a {type(function).__name__}")
    for kind, given in (("keypoints", keypoints), ("joints", joints), ("needs", needs)):
        require(not isinstance(given, str), f"has {kind} {given!r}, a text", f"give a tuple: {kind}=({given!r},)")
    require(str(name).isidentifier(), "is not a name that a column can have", "use letters, digits and _")
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # some built-in functions have no signature
        parameters = []
    further = [each for each in parameters[1:] if each.default is each.empty and each.kind < each.VAR_POSITIONAL]
    require(bool(parameters) and not further, "does not take the birds as its only argument")
    require(unit in UNITS, f"has the unit {unit!r}", f"choose one of: {', '.join(UNITS)}")
    unknown = sorted(set(needs) - set(NEEDS))
    require(not unknown, f"needs {', '.join(map(repr, unknown))}", f"choose of: {', '.join(NEEDS)}")
    return Feature(name, function, unit, tuple(keypoints), tuple(joints), tuple(needs), circular)
