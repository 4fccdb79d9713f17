"""What a term sees: one bird in one window, its observations, its priors, and everything posed from them."""

from __future__ import annotations

from functools import cached_property
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jaxfit.camera import Camera, project, to_screen
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, window_keypoints, window_transforms, window_vertices
from jaxfit.model.pose import Pose
from jaxfit.silhouette import Blur

__all__ = ["Evidence", "Priors", "Raster", "Scene", "priors_of"]


class Evidence(eqx.Module):
    """What was seen of one bird in one window, in crop pixels; batches put further axes in front."""

    keypoints_px: Float[Array | np.ndarray, "*T K 2"]
    confidence: Float[Array | np.ndarray, "*T K"]
    """In [0, 1]; 0 where the keypoint was not seen."""
    mask: UInt8[Array | np.ndarray, "*T H W"]
    """0 or 1."""
    has_mask: Bool[Array | np.ndarray, "*T"]
    """False where the frame has no mask; such a frame's silhouette is not compared."""
    present: Bool[Array | np.ndarray, "*T"]
    """False where the bird was not seen at all; such a frame contributes nothing to any term."""


class Priors(NamedTuple):
    """A bird's Gaussian priors, each as a mean and a whitening matrix W with ‖W(x − μ)‖² the squared
    Mahalanobis distance: the square root keeps float32 accurate where the inverse covariance does not."""

    pose_mean: Float[Array, "D"]
    pose_whitener: Float[Array, "D D"]
    bone_mean: Float[Array, "bones"]
    bone_whitener: Float[Array, "bones bones"]
    shape_sd: Float[Array, "S"]


def priors_of(bird: Bird) -> Priors:
    """Whiten a bird's priors (in float64, once)."""

    def whitener(covariance):
        cholesky = np.linalg.cholesky(np.asarray(covariance, np.float64))
        return jnp.asarray(np.linalg.inv(cholesky), jnp.float32)

    return Priors(
        bird.pose_mean,
        whitener(bird.pose_covariance),
        bird.bone_mean,
        whitener(bird.bone_covariance),
        jnp.sqrt(bird.shape_variance),
    )


class Raster(NamedTuple):
    """How silhouettes are drawn; static, part of the compiled program."""

    blur: Blur
    backend: Literal["auto", "native", "reference"] = "auto"


class Scene:
    """One window as the terms see it; what no term asks for is never computed."""

    def __init__(
        self,
        pose: Pose,
        start: Pose,
        evidence: Evidence,
        rig: Rig,
        priors: Priors,
        camera: Camera,
        raster: Raster,
    ):
        self.pose, self.evidence, self.priors = pose, evidence, priors
        self.start = start
        """The pose at which the present stage began."""
        self.raster = raster
        self._rig, self._camera = rig, camera

    @cached_property
    def _transforms(self) -> Float[Array, "T J 3 4"]:
        return window_transforms(self._rig, self.pose)

    @cached_property
    def keypoints_cam(self) -> Float[Array, "T K 3"]:
        """Posed keypoints, camera frame, model units."""
        return window_keypoints(self._rig, self._transforms, self.pose)

    @cached_property
    def keypoints_px(self) -> Float[Array, "T K 2"]:
        """Posed keypoints, crop pixels."""
        return project(self.keypoints_cam, self._camera)

    @cached_property
    def vertices_screen(self) -> Float[Array, "T V 3"]:
        """Posed vertices as (x_px, y_px, z_cam) in the crop, for the raster core."""
        return to_screen(window_vertices(self._rig, self._transforms, self.pose), self._camera)

    @property
    def faces(self):
        """Vertex indices of each triangle, (F, 3)."""
        return self._rig.faces
