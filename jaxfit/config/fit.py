"""Keys of a fit: crops, initial poses, stages, terms, batches."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from annotated_types import Ge, MinLen
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from jaxfit.config.build import config_dataclass
from jaxfit.config.checks import ConfigKeyError, known_names, require, shown
from jaxfit.config.yaml_file import read_config, shipped_comment, shipped_configs
from jaxfit.foundation.errors import InputError
from jaxfit.objective.registry import Term, find_term, known_terms


def check_terms(key: str, terms: Mapping[str, Any]) -> None:
    """Check a mapping of term names to weights, or to weights and settings.

    Args:
        key: the config key of the mapping, for messages.
        terms: term name → weight, or → `{weight: …, setting: …}`.

    Raises:
        ConfigKeyError: an unknown term or setting, or a value that is not a number, 0 or more.
    """
    for name, value in terms.items():
        term = require_term(f"{key}.{name}", name)
        known = ("weight", *term.settings)
        for setting, number in (value if isinstance(value, dict) else {"weight": value}).items():
            path = f"{key}.{name}.{setting}"
            if setting not in known:
                raise ConfigKeyError(path, "is not a setting of this term", known_names(setting, known))
            is_number = isinstance(number, int | float) and not isinstance(number, bool)
            require(
                is_number and 0 <= number <= sys.float_info.max,
                path,
                f"is {shown(number)}",
                "expected a number, 0 or more",
            )
            require(setting not in term.positive or number > 0, path, f"is {number!r}", "expected a number above 0")


def require_term(key: str, name: str) -> Term:
    """Return the term of a name.

    Args:
        key: the config key that holds the name, for messages.
        name: a registered term, or `package.module:function`.

    Raises:
        ConfigKeyError: there is no such term, or the term cannot be imported.
    """
    try:
        return find_term(name)
    except KeyError:
        remedy = f"{known_names(name, known_terms())}; or package.module:function"
        raise ConfigKeyError(key, f"names an unknown term {name!r}", remedy) from None
    except InputError as error:
        raise ConfigKeyError(key, f"names a {error.source}, which {error.problem}", error.remedy) from error


def term_settings(value: Any) -> dict[str, float]:
    """Return the settings that a config gives for a term; a plain number is the term's weight."""
    return {key: float(number) for key, number in (value if isinstance(value, dict) else {"weight": value}).items()}


Parameter = Literal["global_orient", "body_pose", "transl", "scale", "bone_length", "betas"]
"""A parameter of a pose that a stage can optimise."""
GROUPS = ("published settings to reproduce", "settings to use")
"""Groups of shipped configs of fits."""


@config_dataclass
class CropConfig:
    """The square crops of a bird that the fit works on."""

    mode: Literal["box", "image"] = "box"
    """`box`: a square around the bird; its size is constant in a window and its centre follows the bird.
    `image`: the whole image, where all images of a window are square and of one size; else as `box`."""
    padding: NonNegativeFloat = 0.15
    """Margin on each side of the window's largest box, as a fraction of the box's longer side."""
    size_px: Annotated[int, Ge(16)] = 256
    """Side of the crops in which silhouettes and masks are compared, in pixels. All other quantities in pixels refer to
    a 256-pixel crop, so that this setting does not change the objective."""
    focal_px: PositiveFloat = 2167.0
    """Focal length of the crop camera, in pixels of a 256-pixel crop; the principal point is the middle of the crop."""


@config_dataclass
class InitialiseConfig:
    """The search for initial poses, for a fit without given initial poses."""

    method: Literal["viewing_axis", "so3", "auto"] = "viewing_axis"
    """`viewing_axis`: the bird is seen from above and is rotated about the viewing axis (the paper's method).
    `so3`: all orientations, for cameras that do not look down. `auto`: `so3` for the tracks whose frames show that the
    bird is not seen from above, else `viewing_axis`."""
    turns: PositiveInt = 30
    """Number of equal rotations about the viewing axis (30 rotations of 12°)."""
    directions: PositiveInt = 100
    """Number of viewing directions on the sphere; only for `so3` and `auto`."""
    candidates: PositiveInt = 64
    """Number of best orientations per frame from which the sequence of the window is chosen."""
    smoothness: NonNegativeFloat = 400.0
    """Cost of a rotation of 1 radian between consecutive frames in the choice of the sequence, in squared pixels of a
    256-pixel crop."""
    hypotheses: PositiveInt = 1
    """Number of distinct initial poses that are fitted side by side until a stage with `keep_best` ends."""


@config_dataclass
class StageConfig:
    """One stage of the fit: the optimised parameters, the active terms and the number of steps."""

    name: str
    """Name in progress messages and results."""
    steps: PositiveInt
    """Number of steps of the solver."""
    terms: Annotated[tuple[str, ...], MinLen(1)]
    """Names of the active terms; the key `terms` of the whole config holds their weights and settings."""
    optimised: tuple[Parameter, ...] = ("global_orient", "body_pose", "transl", "scale")
    """Optimised parameters: global_orient, body_pose, transl, scale, bone_length, betas."""
    solver: Literal["adam", "levenberg_marquardt"] = "adam"
    """`adam`: for all terms. `levenberg_marquardt`: needs 10 to 30 steps instead of hundreds; all terms of the library,
    and terms of others that return residuals (docs/developers/term.md)."""
    learning_rate: PositiveFloat = 0.01
    """Adam's step size, in each parameter's own unit."""
    step_scale: Mapping[Parameter, NonNegativeFloat | tuple[NonNegativeFloat, ...]] = field(default_factory=dict)
    """Parameter → factor on its step size; `transl` may have three factors (x, y, z). 0 keeps a parameter fixed, for
    both solvers."""
    blur: PositiveFloat = 1.0
    """Blur of the silhouette's edge relative to the paper's blur; a value below 1 is sharper."""
    keypoints_off: tuple[str, ...] = ()
    """Names of keypoints that this stage ignores; names that the model lacks are allowed."""
    override: Mapping[str, Any] = field(default_factory=dict)
    """Weights and settings of terms that differ in this stage, in the form of `terms` of the whole config."""
    carry_moments: bool = False
    """Whether Adam starts with the moments of the previous stage instead of zeros."""
    keep_best: bool = False
    """Whether only the best hypothesis of each bird continues after this stage."""
    share_body: bool | Literal["species"] = False
    """Whether the bone lengths and the shape that this stage optimises in every window become one body for each track
    (docs/method/bodies.md). The later stages keep the body. `species`: the bodies of tracks of one species, such as
    photographs, are also similar, as far as the data say. Most windows of a long track skip this stage and the stages
    from the first with masks on, so the later stages need enough steps without them."""

    def __post_init__(self):
        for name in self.terms:
            require_term("terms", name)
        for name, factor in self.step_scale.items():
            valid = not isinstance(factor, tuple) or len(factor) == 1 or (len(factor) == 3 and name == "transl")
            expected = "expected a number, 0 or more; `transl` may have three"
            require(valid, f"step_scale.{name}", f"is {shown(factor)}", expected)
        check_terms("override", self.override)


Learnable = Literal["keypoint_likelihood", "mask_smooth_l1", "keypoint_offsets"]
"""A term whose scale or weight can be learnt from the data, or the key `keypoint_offsets`."""


@config_dataclass
class FitConfig:
    """All settings of a fit; the defaults are the paper's best setting."""

    shipped: ClassVar[str] = "paper"
    removed: ClassVar[Mapping[str, str]] = {"grow_masks_px": "remove the key and set `edge: unbiased`"}
    """Keys of earlier versions → what to do."""

    stages: Annotated[tuple[StageConfig, ...], MinLen(1)]
    """The stages of the fit, in their order."""
    terms: Mapping[str, Any]
    """Weight of each term, as a number, or as `{weight: …, setting: …}` with settings such as sigma_px (in pixels of
    a 256-pixel crop)."""
    window: PositiveInt = 100
    """Number of frames that are fitted together; longer tracks are cut into windows, and 1 fits every frame alone."""
    overlap: NonNegativeInt = 0
    """Number of frames that consecutive windows of a track share; never more than half of `window`. The poses of these
    frames pass gradually from one window to the next, so that a bird does not jump from window to window. 0: windows
    follow each other."""
    common_size: bool = True
    """Whether one scale holds for the whole window, instead of one scale per frame."""
    filter_window: PositiveInt = 5
    """Number of frames of the weighted median filter over detected keypoints; 1 switches the filter off."""
    unknown_pixels: bool = False
    """Whether the mask terms skip the pixels that may or may not show the bird: pixels outside its mask, but in the
    masks of other birds or close to them, or beyond the border of the image. False: these pixels are background."""
    edge: Literal["soft_rasterizer", "unbiased"] = "soft_rasterizer"
    """Edge of the silhouette. `soft_rasterizer`: as published; the silhouette is larger than its mesh, by 1.5 pixels at
    blur 1. `unbiased`: the covered area of the pixels, filtered like the mask; the silhouette has the area of its
    mesh."""
    min_keypoints: NonNegativeInt = 4
    """Number of keypoints that a frame needs to be fitted. 0: a frame with a mask needs no keypoint."""
    crop: CropConfig = CropConfig()
    initialise: InitialiseConfig = InitialiseConfig()
    error_bars: bool = False
    """Whether the result has error bars: standard deviations of the pose and covariances of the keypoints
    (docs/reference/result_folder.md). They assume that the terms of the last stage are negative log-likelihoods."""
    learn_weights: tuple[Learnable, ...] = ()
    """What is learnt from the data (docs/method/learnt_weights.md): the scale of `keypoint_likelihood`, the weight of
    `mask_smooth_l1`, and `keypoint_offsets`. The values of the config are then the initial values, and weak prior
    knowledge. Scale and offsets alone, with `share_body`, are learnt with the bodies, and the result holds them in
    `bodies`; otherwise all are learnt before the fit, and the result holds them in `learnt.yaml`."""
    species_bone_sd: NonNegativeFloat = 0.0
    """Standard deviation, relative to the rest skeleton, by which the bones of a species differ from those of the
    model, beside the prior of the model: a published prior knows individuals of one species only, and half of the bones
    of AVES have one length. 0: the birds are of the species of the model."""
    keypoint_offsets: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Keypoint → [x, y, z]: offset of the keypoint in the observations from the keypoint of the model, in the rest
    pose: sideways, towards the bill, upwards; model units. The keypoints of the result have these offsets, too."""
    backend: Literal["auto", "native", "reference"] = "auto"
    """Implementation of the silhouette: the compiled kernel (`native`), the pure-JAX `reference`, or the kernel if
    available (`auto`)."""
    memory_gb: PositiveFloat = 3.0
    """Memory that one batch may use, in GB; larger inputs are fitted in several batches. Tables of the whole fit that
    need more memory by estimate are rejected."""

    def __post_init__(self):
        odd = self.filter_window % 2 == 1
        remedy = "expected an odd number of frames; 1 switches the filter off"
        require(odd, "filter_window", f"is {self.filter_window}", remedy)
        check_terms("terms", self.terms)
        for name, offset in self.keypoint_offsets.items():
            problem = f"has {len(offset)} numbers"
            require(len(offset) == 3, f"keypoint_offsets.{name}", problem, "expected three: x, y, z")
        shared = [i for i, stage in enumerate(self.stages) if stage.share_body]
        for i in shared:
            at = f"stages[{i}].share_body"
            last = i == shared[-1] and i < len(self.stages) - 1
            require(last, at, "is true", "expected one such stage, and a later stage")
            has_body = {"bone_length", "betas"} & set(self.stages[i].optimised)
            require(bool(has_body), at, "is true", "the stage must optimise bone_length or betas")
            later = [stage for stage in self.stages[i + 1 :] if {"bone_length", "betas"} & set(stage.optimised)]
            require(not later, at, "is true", "later stages must not optimise bone_length or betas")
            remedy = f"expected betas and shape_prior in the stage {self.stages[i].name}, which `share_body` is in"
            offsets = "keypoint_offsets" in self.learn_weights and not self.learns_first
            require(self.can_learn_offsets or not offsets, "learn_weights", 'names "keypoint_offsets"', remedy)
            adam = self.stages[i].solver == "adam" or self.stages[i + 1].carry_moments
            require(not adam, at, "is true", "the stage must use Levenberg-Marquardt")
        for i, stage in enumerate(self.stages):
            if stage.carry_moments:
                adam = stage.solver == self.stages[max(i - 1, 0)].solver == "adam"
                remedy = "this stage and the previous stage must both use Adam"
                require(adam, f"stages[{i}].carry_moments", "is true", remedy)

    @property
    def overlap_frames(self) -> int:
        """Number of frames that consecutive windows share: `overlap`, or half of a shorter window."""
        return min(self.overlap, self.window // 2)

    @property
    def learns_first(self) -> bool:
        """Whether values are learnt from a sample before the fit, and not with the bodies."""
        with_bodies = self.body_stage is not None and "mask_smooth_l1" not in self.learn_weights
        return bool(self.learn_weights) and not with_bodies

    @property
    def can_learn_offsets(self) -> bool:
        """Whether offsets of keypoints can be learnt with the bodies: as shape coefficients, with their prior."""
        stage = None if self.body_stage is None else self.stages[self.body_stage]
        return stage is not None and "betas" in stage.optimised and "shape_prior" in stage.terms

    @property
    def learns_offsets(self) -> bool:
        """Whether the offsets of the keypoints are learnt with the bodies."""
        return self.can_learn_offsets and not self.learns_first and "keypoint_offsets" in self.learn_weights

    @property
    def body_stage(self) -> int | None:
        """Position of the stage with `share_body`; None without such a stage."""
        return next((i for i, stage in enumerate(self.stages) if stage.share_body), None)

    def stage_settings(self, stage: StageConfig) -> dict[str, dict[str, float]]:
        """Return the weight and settings of each term of a stage: defaults, `terms`, then the stage's `override`."""
        settings = {}
        for name in stage.terms:
            values = {"weight": 1.0, **find_term(name).settings}
            for source in (self.terms, stage.override):
                values |= term_settings(source.get(name, {}))
            settings[name] = values
        return settings


def load_config(source: str | Path) -> FitConfig:
    """Read the config of a fit.

    A file may name another file or a shipped config as its `base`; the file's values replace the base's values key by
    key.

    Args:
        source: the name of a shipped config (`paper`) or the path of a YAML file.

    Raises:
        InputError: see `read_config`.
    """
    return read_config(FitConfig, source)


def shipped_fit_configs() -> list[str]:
    """Return the names of the shipped configs of fits."""
    return [name for name in shipped_configs() if name not in ("ablation", "behaviour", "reconstruct")]


class ShippedConfig(NamedTuple):
    """The purpose of a shipped config of fits. The head comment of its file is the only source of these texts."""

    name: str
    group: str
    """One of `GROUPS`."""
    purpose: str
    """The data that the config is for."""
    chosen_on: str
    """The data on which the values of the config were chosen."""


def describe_fit_configs() -> list[ShippedConfig]:
    """Return the purposes of all shipped configs of fits, in the order of `GROUPS`."""
    described = []
    for name in shipped_fit_configs():
        comment = shipped_comment(name)
        described.append(ShippedConfig(name, comment["group"], comment["for"], comment["chosen on"]))
    return sorted(described, key=lambda config: GROUPS.index(config.group))
