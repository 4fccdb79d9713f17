"""Fit of a species to photographs: images, individuals and species; widths of bone lengths.

The objective of the adaptation to photographs: images with cameras and poses, individuals, and the species. E = Σ_i r_i
(E_kpt,i + E_msk,i) + λ [Σ_i E_pp,i + Σ_n d(δ_n, Σ_w) + d(μ, Σ_0)], d(x, Σ) = xᵀ Σ⁻¹ x,

with i the images, n the individuals, r_i the weight of an image, μ the difference of the species from the base model
and δ_n the difference of an individual from its species; both hold bone lengths and shape coefficients.

Widths of the bone lengths of a species before and after the photographs: which bones the photographs determine. The
posterior is Gaussian at the fitted parameters (Laplace): its precision is the Gauss-Newton matrix of the objective
E/(2λ) of `hierarchy`, without the poses and cameras of the images and the deviations of the individuals (Schur
complements).

Rounds of Adam alternate with empirical updates: images that disagree with the others lose weight, and the covariance of
the individuals is estimated from their deviations.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.species.photographs import Photographs
from jaxfit.learning.species.species import species_bird, symmetric_bone_precision, symmetric_bones, with_offsets
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CropCamera, project, to_screen
from jaxfit.model.kinematics import Pose, Rig, fold_bird, joint_transforms, posed_vertices
from jaxfit.objective.objective import evaluate_curvature
from jaxfit.objective.posed_window import PosedWindow, Priors, Raster, Targets, priors_of
from jaxfit.objective.registry import find_terms
from jaxfit.objective.residuals import geman_mcclure
from jaxfit.raster.silhouette import mask_loss
from jaxfit.raster.silhouette_reference import Blur

SIGMA_PX = 100.0
"""Scale of the robust error of keypoints, as in the config `photo`."""
PRIOR_WEIGHT = 10.0
"""λ, as in the config `photo`: keypoints then have a standard deviation of 3 pixels."""
BLUR = 0.5
"""Blur of the silhouettes: at a blur of 1, the outline is drawn about 1 pixel outside the mesh."""
LEARNING_RATE = 0.01
PLACE_UNITS = np.array([1, 1, 18], np.float32)
"""Units of the translation: a step of the depth is larger, because the depth hardly changes the picture."""


class Parameters(NamedTuple):
    """All optimised values. Bones are those of `symmetric_bones`, shapes those of the extended bird."""

    orient: Float[Array, "N 3"]
    body_pose: Float[Array, "N bones 3"]
    place: Float[Array, "N 3"]
    """Translation, divided by `PLACE_UNITS`."""
    own_bones: Float[Array, "individuals Q"]
    own_shape: Float[Array, "individuals S"]
    bones: Float[Array, "Q"]
    """Difference of the species from the base."""
    shape: Float[Array, "S+O"]


class Data(NamedTuple):
    """The images."""

    keypoints_px: Float[Array, "N K 2"]
    confidence: Float[Array, "N K"]
    mask: Int[Array, "N size size"]
    has_mask: Float[Array, "N"]
    individual: Int[Array, "N"]
    scale: Float[Array, "N"]


class Weights(NamedTuple):
    """Values that change between the rounds: weights of the images, precisions of the individuals, step sizes."""

    image: Float[Array, "N"]
    mask: Float[Array, ""]
    """1 in rounds that compare masks, else 0."""
    own_bones: Float[Array, "Q Q"]
    own_shape: Float[Array, "S"]
    step: Parameters
    """Step size of each group of parameters; 0 fixes the group."""


class Hierarchy(eqx.Module):
    """The model and the priors of the species."""

    rig: Rig
    keypoint_weights: Float[Array, "K V"]
    symmetric: Float[Array, "bones Q"]
    bone_mean: Float[Array, "bones"]
    pose_mean: Float[Array, "D"]
    pose_whitener: Float[Array, "D D"]
    bone_precision: Float[Array, "Q Q"]
    shape_precision: Float[Array, "S+O"]

    def pose(self, p: Parameters, data: Data) -> Pose:
        """Return the poses of all images, with a leading axis N; the shape is the difference from the species."""
        bones = self.bone_mean + (p.bones + p.own_bones[data.individual]) @ self.symmetric.T
        return Pose(
            p.orient,
            p.body_pose,
            p.place * PLACE_UNITS,
            data.scale,
            bones,
            p.own_shape[data.individual],
        )

    def image_losses(self, p: Parameters, data: Data, with_mask: Float[Array, ""]):
        """Return the loss of keypoints and of the mask for each image, (N,) each, in squared pixels and pixels."""
        camera, size = CropCamera(), data.mask.shape[-1]
        paper = Blur.for_size(size)
        blur = Blur(paper.sigma * BLUR**2, paper.radius * BLUR)
        pose = self.pose(p, data)
        # all individuals share the displacement of the species, so it is computed once
        shapes = p.own_shape.shape[1]
        rest = self.rig.vertices + jnp.tensordot(p.shape, self.rig.shape_basis, axes=1)
        rig = eqx.tree_at(lambda r: (r.vertices, r.shape_basis), self.rig, (rest, self.rig.shape_basis[:shapes]))

        def image(pose: Pose, keypoints_px, confidence, mask, weight):
            vertices = posed_vertices(rig, joint_transforms(rig, pose), pose)
            error_px = project(self.keypoint_weights @ vertices, camera) - keypoints_px
            keypoints = jnp.sum(confidence[:, None] * geman_mcclure(SIGMA_PX).value(error_px**2))
            ratio = size / camera.size_px
            screen = to_screen(vertices, camera) * jnp.array([ratio, ratio, 1.0])
            return keypoints, mask_loss(screen, rig.faces, mask, weight, kind="smooth_l1", blur=blur) / ratio**2

        weight = with_mask * data.has_mask
        return jax.vmap(image)(pose, data.keypoints_px, data.confidence, data.mask, weight)

    def loss(self, p: Parameters, data: Data, weights: Weights) -> Float[Array, ""]:
        """Return the objective."""
        keypoints, mask = self.image_losses(p, data, weights.mask)
        offset = p.body_pose.reshape(len(p.orient), -1) - self.pose_mean
        pose = jnp.sum((offset @ self.pose_whitener.T) ** 2)
        own = jnp.einsum("nq,qr,nr->", p.own_bones, weights.own_bones, p.own_bones)
        own = own + jnp.sum(p.own_shape**2 * weights.own_shape)
        species = p.bones @ self.bone_precision @ p.bones + jnp.sum(p.shape**2 * self.shape_precision)
        return jnp.sum(weights.image * (keypoints + mask)) + PRIOR_WEIGHT * (pose + own + species)


@eqx.filter_jit
def run_steps(model: Hierarchy, data: Data, weights: Weights, p: Parameters, state, steps: Int[Array, ""]):
    """Take `steps` steps of Adam. All rounds share one compiled program, because `steps` and `weights` are traced."""
    adam = optax.scale_by_adam()

    def step(_, carried):
        p, state = carried
        gradient = jax.grad(model.loss)(p, data, weights)
        update, state = adam.update(gradient, state)
        return jax.tree.map(lambda x, u, s: x - LEARNING_RATE * s * u, p, update, weights.step), state

    p, state = jax.lax.fori_loop(0, steps, step, (p, state))
    return p, state, model.image_losses(p, data, weights.mask)


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
        individual = images[np.asarray(data.individual) == n].sum(axis=0)
        precision += _without(individual, individual + own_precision, own_free)
    free = np.concatenate(free)
    posterior = np.linalg.inv(precision[np.ix_(free, free)])[:bones, :bones]
    return BoneWidths(*(np.sqrt(np.diag(symmetric @ covariance @ symmetric.T)) for covariance in (prior, posterior)))


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
    for matrix in curvature:
        rows = to_rows.T @ matrix @ to_rows
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
        window = PosedWindow(
            pose, pose, targets, model.rig, priors, CropCamera(), raster, shared=("bone_length", "betas")
        )
        curvature = evaluate_curvature(window, find_terms(settings), settings)
        columns = jnp.eye(curvature.diagonal.shape[1])
        return jax.vmap(lambda column: curvature.product(column[None])[0])(columns)

    return jax.lax.map(image, (poses, data.keypoints_px, data.confidence, data.mask, data.has_mask))


def _is_free(step: Array, count: int) -> np.ndarray:
    return np.broadcast_to(np.asarray(step).ravel() > 0, (count,))


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
    model = _model(extended)
    data = Data(
        keypoints_px=jnp.asarray(photographs.keypoints_px),
        confidence=jnp.asarray(photographs.confidence),
        mask=jnp.asarray(photographs.mask, jnp.uint8),
        has_mask=jnp.asarray(photographs.has_mask, jnp.float32),
        individual=jnp.asarray(photographs.individual),
        scale=jnp.asarray(photographs.pose.scale),
    )
    individuals = int(photographs.individual.max()) + 1
    p = _start(photographs, bird, extended, individuals)
    between_bones = np.linalg.inv(np.asarray(model.bone_precision, np.float64))
    first_bones = settings.within**2 * between_bones
    first_shape = settings.within**2 * np.asarray(bird.shape_variance, np.float64)
    own_bones, own_shape = first_bones, first_shape
    weight, state = np.ones(len(photographs.names)), optax.scale_by_adam().init(p)
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
