"""What a config must hold beyond the types of its fields."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxfit.config.yaml_file import ConfigKeyError, require
from jaxfit.errors import InputError
from jaxfit.objective.registry import Term, find_term, known_terms

if TYPE_CHECKING:
    from jaxfit.config.schema import FitConfig

__all__ = ["PARAMETERS", "check_config"]

PARAMETERS = ("global_orient", "body_pose", "transl", "scale", "bone_length", "betas")
"""What a stage may leave free."""


def check_config(config: FitConfig) -> None:
    """What types alone do not say.

    Raises:
        ConfigKeyError: a value that makes no fit.
    """
    require(config.window >= 1, "window", f"is {config.window}", "1 or more frames")
    odd = config.filter_window >= 1 and config.filter_window % 2 == 1
    require(odd, "filter_window", f"is {config.filter_window}", "an odd number of frames; 1 is off")
    require(config.crop.size_px >= 16, "crop.size_px", f"is {config.crop.size_px}", "16 or more")
    require(0 < config.crop.focal_px < math.inf, "crop.focal_px", f"is {config.crop.focal_px}", "above 0")
    require(0 <= config.crop.padding < math.inf, "crop.padding", f"is {config.crop.padding}", "0 or more")
    require(config.min_keypoints >= 1, "min_keypoints", f"is {config.min_keypoints}", "1 or more")
    require(0 < config.memory_gb < math.inf, "memory_gb", f"is {config.memory_gb}", "above 0")
    for key in ("turns", "directions", "candidates", "hypotheses"):
        value = getattr(config.initialise, key)
        require(value >= 1, f"initialise.{key}", f"is {value}", "1 or more")
    smoothness = config.initialise.smoothness
    require(0 <= smoothness < math.inf, "initialise.smoothness", f"is {smoothness}", "0 or more")
    require(len(config.stages) > 0, "stages", "is empty", "a fit needs a stage")
    _check_terms("terms", config.terms)
    for i, stage in enumerate(config.stages):
        where = f"stages[{i}]"
        require(stage.steps >= 1, f"{where}.steps", f"is {stage.steps}", "1 or more")
        rate = stage.learning_rate
        require(0 < rate < math.inf, f"{where}.learning_rate", f"is {rate}", "above 0")
        require(0 < stage.blur < math.inf, f"{where}.blur", f"is {stage.blur}", "above 0")
        require(len(stage.terms) > 0, f"{where}.terms", "is empty", f"known: {', '.join(known_terms())}")
        for name in stage.terms:
            _find(f"{where}.terms", f"names {name!r}", name)
        for key in ("optimised", "step_scale"):
            for name in getattr(stage, key):
                known = name in PARAMETERS
                require(known, f"{where}.{key}", f"names {name!r}", f"known: {', '.join(PARAMETERS)}")
        for name, factor in stage.step_scale.items():
            numbers = factor if isinstance(factor, tuple) else (factor,)
            fits = all(_is_number(n) for n in numbers) and len(numbers) in (1, 3)
            fits = fits and (len(numbers) == 1 or name == "transl")
            require(fits, f"{where}.step_scale.{name}", f"is {factor!r}", "a number, 0 or more; three for transl")
        _check_terms(f"{where}.override", stage.override)
        _check_solver(where, config, i)


def _check_solver(where: str, config: FitConfig, i: int) -> None:
    """What stage i asks of its solver."""
    stage = config.stages[i]
    if stage.carry_moments:
        adam = stage.solver == config.stages[max(i - 1, 0)].solver == "adam"
        require(adam, f"{where}.carry_moments", "is true", "only from one stage of Adam's to the next")
    if stage.solver == "levenberg_marquardt":
        for name in stage.terms:
            problem = f"is levenberg_marquardt, and the curvature of {name!r} is not known"
            remedy = "adam, or terms with a curvature such as keypoints, pose_prior, velocity, acceleration"
            require(find_term(name).curvature is not None, f"{where}.solver", problem, remedy)
        moved = [name for name in stage.optimised if name in ("bone_length", "betas")]
        problem = f"is levenberg_marquardt, which does not move {' and '.join(moved)}"
        require(not moved, f"{where}.solver", problem, "adam, or leave them out of `optimised`")


def _check_terms(where: str, terms: Mapping[str, Any]) -> None:
    for name, value in terms.items():
        term = _find(f"{where}.{name}", "is not a term", name)
        known = ("weight", *term.settings)
        for key, number in (value if isinstance(value, dict) else {"weight": value}).items():
            place = f"{where}.{name}.{key}"
            require(key in known, place, "is not a setting of this term", f"known: {', '.join(known)}")
            require(_is_number(number), place, f"is {number!r}", "a number, 0 or more")
            require(key not in term.positive or number > 0, place, f"is {number!r}", "above 0")


def _find(where: str, unknown: str, name: str) -> Term:
    try:
        return find_term(name)
    except KeyError:
        remedy = f"known: {', '.join(known_terms())}, or package.module:function"
        raise ConfigKeyError(where, f"`{where}` {unknown}", remedy) from None
    except InputError as error:
        raise ConfigKeyError(where, f"`{where}`: {error.source} {error.problem}", error.remedy) from error


def _is_number(value: Any) -> bool:
    """A finite number, 0 or more; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf
