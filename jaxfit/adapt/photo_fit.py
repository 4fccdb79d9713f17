"""Fit of a species to photographs: the mean of all individuals, their covariance, and the weights of the images.

Rounds of Adam alternate with empirical updates: images that disagree with the others lose weight, and the covariance of
the individuals is estimated from their deviations.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfit.adapt.bone_widths import BoneWidths, bone_widths
from jaxfit.adapt.hierarchy import PLACE_UNITS, Data, Hierarchy, Parameters, Weights, initial_state, run_steps
from jaxfit.adapt.offsets import with_offsets
from jaxfit.adapt.photographs import Photographs
from jaxfit.adapt.species import species_bird, symmetric_bone_precision, symmetric_bones
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import fold_bird
from jaxfit.objective.posed_window import priors_of
from jaxfit.progress import ProgressTask, silent

__all__ = ["FREE", "PhotoFit", "PhotoSettings", "fit_photographs"]

FREE = ("bones", "shape", "offset")
"""Parts of a species that are optimised, unless they are fixed."""
DISAGREES = 0.5
"""Images with a smaller weight are reported."""


class PhotoSettings(NamedTuple):
    """Settings of the fit of a species to photographs."""

    modes: int = 15
    """Number of even and of odd modes of the vertex offset (`offset_directions`)."""
    offset_sd: float = 0.004
    """Standard deviation of one smooth mode of the offset, as a share of the bird's length."""
    within: float = 0.3
    """Initial standard deviation of individuals within a species, as a share of that between species."""
    prior_individuals: float = 10.0
    """Number of individuals that count as much as this initial covariance."""
    rounds: tuple[int, ...] = (150, 120, 120, 120)
    """Number of steps of each round. The first round compares keypoints only."""


@dataclass(frozen=True, eq=False)
class PhotoFit:
    """The result of a fit to photographs."""

    bird: Bird
    """The adapted model: its means and covariances are those of the species."""
    weight: Float[np.ndarray, "N"]
    """Final weight of each image, from 0 to 1."""
    individuals: int
    settings: PhotoSettings
    widths: BoneWidths | None
    """Widths of the mean bone lengths; None for fixed bone lengths."""

    @property
    def disagreeing(self) -> list[int]:
        """The images that disagree with the others, worst first."""
        order = np.argsort(self.weight)
        return [int(i) for i in order if self.weight[i] < DISAGREES]


def fit_photographs(
    photographs: Photographs,
    bird: Bird,
    settings: PhotoSettings = PhotoSettings(),
    fixed: Collection[str] = (),
    name: str = "adapted",
    progress: ProgressTask = silent,
) -> PhotoFit:
    """Fit the means of a species to photographs.

    Args:
        photographs: the images with initial poses.
        bird: the model to start from.
        settings: the settings.
        fixed: parts of `FREE` that stay as in the base.
        name: name of the adapted model.
        progress: shows progress.

    Source: Wang et al. 2021, *Birds of a Feather*, section 4, for a species mean that all images share.
    """
    extended = with_offsets(bird, 0 if "offset" in fixed else settings.modes, settings.offset_sd)
    model, data = _model(extended), _data(photographs)
    individuals = int(photographs.individual.max()) + 1
    p = _start(photographs, bird, extended, individuals)
    between_bones = np.linalg.inv(np.asarray(model.bone_precision, np.float64))
    first_bones = settings.within**2 * between_bones
    first_shape = settings.within**2 * np.asarray(bird.shape_variance, np.float64)
    own_bones, own_shape = first_bones, first_shape
    weight, state = np.ones(len(photographs.names)), initial_state(p)
    step = _step_sizes(p, bird, fixed)
    with progress(f"Fitting {len(weight)} images", sum(settings.rounds)) as report_progress:
        # the first round has no steps: images that no pose of the base fits lose weight before they bend the species
        for number, steps in enumerate((0, *settings.rounds)):
            weights = Weights(
                image=jnp.asarray(weight, jnp.float32),
                mask=jnp.float32(number > 1),
                own_bones=jnp.asarray(np.linalg.inv(own_bones), jnp.float32),
                own_shape=jnp.asarray(1 / own_shape, jnp.float32),
                step=step,
            )
            for done in range(0, max(steps, 1), 30):
                some = min(30, steps - done)
                p, state, losses = run_steps(model, data, weights, p, state, jnp.int32(some))
                report_progress(some, "masks" if number > 1 else "keypoints")
            if steps:
                deviations = np.asarray(p.own_bones, np.float64), np.asarray(p.own_shape, np.float64)
                own_bones = _shrunk(first_bones, deviations[0].T @ deviations[0], individuals, settings)
                own_shape = _shrunk(first_shape, (deviations[1] ** 2).sum(0), individuals, settings)
            weight = _image_weights(photographs, *(np.asarray(loss) for loss in losses))
    weights = weights._replace(
        image=jnp.asarray(weight, jnp.float32),
        own_bones=jnp.asarray(np.linalg.inv(own_bones), jnp.float32),
        own_shape=jnp.asarray(1 / own_shape, jnp.float32),
    )
    widths = None if "bones" in fixed else bone_widths(model, priors_of(extended), data, weights, p)
    symmetric = symmetric_bones(bird)
    covariance = symmetric @ own_bones @ symmetric.T + 1e-4 * np.eye(len(symmetric))
    shift = np.tensordot(np.asarray(p.shape), np.asarray(extended.shape_basis), axes=1)
    bones = np.asarray(bird.bone_mean) + symmetric @ np.asarray(p.bones)
    adapted = species_bird(bird, name, bones, shift, covariance)
    adapted = replace(adapted, shape_variance=jnp.asarray(own_shape, jnp.float32))
    return PhotoFit(adapted, weight, individuals, settings, widths)


def _shrunk(first, scatter, individuals: int, settings: PhotoSettings):
    """Return the covariance of the individuals: the mean of the first covariance and of the sample covariance."""
    return (settings.prior_individuals * first + scatter) / (settings.prior_individuals + individuals)


def _model(bird: Bird) -> Hierarchy:
    return Hierarchy(
        rig=fold_bird(bird),
        keypoint_weights=bird.keypoint_weights,
        symmetric=jnp.asarray(symmetric_bones(bird), jnp.float32),
        bone_mean=bird.bone_mean,
        pose_mean=bird.pose_mean,
        pose_whitener=priors_of(bird).pose_whitener,
        bone_precision=jnp.asarray(symmetric_bone_precision(bird), jnp.float32),
        shape_precision=1 / bird.shape_variance,
    )


def _data(photographs: Photographs) -> Data:
    return Data(
        keypoints_px=jnp.asarray(photographs.keypoints_px),
        confidence=jnp.asarray(photographs.confidence),
        mask=jnp.asarray(photographs.mask, jnp.uint8),
        has_mask=jnp.asarray(photographs.has_mask, jnp.float32),
        individual=jnp.asarray(photographs.individual),
        scale=jnp.asarray(photographs.pose.scale),
    )


def _start(photographs: Photographs, bird: Bird, extended: Bird, individuals: int) -> Parameters:
    """Return the parameters before the first step: the poses of the single fits, and the means of the base."""
    pose, bones = photographs.pose, symmetric_bones(bird).shape[1]
    return Parameters(
        orient=jnp.asarray(pose.global_orient),
        body_pose=jnp.asarray(pose.body_pose),
        place=jnp.asarray(pose.transl / PLACE_UNITS),
        own_bones=jnp.zeros((individuals, bones)),
        own_shape=jnp.zeros((individuals, bird.num_shapes)),
        bones=jnp.zeros(bones),
        shape=jnp.zeros(extended.num_shapes),
    )


def _step_sizes(p: Parameters, bird: Bird, fixed: Collection[str]) -> Parameters:
    """Return the step size of each value relative to the learning rate: 0 for fixed parts."""
    shape = np.full(len(p.shape), 0.0 if "offset" in fixed else 1.0, np.float32)
    shape[: bird.num_shapes] = 0.0 if "shape" in fixed else 1.0
    step = jax.tree.map(lambda x: jnp.ones((1,) * x.ndim), p)
    bones = jnp.full(1, 0.0 if "bones" in fixed else 1.0)
    return step._replace(
        bones=bones, own_bones=bones[None], shape=jnp.asarray(shape), own_shape=jnp.full((1, 1), shape[:1].sum())
    )


def _image_weights(photographs: Photographs, keypoints, mask) -> Float[np.ndarray, "N"]:
    """Return weights from the losses: images whose loss is far above the median lose weight.

    w = (1 + (z/4)²)⁻² for the larger z > 0 of keypoints and mask, with z the robust standard score of the logarithm.
    """
    counts = np.maximum(photographs.confidence.sum(1), 1e-6)
    area = np.maximum(photographs.mask.sum((1, 2)), 1)
    scores = [_score(keypoints / counts, np.ones(len(counts), bool)), _score(mask / area, photographs.has_mask)]
    z = np.maximum(np.max(scores, axis=0), 0)
    return (1 + (z / 4) ** 2) ** -2


def _score(loss: Float[np.ndarray, "N"], known: np.ndarray) -> Float[np.ndarray, "N"]:
    """Return robust standard scores of log losses; 0 for images without this loss."""
    if not known.any():
        return np.zeros(len(loss))
    value = np.log(np.maximum(loss, 1e-6))
    middle = np.median(value[known])
    spread = max(1.48 * np.median(np.abs(value[known] - middle)), 0.3)
    return np.where(known, (value - middle) / spread, 0.0)
