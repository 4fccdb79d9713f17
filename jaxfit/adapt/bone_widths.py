"""Widths of the bone lengths of a species before and after the photographs: which bones the photographs determine.

The posterior is Gaussian at the fitted parameters (Laplace): its precision is the Gauss-Newton matrix of the objective
E/(2λ) of `hierarchy`, without the poses and cameras of the images and the deviations of the individuals (Schur
complements).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfit.adapt.hierarchy import BLUR, PRIOR_WEIGHT, SIGMA_PX, Data, Hierarchy, Parameters, Weights
from jaxfit.model.camera import Camera
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.objective.posed_window import PosedWindow, Priors, Raster, Targets
from jaxfit.objective.registry import find_terms
from jaxfit.raster.silhouette import Blur

__all__ = ["BoneWidths", "bone_widths"]

UNDETERMINED = 0.5**0.5
"""Ratio of the widths above which the photographs say less about a bone than the prior: the precision of the posterior
is the sum of that of the prior and that of the photographs."""


class BoneWidths(NamedTuple):
    """Standard deviations of the mean bone lengths of a species, relative to the rest skeleton."""

    prior: Float[np.ndarray, "bones"]
    """Before the photographs."""
    posterior: Float[np.ndarray, "bones"]
    """Given the photographs."""

    @property
    def undetermined(self) -> list[int]:
        """The bones about which the photographs say less than the prior, in the order of the bones."""
        return np.flatnonzero(self.posterior > UNDETERMINED * self.prior).tolist()


def bone_widths(model: Hierarchy, priors: Priors, data: Data, weights: Weights, p: Parameters) -> BoneWidths:
    """Return the widths of the mean bone lengths.

    Args:
        model: the model and the priors of the species.
        priors: priors of the bird.
        data: the images.
        weights: weights of the images, precisions of the individuals, and step sizes: parameters with a step size of 0
            are fixed, and count as known.
        p: the fitted parameters.
    """
    symmetric = np.asarray(model.symmetric, np.float64)
    bones, shapes = symmetric.shape[1], p.own_shape.shape[1]
    free = _is_free(weights.step.bones, bones), _is_free(weights.step.shape, len(p.shape))
    own_free = np.concatenate(
        [free[0], _is_free(weights.step.own_shape, shapes), np.zeros(len(p.shape) - shapes, bool)]
    )
    own_precision = np.zeros((len(own_free), len(own_free)))
    own_precision[:bones, :bones] = weights.own_bones
    own_precision[range(bones, bones + shapes), range(bones, bones + shapes)] = weights.own_shape
    precision = np.zeros_like(own_precision)
    precision[:bones, :bones] = model.bone_precision
    precision[range(bones, len(precision)), range(bones, len(precision))] = model.shape_precision
    prior = np.linalg.inv(precision[:bones, :bones])
    images = _image_precisions(model, priors, data, weights, p)
    for n in range(len(p.own_bones)):
        own = images[np.asarray(data.individual) == n].sum(axis=0)
        precision += _without(own, own + own_precision, own_free)
    free = np.concatenate(free)
    posterior = np.linalg.inv(precision[np.ix_(free, free)])[:bones, :bones]
    return BoneWidths(*(np.sqrt(np.diag(symmetric @ each @ symmetric.T)) for each in (prior, posterior)))


def _image_precisions(
    model: Hierarchy, priors: Priors, data: Data, weights: Weights, p: Parameters
) -> Float[np.ndarray, "N P P"]:
    """Return the precision of each image for bones (Q) and shape (S+O), without pose and camera."""
    curvature = np.asarray(_curvatures(model, priors, data, p, bool(np.any(data.has_mask))), np.float64)
    angles = p.body_pose[0].size
    scale = 3 + angles + 3  # a fixed value
    curvature = np.delete(np.delete(curvature, scale, axis=1), scale, axis=2)
    curvature *= np.asarray(weights.image, np.float64)[:, None, None] / (2 * PRIOR_WEIGHT)
    symmetric = np.asarray(model.symmetric, np.float64)
    to_rows = np.eye(curvature.shape[1], scale + symmetric.shape[1] + len(p.shape))
    to_rows[scale:] = 0
    to_rows[scale : scale + len(symmetric), scale : scale + symmetric.shape[1]] = symmetric
    to_rows[scale + len(symmetric) :, scale + symmetric.shape[1] :] = np.eye(len(p.shape))
    whitener = np.asarray(model.pose_whitener, np.float64)
    local = np.arange(to_rows.shape[1]) < scale
    precisions = []
    for each in curvature:
        rows = to_rows.T @ each @ to_rows
        with_prior = rows.copy()
        with_prior[3 : 3 + angles, 3 : 3 + angles] += whitener.T @ whitener
        precisions.append(_without(rows, with_prior, local)[scale:, scale:])
    return np.stack(precisions)


def _without(data: np.ndarray, whole: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """Return the precision of `data` after some parameters, whose precision is in `whole`, are marginalised."""
    block = whole[np.ix_(left_out, left_out)]
    # a camera that the keypoints of an image do not determine
    block = block + 1e-9 * max(np.trace(block), 1e-9) * np.eye(len(block))
    cross = data[:, left_out]
    return data - cross @ np.linalg.solve(block, cross.T)


@eqx.filter_jit
def _curvatures(model: Hierarchy, priors: Priors, data: Data, p: Parameters, with_masks: bool) -> Float[Array, "N D D"]:
    """Return the Gauss-Newton matrix of keypoints and mask of each image, on rows of `curvature.frame_rows`."""
    size = data.mask.shape[-1] if with_masks else 1
    paper = Blur.for_size(size)
    raster = Raster(Blur(paper.sigma * BLUR**2, paper.radius * BLUR), size)
    settings = {"keypoints": {"weight": 1.0, "sigma_px": SIGMA_PX}}
    settings |= {"mask_smooth_l1": {"weight": 1.0}} if with_masks else {}
    own_shape = jnp.pad(p.own_shape, ((0, 0), (0, len(p.shape) - p.own_shape.shape[1])))
    poses = replace(model.pose(p, data), betas=p.shape + own_shape[data.individual])

    def image(one: tuple) -> Float[Array, "D D"]:
        pose, *observed = one
        framed = {name: getattr(pose, name)[None] for name in ("global_orient", "body_pose", "transl", "scale")}
        pose = replace(pose, **framed)
        keypoints_px, confidence, mask, has_mask = (x[None] for x in observed)
        present, corner = jnp.ones(1, bool), jnp.zeros((1, 2))
        targets = Targets(keypoints_px, confidence, mask, has_mask > 0, present, corner, jnp.float32(1))
        window = PosedWindow(pose, pose, targets, model.rig, priors, Camera(), raster, shared=("bone_length", "betas"))
        curvature = evaluate_curvature(window, find_terms(settings), settings)
        columns = jnp.eye(curvature.diagonal.shape[1])
        return jax.vmap(lambda column: curvature.product(column[None])[0])(columns)

    return jax.lax.map(image, (poses, data.keypoints_px, data.confidence, data.mask, data.has_mask))


def _is_free(step: Array, count: int) -> np.ndarray:
    return np.broadcast_to(np.asarray(step).ravel() > 0, (count,))
