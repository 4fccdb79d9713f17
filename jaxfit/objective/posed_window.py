"""What a term sees: one bird in one window, its observations, its priors, and everything posed from them."""

from __future__ import annotations

from functools import cached_property
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jaxfit.errors import InputError
from jaxfit.model.bird import Bird, unlimited_joints
from jaxfit.model.camera import Camera, project, to_screen
from jaxfit.model.jacobian import window_keypoint_rows
from jaxfit.model.kinematics import Rig, window_joints, window_keypoints, window_transforms, window_vertices
from jaxfit.model.pose import Pose
from jaxfit.model.rotation import axis_angle_to_matrix
from jaxfit.raster.silhouette import Blur

__all__ = ["PosedWindow", "Priors", "Raster", "Targets", "priors_of"]


class Targets(eqx.Module):
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
    corner_px: Float[Array | np.ndarray, "*T 2"]
    """Upper left corner of the crop in the image, in pixels of the crop's own size: the crop follows the bird, and
    this tells where to."""


class Priors(NamedTuple):
    """What a bird is known to be like. Gaussian priors are a mean and a whitening matrix W, with ‖W(x − μ)‖² the
    squared Mahalanobis distance: the square root keeps float32 accurate where the inverse covariance does not."""

    pose_mean: Float[Array, "D"]
    pose_whitener: Float[Array, "D D"]
    bone_mean: Float[Array, "bones"]
    bone_whitener: Float[Array, "bones bones"]
    shape_sd: Float[Array, "S"]
    joint_limits: Float[Array, "bones 3 2"] | None
    """As the bird's; None of a model that knows none."""


def priors_of(bird: Bird) -> Priors:
    """Whiten a bird's priors (in float64, once)."""
    unlimited = np.array_equal(bird.joint_limits, unlimited_joints(bird.num_joints - 1))

    def whitener(covariance):
        cholesky = np.linalg.cholesky(np.asarray(covariance, np.float64))
        return jnp.asarray(np.linalg.inv(cholesky), jnp.float32)

    return Priors(
        bird.pose_mean,
        whitener(bird.pose_covariance),
        bird.bone_mean,
        whitener(bird.bone_covariance),
        jnp.sqrt(bird.shape_variance),
        None if unlimited else bird.joint_limits,
    )


class Raster(NamedTuple):
    """How silhouettes are drawn; static, part of the compiled program."""

    blur: Blur
    backend: Literal["auto", "native", "reference"] = "auto"


class PosedWindow:
    """One window as the terms see it: T frames of one bird. What no term asks for is never computed.

    Camera frame: x right, y down, z forward, of the crop's camera, which follows the bird. Lengths in model units.
    """

    def __init__(
        self,
        pose: Pose,
        anchor: Pose,
        targets: Targets,
        rig: Rig,
        priors: Priors,
        camera: Camera,
        raster: Raster,
    ):
        self.pose = pose
        """What is optimised: `global_orient` (T, 3), `body_pose` (T, J−1, 3), `transl` (T, 3), `scale`, …"""
        self.anchor = anchor
        """The pose at which the present stage began."""
        self.targets = targets
        """What was seen: `keypoints_px`, `confidence`, `mask`, `present`, …"""
        self.priors = priors
        self.camera = camera
        self.raster = raster
        self._rig = rig

    @property
    def present(self) -> Bool[Array | np.ndarray, "T"]:
        """False in frames in which the bird was not seen: their poses mean nothing, and no term counts them."""
        return self.targets.present

    @property
    def joint_limits(self) -> Float[Array, "bones 3 2"]:
        """Least and greatest of each component of the body pose, radians.

        Raises:
            InputError: the model holds none.
        """
        if self.priors.joint_limits is None:
            remedy = "leave out the terms that ask for them, or use a model that has some, as the murre"
            raise InputError("the model", "has no joint limits", remedy)
        return self.priors.joint_limits

    def joint_indices(self, *names: str) -> tuple[int, ...]:
        """Where joints stand among all joints, the root first; a `body_pose` has no root, and is one less.

        Raises:
            InputError: the model has no such joint.
        """
        return _indices("joint", names, self._rig.joint_names)

    def keypoint_indices(self, *names: str) -> tuple[int, ...]:
        """Where keypoints stand among all keypoints.

        Raises:
            InputError: the model has no such keypoint.
        """
        return _indices("keypoint", names, self._rig.keypoint_names)

    @cached_property
    def R_camera_root(self) -> Float[Array, "T 3 3"]:  # noqa: N802
        """Global orientation: rotation model → camera."""
        return axis_angle_to_matrix(jnp.asarray(self.pose.global_orient))

    @cached_property
    def R_parent_child(self) -> Float[Array, "T bones 3 3"]:  # noqa: N802
        """Body pose: rotation of every other joint against its parent."""
        return axis_angle_to_matrix(jnp.asarray(self.pose.body_pose))

    @cached_property
    def _transforms(self) -> Float[Array, "T J 3 4"]:
        return window_transforms(self._rig, self.pose)

    @cached_property
    def joints_cam(self) -> Float[Array, "T J 3"]:
        """Posed joints, camera frame."""
        return window_joints(self._rig, self._transforms, self.pose)

    @cached_property
    def keypoints_cam(self) -> Float[Array, "T K 3"]:
        """Posed keypoints, camera frame."""
        return window_keypoints(self._rig, self._transforms, self.pose)

    @cached_property
    def keypoints_static_cam(self) -> Float[Array, "T K 3"]:
        """Posed keypoints in the camera frame of the window's first frame: of a crop that does not follow the bird.

        A crop whose corner lies further by (u, v) pixels sees a point at depth z by (u, v) · z / focal further back.
        What stands still in the world stands still here, up to the noise of the fit, if the filming camera does too.
        """
        x, z = self.keypoints_cam[..., :2], self.keypoints_cam[..., 2:]
        shift = jnp.asarray(self.targets.corner_px - self.targets.corner_px[:1])
        return jnp.concatenate([x + shift[:, None] * z / self.camera.focal_px, z], axis=-1)

    @cached_property
    def keypoints_px(self) -> Float[Array, "T K 2"]:
        """Posed keypoints, crop pixels."""
        return project(self.keypoints_cam, self.camera)

    @cached_property
    def keypoint_jacobian_px(self) -> tuple[Float[Array, "T rows angles"], Float[Array, "T rows 4"]]:
        """∂`keypoints_px` of each frame, (T, 2K, …): by the 3J angles, and by translation and scale."""
        scale = jnp.broadcast_to(self.pose.scale, self.pose.global_orient.shape[:1])
        points = self.keypoints_cam
        to_pixels = jax.vmap(jax.vmap(jax.jacfwd(lambda point_cam: project(point_cam, self.camera))))(points)
        turned = window_keypoint_rows(self._rig, self._transforms, self.pose, to_pixels)
        unit = (points - self.pose.transl[:, None]) / scale[:, None, None]
        grown = jnp.sum(to_pixels * unit[..., None, :], axis=-1, keepdims=True)
        placed = jnp.concatenate([to_pixels, grown], axis=-1)
        rows = len(points), 2 * points.shape[1]
        return turned.reshape(*rows, -1), placed.reshape(*rows, -1)

    @cached_property
    def vertices_screen(self) -> Float[Array, "T V 3"]:
        """Posed vertices as (x_px, y_px, z_cam) in the crop, for the raster core."""
        return to_screen(window_vertices(self._rig, self._transforms, self.pose), self.camera)

    @property
    def faces(self):
        """Vertex indices of each triangle, (F, 3)."""
        return self._rig.faces


def _indices(kind: str, names: tuple[str, ...], known: tuple[str, ...]) -> tuple[int, ...]:
    for name in names:
        if name not in known:
            raise InputError("the model", f"has no {kind} {name!r}", f"it has {', '.join(known)}")
    return tuple(known.index(name) for name in names)
