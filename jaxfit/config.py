"""What a fit can be told: frozen dataclasses, read from YAML files that hold overrides only."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import yaml

from jaxfit.errors import InputError
from jaxfit.objective.objective import TERMS, term_settings

__all__ = ["CropConfig", "FitConfig", "InitialiseConfig", "StageConfig", "config_to_yaml", "load_config"]

PARAMETERS = ("global_orient", "body_pose", "transl", "scale", "bone_length", "betas")


@dataclass(frozen=True)
class CropConfig:
    """How a bird is cut from its frames; every fit works on square crops."""

    mode: Literal["box", "image"] = "box"
    """`box`: a square around the bird, of one size for the window, its centre following the bird.
    `image`: the whole image, which must then be square."""
    padding: float = 0.15
    """Margin on each side of the largest box of the window, as a share of its longer side."""
    size_px: int = 256
    """Side of the crop that the fit works on."""
    focal_px: float = 2167.0
    """Focal length of the crop camera; its centre is the middle of the crop."""


@dataclass(frozen=True)
class InitialiseConfig:
    """Where the fit starts when no starting point is given."""

    method: Literal["viewing_axis", "so3"] = "viewing_axis"
    """`viewing_axis`: seen from above, turned about the viewing axis (the paper's).
    `so3`: from any direction, for cameras that do not look down."""
    turns: int = 30
    """Equal turns about the viewing axis (30 turns of 12°)."""
    directions: int = 100
    """`so3` only: viewing directions spread over the sphere."""
    candidates: int = 64
    """Best orientations of each frame that enter the choice for the window as a whole."""
    smoothness: float = 400.0
    """Cost (squared pixels) of one radian of turning between consecutive frames in that choice."""
    hypotheses: int = 1
    """Distinct starts that are fitted side by side until a stage keeps the best of them."""


@dataclass(frozen=True)
class StageConfig:
    """One stretch of the fit: what is free, what pulls, for how many steps."""

    name: str
    """Shown in progress and results."""
    steps: int
    """Adam steps."""
    terms: tuple[str, ...]
    """Active terms, by name; their weights and settings stand in `terms` of the whole config."""
    free: tuple[str, ...] = ("global_orient", "body_pose", "transl", "scale")
    """Parameters that move: global_orient, body_pose, transl, scale, bone_length, betas."""
    learning_rate: float = 0.01
    """Adam's step size, in each parameter's own unit."""
    step_scale: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    """Factor on the step size of single parameters; three numbers for `transl` (x, y, z)."""
    blur: float = 1.0
    """Softness of the silhouette's edge relative to the usual one; below 1 is sharper."""
    keypoints_off: tuple[str, ...] = ()
    """Keypoints (by name) that this stage ignores; names that the model lacks are allowed."""
    override: Mapping[str, Any] = field(default_factory=dict)
    """Weights and settings of terms that differ in this stage: as in `terms` of the whole config."""
    carry_moments: bool = False
    """Whether Adam goes on with the moments of the stage before, instead of starting at zero."""
    keep_best: bool = False
    """Whether only the best hypothesis of each bird goes on after this stage."""


@dataclass(frozen=True)
class FitConfig:
    """Everything about a fit; the defaults are the paper's best setting."""

    stages: tuple[StageConfig, ...]
    """What is done, in this order."""
    terms: Mapping[str, Any]
    """Weight of each term, as a number, or `{weight: …, setting: …}` (sigma_px, beta_global, …)."""
    window: int = 100
    """Frames fitted at once; longer tracks are cut into windows, 1 fits every frame by itself."""
    common_size: bool = True
    """One scale for the whole window instead of one a frame."""
    filter_window: int = 5
    """Frames of the weighted median filter over detected keypoints; 1 switches it off."""
    min_keypoints: int = 4
    """Confident keypoints a frame needs to be fitted."""
    crop: CropConfig = CropConfig()
    initialise: InitialiseConfig = InitialiseConfig()
    backend: Literal["auto", "native", "reference"] = "auto"
    """Raster core: the compiled kernel, the pure-JAX reference, or whichever is there."""
    memory_gb: float = 3.0
    """Memory that one batch may take; more birds or frames are fitted in several batches."""

    def __post_init__(self):
        _check(self)

    def stage_settings(self, stage: StageConfig) -> dict[str, dict[str, float]]:
        """Weight and settings of each of a stage's terms: defaults, `terms`, then the stage's `override`."""
        settings = {}
        for name in stage.terms:
            values = {"weight": 1.0, **term_settings(name)}
            for source in (self.terms, stage.override):
                if name in source:
                    values |= _as_settings(source[name])
            settings[name] = values
        return settings


def load_config(source: str | Path) -> FitConfig:
    """Read a config by the name of a shipped one (`paper`) or the path of a YAML file.

    A file may name another as its `base`; what it then says is laid over it, key by key.

    Raises:
        InputError: an unreadable file, an unknown key, a value of the wrong kind, an unknown term.
    """
    return _build(FitConfig, _read(str(source), seen=()), str(source), "")


def shipped_configs() -> list[str]:
    """Names of the configs that come with jaxfit."""
    folder = resources.files("jaxfit") / "configs"
    return sorted(f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml"))


def config_to_yaml(config: FitConfig) -> str:
    """The whole config, defaults included, as a YAML text that `load_config` reads back."""
    return yaml.safe_dump(_plain(config), sort_keys=False, allow_unicode=True)


def _read(source: str, seen: tuple[str, ...]) -> dict[str, Any]:
    if source in seen:
        raise InputError(source, "`base` goes in a circle", " → ".join((*seen, source)))
    shipped = shipped_configs()
    try:
        if source in shipped:
            text = (resources.files("jaxfit") / "configs" / f"{source}.yaml").read_text(encoding="utf-8")
        else:
            text = Path(source).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            source, f"cannot read this config: {error}", f"give a YAML file or one of {', '.join(shipped)}"
        ) from None
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(source, f"is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise InputError(source, "holds no mapping of keys to values", "write `key: value` lines")
    base = content.pop("base", None)
    if base is None:
        return content
    beside = Path(source).parent / f"{base}"
    return _merge(_read(str(beside) if beside.is_file() else str(base), (*seen, source)), content)


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _build(kind: type, values: Any, source: str, where: str) -> Any:
    """A dataclass from plain values; every key and value is checked against its fields."""
    if not isinstance(values, dict):
        raise InputError(source, f"{where or 'the config'} must be a mapping, not {type(values).__name__}")
    hints = typing.get_type_hints(kind)
    names = [f.name for f in dataclasses.fields(kind)]
    for key in values:
        if key not in names:
            raise InputError(source, f"unknown key `{where}{key}`", f"known here: {', '.join(names)}")
    for f in dataclasses.fields(kind):
        required = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if required and f.name not in values:
            raise InputError(source, f"`{where}{f.name}` is missing", "add it, or start from `base: paper`")
    built = {key: _value(hints[key], value, source, f"{where}{key}") for key, value in values.items()}
    try:
        return kind(**built)
    except InputError as error:
        raise InputError(source, error.problem, error.remedy) from None


def _value(hint: Any, value: Any, source: str, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, source, f"{where}.")
    if origin is Literal:
        if value not in arguments:
            raise InputError(source, f"`{where}` is {value!r}", f"one of {', '.join(arguments)}")
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise InputError(source, f"`{where}` must be a list, not {value!r}")
        return tuple(_value(arguments[0], v, source, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is types.UnionType:
        return tuple(value) if isinstance(value, list) else value
    if origin is Mapping:
        if not isinstance(value, dict):
            raise InputError(source, f"`{where}` must be a mapping, not {value!r}")
        return {k: _value(arguments[1], v, source, f"{where}.{k}") for k, v in value.items()}
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Any:
        return value
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise InputError(source, f"`{where}` is {value!r}", f"a value of type {hint.__name__} is expected")
    return value


def _as_settings(value: Any) -> dict[str, float]:
    return {k: float(v) for k, v in (value if isinstance(value, dict) else {"weight": value}).items()}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(v) for v in value]
    return value


def _check(config: FitConfig) -> None:
    """What types alone do not say; wrong use raises InputError naming the key."""

    def require(holds: bool, key: str, problem: str, remedy: str = "") -> None:
        if not holds:
            raise InputError("config", f"`{key}` {problem}", remedy)

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
    _check_terms(require, "terms", config.terms)
    for i, stage in enumerate(config.stages):
        where = f"stages[{i}]"
        require(stage.steps >= 1, f"{where}.steps", f"is {stage.steps}", "1 or more")
        rate = stage.learning_rate
        require(0 < rate < math.inf, f"{where}.learning_rate", f"is {rate}", "above 0")
        require(0 < stage.blur < math.inf, f"{where}.blur", f"is {stage.blur}", "above 0")
        require(len(stage.terms) > 0, f"{where}.terms", "is empty", f"known: {', '.join(TERMS)}")
        for name in stage.terms:
            require(name in TERMS, f"{where}.terms", f"names {name!r}", f"known: {', '.join(TERMS)}")
        for key in ("free", "step_scale"):
            for name in getattr(stage, key):
                known = name in PARAMETERS
                require(known, f"{where}.{key}", f"names {name!r}", f"known: {', '.join(PARAMETERS)}")
        for name, factor in stage.step_scale.items():
            numbers = factor if isinstance(factor, tuple) else (factor,)
            fits = all(_is_number(n) for n in numbers) and len(numbers) in (1, 3)
            fits = fits and (len(numbers) == 1 or name == "transl")
            require(fits, f"{where}.step_scale.{name}", f"is {factor!r}", "a number, 0 or more; three for transl")
        _check_terms(require, f"{where}.override", stage.override)


def _check_terms(require: Any, where: str, terms: Mapping[str, Any]) -> None:
    for name, value in terms.items():
        require(name in TERMS, f"{where}.{name}", "is not a term", f"known: {', '.join(TERMS)}")
        known = ("weight", *term_settings(name))
        for key, number in (value if isinstance(value, dict) else {"weight": value}).items():
            place = f"{where}.{name}.{key}"
            require(key in known, place, "is not a setting of this term", f"known: {', '.join(known)}")
            require(_is_number(number), place, f"is {number!r}", "a number, 0 or more")
            # the robust term divides by it
            require(key != "sigma_px" or number > 0, place, f"is {number!r}", "above 0")


def _is_number(value: Any) -> bool:
    """A finite number, 0 or more; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf
