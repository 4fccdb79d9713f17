"""What a fit can be told: frozen dataclasses, read from YAML files that hold overrides only."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import yaml

from jaxfit.config_checks import ConfigKeyError, check_config
from jaxfit.errors import InputError
from jaxfit.objective.objective import term_settings

__all__ = ["CropConfig", "FitConfig", "InitialiseConfig", "StageConfig", "config_to_yaml", "load_config"]


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
        check_config(self)

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
        InputError: an unreadable file, an unknown key, a value of the wrong kind, an unknown term; it names the
            file that holds the key, which may be a base.
    """
    values, origins = _read(str(source), seen=())
    try:
        return _build(FitConfig, values, "")
    except ConfigKeyError as error:
        raise InputError(_origin(origins, error.key, str(source)), error.problem, error.remedy) from None


def shipped_configs() -> list[str]:
    """Names of the configs that come with jaxfit."""
    folder = resources.files("jaxfit") / "configs"
    return sorted(f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml"))


def config_to_yaml(config: FitConfig) -> str:
    """The whole config, defaults included, as a YAML text that `load_config` reads back."""
    return yaml.safe_dump(_plain(config), sort_keys=False, allow_unicode=True)


def _read(source: str, seen: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, str]]:
    """A file laid over its bases, and for each key's path the file that it comes from."""
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
    values, origins = {}, {}
    if base is not None:
        beside = Path(source).parent / f"{base}"
        values, origins = _read(str(beside) if beside.is_file() else str(base), (*seen, source))
    for path, is_mapping in _paths(content):
        if not is_mapping:  # it replaces whatever stood there
            origins = {key: origin for key, origin in origins.items() if not key.startswith(f"{path}.")}
        origins[path] = source
    return _merge(values, content), origins


def _paths(content: dict[str, Any], where: str = "") -> Iterator[tuple[str, bool]]:
    """Path of every key, and whether a mapping stands there; lists are taken whole."""
    for key, value in content.items():
        yield f"{where}{key}", isinstance(value, dict)
        if isinstance(value, dict):
            yield from _paths(value, f"{where}{key}.")


def _origin(origins: Mapping[str, str], key: str, top: str) -> str:
    """The file that says `key`; of a key that no file says, the one that says what it should stand in."""
    while key and key not in origins:
        key = key[: max(key.rfind("."), key.rfind("["), 0)]
    return origins.get(key, top)


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def _build(kind: type, values: Any, where: str) -> Any:
    """A dataclass from plain values; every key and value is checked against its fields."""
    if not isinstance(values, dict):
        raise ConfigKeyError(
            where.rstrip("."), f"{where or 'the config'} must be a mapping, not {type(values).__name__}"
        )
    hints = typing.get_type_hints(kind)
    names = [f.name for f in dataclasses.fields(kind)]
    for key in values:
        if key not in names:
            raise ConfigKeyError(f"{where}{key}", f"unknown key `{where}{key}`", f"known here: {', '.join(names)}")
    for f in dataclasses.fields(kind):
        required = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if required and f.name not in values:
            raise ConfigKeyError(
                f"{where}{f.name}", f"`{where}{f.name}` is missing", "add it, or start from `base: paper`"
            )
    built = {key: _value(hints[key], value, f"{where}{key}") for key, value in values.items()}
    return kind(**built)


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, f"{where}.")
    if origin is Literal:
        if value not in arguments:
            raise ConfigKeyError(where, f"`{where}` is {value!r}", f"one of {', '.join(arguments)}")
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise ConfigKeyError(where, f"`{where}` must be a list, not {value!r}")
        return tuple(_value(arguments[0], v, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is types.UnionType:
        return tuple(value) if isinstance(value, list) else value
    if origin is Mapping:
        if not isinstance(value, dict):
            raise ConfigKeyError(where, f"`{where}` must be a mapping, not {value!r}")
        return {k: _value(arguments[1], v, f"{where}.{k}") for k, v in value.items()}
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Any:
        return value
    if not isinstance(value, hint) or (isinstance(value, bool) and hint is not bool):
        raise ConfigKeyError(where, f"`{where}` is {value!r}", f"a value of type {hint.__name__} is expected")
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
