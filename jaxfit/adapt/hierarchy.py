"""The objective of the adaptation to photographs: images with cameras and poses, individuals, and the species.

E = Σ_i r_i (E_kpt,i + E_msk,i) + λ [Σ_i E_pp,i + Σ_n d(δ_n, Σ_w) + d(μ, Σ_0)],  d(x, Σ) = xᵀ Σ⁻¹ x,

with i the images, n the individuals, r_i the weight of an image, μ the difference of the species from the base model
and δ_n the difference of an individual from its species; both hold bone lengths and shape coefficients.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from jaxfit.model.camera import Camera, project, to_screen
from jaxfit.model.kinematics import Rig, joint_transforms, posed_vertices
from jaxfit.model.pose import Pose
from jaxfit.objective.residuals import geman_mcclure
from jaxfit.raster.silhouette import Blur, mask_loss

__all__ = ["PLACE_UNITS", "Data", "Hierarchy", "Parameters", "Weights", "initial_state", "run_steps"]

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
        camera, size = Camera(), data.mask.shape[-1]
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


def initial_state(p: Parameters):
    """Return the state of Adam before the first step."""
    return optax.scale_by_adam().init(p)
