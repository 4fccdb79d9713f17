"""The posed window: one bird in one window, with targets, priors and posed geometry, as the terms receive it."""

from __future__ import annotations

from functools import cached_property
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird, unlimited_joints
from jaxfit.model.camera import CropCamera, project, to_screen
from jaxfit.model.kinematics import (
    Pose,
    Rig,
    moved_joints,
    shaped_vertices,
    window_joints,
    window_keypoint_derivatives,
    window_keypoint_rows,
    window_keypoints,
    window_transform_generators,
    window_transforms,
    window_vertices,
)
from jaxfit.model.rotation import axis_angle_to_matrix
from jaxfit.objective.curvature import Rows, add_rows
from jaxfit.raster.silhouette_reference import Blur, Skin


class ViewMaps(eqx.Module):
    """The V calibrated cameras that see a window, as affine maps to the frame of the crop camera.

    The pose is then in a frame that all views share. A camera with intrinsic matrix K, which a crop changes to K' (in
    crop pixels), and with pose R, t shows a point x at the pixel (K'·(R·x + t)) / z. With F and c the focal length and
    the centre of the crop camera, the same pixel is F·(x', y')/z + c for x' = L·x + o, where
    L = [[K'₀₀/F, K'₀₁/F, (K'₀₂ − c)/F], [0, K'₁₁/F, (K'₁₂ − c)/F], [0, 0, 1]] · R, and o the same matrix times t. So
    keypoints, silhouettes and kernels need one camera only.
    """

    linear: Float[Array | np.ndarray, "*T V 3 3"]
    """L of each frame and view."""
    offset: Float[Array | np.ndarray, "*T V 3"]
    """o of each frame and view, model units."""
    px_per_unit: Float[Array | np.ndarray, "*windows"]
    """Crop pixels of a model unit at the bird, mean over frames and views."""

    def points(self, points: Float[Array, "T P 3"]) -> Float[Array, "T V P 3"]:
        """Return points of the shared frame in the frames of the crop cameras."""
        return jnp.einsum("tvij,tpj->tvpi", self.linear, points) + jnp.asarray(self.offset)[:, :, None]


class Targets(eqx.Module):
    """The observations of one bird in one window, in crop pixels; a batch has further leading axes.

    With several views, `mask` and `has_mask` have an axis V after T, and K counts the keypoints of all views: V groups
    of the keypoints of the model.
    """

    keypoints_px: Float[Array | np.ndarray, "*T K 2"]
    """Observed keypoints, crop pixels."""
    confidence: Float[Array | np.ndarray, "*T K"]
    """Confidence of each keypoint in [0, 1]; 0 where the keypoint was not observed."""
    mask: UInt8[Array | np.ndarray, "*images H W"]
    """0, 1, or 2 where it is unknown whether the pixel shows the bird; of the silhouette's size, or empty in a stage
    that compares no masks."""
    has_mask: Bool[Array | np.ndarray, "*images"]
    """False where the frame has no mask; the mask terms skip such frames."""
    present: Bool[Array | np.ndarray, "*T"]
    """False where the bird was not observed; all terms skip such frames."""
    corner_px: Float[Array | np.ndarray, "*images 2"]
    """Upper left corner of the crop in the image, in crop pixels. The crop follows the bird, so the corner differs
    between frames."""
    frame_s: Float[Array | np.ndarray, "*windows"]
    """Time between consecutive frames in seconds. A traced value: windows of any frame rate share a program."""
    views: ViewMaps | None = None
    """The cameras of several views; None for one view, whose pose is in the frame of the crop camera."""


class Priors(NamedTuple):
    """Priors of a bird model.

    A Gaussian prior is a mean μ and a whitening matrix W: ‖W(x − μ)‖² is the squared Mahalanobis distance. In float32,
    the whitening matrix is accurate where the inverse covariance is not.
    """

    pose_mean: Float[Array, "D"]
    pose_whitener: Float[Array, "D D"]
    bone_mean: Float[Array, "bones"]
    bone_whitener: Float[Array, "bones bones"]
    shape_sd: Float[Array, "S"]
    joint_limits: Float[Array, "bones 3 2"] | None
    """Joint limits of the bird; None for a model without limits."""


def priors_of(bird: Bird) -> Priors:
    """Return the priors of a bird with whitening matrices, which are computed in float64."""
    unlimited = np.array_equal(bird.joint_limits, unlimited_joints(bird.num_joints - 1))

    def whitener(covariance):
        cholesky = np.linalg.cholesky(np.asarray(covariance, np.float64))
        return jax.device_put(np.linalg.inv(cholesky).astype(np.float32))

    return Priors(
        bird.pose_mean,
        whitener(bird.pose_covariance),
        bird.bone_mean,
        whitener(bird.bone_covariance),
        jnp.sqrt(bird.shape_variance),
        None if unlimited else bird.joint_limits,
    )


class Raster(NamedTuple):
    """Settings of the silhouette renderer; static, so they are part of the compiled program."""

    blur: Blur
    """In pixels of the silhouette."""
    size_px: int
    """Side of silhouettes and masks, which show the whole crop."""
    backend: Literal["auto", "native", "reference"] = "auto"


class PosedWindow:
    """One window as the terms receive it: T frames of one bird. Posed quantities are computed on first access.

    Camera frame: x right, y down, z forward, of the crop camera, which follows the bird. Lengths are in model units.
    With several views (`Targets.views`), the pose, and all that is named "camera frame", is in the frame that the views
    share, at rest in the world. I is the number of images: T, or T·V with several views.
    """

    def __init__(
        self,
        pose: Pose,
        anchor: Pose,
        targets: Targets,
        rig: Rig,
        priors: Priors,
        camera: CropCamera,
        raster: Raster,
        shared: tuple[str, ...] = (),
    ):
        self.pose = pose
        """The optimised pose: `global_orient` (T, 3), `body_pose` (T, J−1, 3), `transl` (T, 3), `scale`, …"""
        self.anchor = anchor
        """The pose at the start of the current stage."""
        self.targets = targets
        """The observations: `keypoints_px`, `confidence`, `mask`, `present`, …"""
        self.priors = priors
        self.camera = camera
        self.raster = raster
        self.shared = shared
        """The names of optimised parameters of `curvature.SHARED_PARAMETERS`, in that order. These parameters have
        columns in derivatives."""
        self._rig = rig

    def moved(self, rows: Rows) -> PosedWindow:
        """Return the window with its pose plus a change, one row per frame (`curvature.frame_rows`)."""
        pose = add_rows(self.pose, rows, self.shared)
        others = self.anchor, self.targets, self._rig, self.priors, self.camera, self.raster, self.shared
        return PosedWindow(pose, *others)

    @property
    def present(self) -> Bool[Array | np.ndarray, "T"]:
        """False in frames without an observation of the bird; poses of these frames are meaningless, and terms must
        skip them."""
        return self.targets.present

    @property
    def frame_s(self) -> Float[Array | np.ndarray, ""]:
        """Time between consecutive frames in seconds; 1/25 s if the frame rate is unknown."""
        return self.targets.frame_s

    @property
    def joint_limits(self) -> Float[Array, "bones 3 2"]:
        """Minimum and maximum of each component of the body pose, radians.

        Raises:
            InputError: the model has no joint limits.
        """
        if self.priors.joint_limits is None:
            remedy = "remove the terms that need joint limits, or use a model with joint limits, such as the murre"
            raise InputError("the model", "has no joint limits", remedy)
        return self.priors.joint_limits

    def joint_indices(self, *names: str) -> tuple[int, ...]:
        """Return the indices of joints among all joints, root first; subtract 1 for the indices in `body_pose`.

        Raises:
            InputError: the model has no such joint.
        """
        return _indices("joint", names, self._rig.joint_names)

    def keypoint_indices(self, *names: str) -> tuple[int, ...]:
        """Return the indices of keypoints among all keypoints.

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
        """Body pose: rotation of every joint except the root relative to its parent."""
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
        """Posed keypoints in the camera frame of the window's first frame, that is, in a crop that does not move.

        x_static = x_cam + (corner − corner of the first frame) · z / focal length, for x and y. If the filming camera
        is at rest, a point at rest in the world has a constant position here, up to the noise of the fit.
        """
        if self.targets.views is not None:
            return self.keypoints_cam
        x, z = self.keypoints_cam[..., :2], self.keypoints_cam[..., 2:]
        shift = jnp.asarray(self.targets.corner_px - self.targets.corner_px[:1])
        return jnp.concatenate([x + shift[:, None] * z / self.camera.focal_px, z], axis=-1)

    @cached_property
    def place_acceleration_px(self) -> Float[Array, "accelerations axes"]:
        """Acceleration of the bird, crop pixels per frame²: second differences of the projected translation (x, y),
        with the movement of the crop added. With several views, those of the translation itself (x, y, z), times
        `ViewMaps.px_per_unit`."""
        views, transl = self.targets.views, jnp.asarray(self.pose.transl)
        if views is not None:
            return jnp.diff(transl, 2, axis=0) * views.px_per_unit
        place_px = project(transl, self.camera)
        # differences of the corner first: its values are large beside the changes
        return jnp.diff(place_px, 2, axis=0) + jnp.diff(jnp.asarray(self.targets.corner_px), 2, axis=0)

    @cached_property
    def keypoints_px(self) -> Float[Array, "T K 2"]:
        """Posed keypoints, crop pixels; K counts the keypoints of all views."""
        points = self.keypoints_cam
        if self.targets.views is not None:
            points = self.targets.views.points(points)
        return project(points, self.camera).reshape(len(points), -1, 2)

    @cached_property
    def keypoint_jacobian_px(self) -> tuple[Float[Array, "T rows part"], ...]:
        """Derivatives of `keypoints_px` of each frame, (T, 2K, …), in the columns of `curvature.frame_rows`.

        The parts are the derivatives with respect to the 3J angles, to translation and scale (4), and to each of the
        parameters `shared`.
        """
        scale = jnp.broadcast_to(self.pose.scale, self.pose.global_orient.shape[:1])
        points, views = self.keypoints_cam, self.targets.views
        slope = jax.jacfwd(lambda point_cam: project(point_cam, self.camera))
        if views is None:
            by_point = jax.vmap(jax.vmap(slope))(points)
        else:  # the rows of all views of a keypoint are rows of one point
            by_view = jax.vmap(jax.vmap(jax.vmap(slope)))(views.points(points))
            by_point = jnp.einsum("tvkri,tvij->tkvrj", by_view, views.linear).reshape(*points.shape[:2], -1, 3)
        by_angles = window_keypoint_rows(self._rig, self._transforms, self.pose, by_point)
        unit = (points - self.pose.transl[:, None]) / scale[:, None, None]
        by_scale = jnp.sum(by_point * unit[..., None, :], axis=-1, keepdims=True)
        by_place = jnp.concatenate([by_point, by_scale], axis=-1)
        by_shared = (
            by_point @ window_keypoint_derivatives(self._rig, self._transforms, self.pose, name) for name in self.shared
        )
        blocks = (by_angles, by_place, *by_shared)
        if views is not None:  # keypoints of one view are neighbours, as in the targets
            T, K, V = *points.shape[:2], views.linear.shape[1]
            blocks = (block.reshape(T, K, V, 2, -1).swapaxes(1, 2) for block in blocks)
        rows = len(points), self.keypoints_px.shape[1] * 2
        return tuple(block.reshape(*rows, -1) for block in blocks)

    @cached_property
    def vertices_screen(self) -> Float[Array, "I V 3"]:
        """Posed vertices as (x, y) in pixels of the silhouette and depth z in the camera frame, for the raster core."""
        vertices = window_vertices(self._rig, self._transforms, self.pose)
        if self.targets.views is not None:
            vertices = self.targets.views.points(vertices).reshape(-1, *vertices.shape[1:])
        screen = to_screen(vertices, self.camera)
        ratio = self.raster.size_px / self.camera.size_px
        return screen if ratio == 1 else screen * jnp.array([ratio, ratio, 1.0])

    @cached_property
    def skin(self) -> Skin:
        """Derivatives of the vertices with respect to a row of `curvature.frame_rows`, in factors. Only
        `transforms`, `generators` and `view` have a leading axis of images I. They are constants for JAX."""
        pose, transforms = jax.lax.stop_gradient((self.pose, self._transforms))
        rest = shaped_vertices(self._rig, pose)
        with_bones = "bone_length" in self.shared
        generators = window_transform_generators(self._rig, transforms, pose, with_bones)
        transforms = jnp.reshape(pose.scale, (-1, 1, 1, 1)) * transforms
        view = jnp.broadcast_to(jnp.eye(3), (len(transforms), 3, 3))
        shape_basis = self._rig.shape_basis.transpose(2, 1, 0)
        if "betas" not in self.shared:
            shape_basis = shape_basis[..., :0]
        views = self.targets.views
        if views is not None:
            view = jnp.reshape(views.linear, (-1, 3, 3))
            transforms, generators = (jnp.repeat(x, views.linear.shape[1], axis=0) for x in (transforms, generators))
        moved = jnp.asarray(moved_joints(self._rig, with_bones))
        weights = self._rig.vertex_joints, self._rig.vertex_weights
        return Skin(rest.T, *weights, transforms, generators, moved, view, shape_basis)

    @property
    def mask(self) -> UInt8[Array | np.ndarray, "I H W"]:
        """Masks of all images."""
        return self.targets.mask.reshape(-1, *self.targets.mask.shape[-2:])

    @property
    def has_mask(self) -> Bool[Array | np.ndarray, "I"]:
        """False for images without a mask."""
        return self.targets.has_mask.reshape(-1)

    @property
    def faces(self):
        """Vertex indices of the triangles, (F, 3)."""
        return self._rig.faces


def _indices(kind: str, names: tuple[str, ...], known: tuple[str, ...]) -> tuple[int, ...]:
    for name in names:
        if name not in known:
            raise InputError("the model", f"has no {kind} {name!r}", f"it has {', '.join(known)}")
    return tuple(known.index(name) for name in names)
