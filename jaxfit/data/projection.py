"""A solution in the image and in the camera frame of the image: meshes, keypoints, places of the birds.

Birds in the camera frame of the whole image, which is fixed in the scene; a crop moves with its bird. x is right, y
down, z forward, and the axis goes through the centre of the image. One camera measures directions only. Distances
follow from two assumptions: the bird has the size of the model, and the footage has one focal length. Poses in the
frame of a calibrated camera need neither: size, focal length and principal point are known. A wrong size changes all
positions by the same factor. A wrong focal length changes the depths by the same factor, and does not change the
positions across the picture.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxfit.cameras.camera import Camera
from jaxfit.data.masks import box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.data.world import in_frame_of_camera
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Pose, Rig, fold_bird, joint_transforms, posed_vertices
from jaxfit.model.rotation import unwrap_axis_angle


class InImage(NamedTuple):
    """The birds of a solution at the size of the model, N tracks in T frames; NaN without a pose."""

    focal_px: float
    """Focal length of the image in image pixels."""
    root: Float[np.ndarray, "N T 3"]
    """Position of the root joint in the camera frame of the image, model units."""
    turn: Float[np.ndarray, "N T 3 3"]
    """Rotation from the camera frame of the crop to the camera frame of the image."""
    orientation: Float[np.ndarray, "N T 3"]
    """Rotation from the model to the camera frame of the image: axis-angles in radians, continuous in time."""
    root_in_crop: Float[np.ndarray, "N T 3"]
    """Position of the root joint in the camera frame of the crop, model units."""
    size: Float[np.ndarray, "N T"]
    """Size of the bird in these frames, relative to the model: 1, or the true size in the frame of a camera."""

    def points(
        self, points_cam: Float[np.ndarray, "N T P 3"], scale: Float[np.ndarray, "N T"]
    ) -> Float[np.ndarray, "N T P 3"]:
        """Return points of a solution in the camera frame of the image, model units.

        Args:
            points_cam: in the camera frame of the crop, such as `Solution.keypoints.cam`.
            scale: `Solution.poses.scale`.
        """
        from_root = points_cam / (scale / self.size)[..., None, None] - self.root_in_crop[:, :, None]
        return from_root @ self.turn.swapaxes(-1, -2) + self.root[:, :, None]


def image_focal_px(solution: Solution) -> float:
    """Return a focal length of the whole image in image pixels: the median over all poses of that of their crops.

    The focal length of the footage is unknown. Every crop has its own focal length in image pixels: focal_px · size /
    crop_px. NaN without a pose.
    """
    sizes = solution.crops.square_px[..., 2][solution.valid]
    return float(np.median(solution.crops.focal_px * sizes / solution.crops.crop_px)) if sizes.size else np.nan


def in_image(
    solution: Solution, bird: Bird, focal_px: float | None = None, centre_px: tuple[float, float] | None = None
) -> InImage:
    """Place the birds of a solution in the camera frame of the image.

    The camera of the image sees the root joint at the same pixel as the camera of the crop, and sees the bird at the
    same size in the picture: with the scale of the bird in the result, and the focal length f of the crop in image
    pixels, depth' = depth / scale · focal_px / f. The bird is turned about its root joint by the rotation between the
    viewing rays of the root joint, so that both cameras see the same side of the bird.

    Args:
        solution: the poses.
        bird: the model of the solution.
        focal_px: focal length of the image; None takes `image_focal_px`.
        centre_px: principal point of the image; None takes the middle of the image.
    """
    s, focal = solution, image_focal_px(solution) if focal_px is None else focal_px
    at = np.nonzero(s.valid)
    crop = s.crops.square_px[at].astype(np.float64)
    of_camera = in_frame_of_camera(s)  # then the size is the true size
    scale = np.asarray(s.poses.scale[at], np.float64)
    size = scale if of_camera else np.ones(len(at[0]))
    root = np.asarray(s.poses.transl[at]) / (scale / size)[:, None] + size[:, None] * np.asarray(
        bird.joints[0], np.float64
    )
    crop_focal = s.crops.focal_px * crop[:, 2:] / s.crops.crop_px
    pixel = root[:, :2] / root[:, 2:] * crop_focal + crop[:, :2] + crop[:, 2:] / 2
    # the pictures of a camera have one size; a photograph may have its own
    middle_of_crop = crop[:, :2] + crop[:, 2:] / 2
    # the crop of the whole picture has the principal point of the camera in its middle
    known = middle_of_crop if of_camera else s.crops.image_size_px[at] / 2
    centre = known if centre_px is None else np.asarray(centre_px)
    ray = np.concatenate([(pixel - centre) / focal, np.ones((len(root), 1))], axis=1)
    rotation = scipy.spatial.transform.Rotation.from_rotvec
    turn = rotation(_between(root, ray))
    orient = (turn * rotation(s.poses.global_orient[at].astype(np.float64))).as_rotvec()

    def everywhere(values: np.ndarray) -> np.ndarray:
        filled = np.full((*s.valid.shape, *values.shape[1:]), np.nan)
        filled[at] = values
        return filled

    placed = ray * (root[:, 2:] * focal / crop_focal)
    return InImage(
        focal_px=focal,
        root=everywhere(placed),
        turn=everywhere(turn.as_matrix().reshape(-1, 3, 3)),
        orientation=_continuous(everywhere(orient), s.valid),
        root_in_crop=everywhere(root),
        size=everywhere(size),
    )


BACKS = 0.1
"""Weight of the direction of the backs in `upward`, which decides where the lateral axes do not."""


def upward(axes: Float[np.ndarray, "M 3 3"]) -> Float[np.ndarray, "3"]:
    """Return the upward direction that standing birds show.

    The lateral axes of standing birds are level, so the direction n minimises Σ (n · x)² / M − w (n · z̄)² over the
    lateral axes x of all poses, with the mean direction z̄ of the backs.

    Args:
        axes: rotation of each pose from the model to a common frame.
    """
    x, back = axes[:, :, 0], axes[:, :, 2].mean(axis=0)
    up = np.linalg.eigh(x.T @ x / len(x) - BACKS * np.outer(back, back))[1][:, 0]
    return up if up @ back > 0 else -up


def _between(first: Float[np.ndarray, "M 3"], second: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 3"]:
    """Return the smallest rotations that turn one direction into another, axis-angles in radians."""
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (first, second))
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis, axis=1, keepdims=True), np.sum(a * b, axis=1, keepdims=True)
    return axis / np.maximum(sine, 1e-12) * np.arctan2(sine, cosine)


def _continuous(axis_angle: Float[np.ndarray, "N T 3"], valid: np.ndarray) -> Float[np.ndarray, "N T 3"]:
    """Return the same rotations without jumps by a whole turn; gaps do not interrupt."""
    latest = np.maximum.accumulate(np.where(valid, np.arange(valid.shape[1]), 0), axis=1)
    filled = jnp.asarray(np.nan_to_num(np.take_along_axis(axis_angle, latest[..., None], axis=1)))
    return np.where(valid[..., None], np.asarray(_unwrapped(filled)), np.nan)


_unwrapped = jax.jit(jax.vmap(unwrap_axis_angle))


class PosedBirds:
    """The posed meshes of a solution; n and t are positions of tracks and frames, not their numbers.

    Args:
        solution: the poses.
        bird: the model of the solution.
        lens: the camera whose frame the poses are in (`data.world.as_filmed`), as it films. None: the camera of the
            crops, without distortion.
        vertices: positions of the vertices to pose; None poses all.
    """

    def __init__(
        self,
        solution: Solution,
        bird: Bird,
        lens: Camera | None = None,
        vertices: Int[np.ndarray, "P"] | None = None,
    ):
        self.solution = solution
        self._lens = None if lens is None else replace(lens, R_cam_world=np.eye(3), transl_cam=np.zeros(3))
        self._rig = rig = fold_bird(bird)
        if vertices is not None:
            of_vertices = {
                name: getattr(rig, name)[..., vertices] for name in ("vertices", "skin_weights", "shape_basis")
            }
            self._rig = replace(rig, **of_vertices)

    @property
    def faces(self) -> Array:
        """Vertex indices of each triangle, (F, 3)."""
        return self._rig.faces

    def vertices_screen(self, n: int, t: int) -> Float[np.ndarray, "V 3"]:
        """Return the vertices of one frame: x, y in image pixels, depth in model units."""
        return self.vertices_screen_window(n, slice(t, t + 1))[0]

    def vertices_cam_window(self, n: int, frames: slice = slice(None)) -> Float[np.ndarray, "T V 3"]:
        """Return the vertices of many frames in the camera frame of the crop, model units, by one compiled call.

        Args:
            n: position of the track.
            frames: positions of the frames. Slices of equal length share one compiled program.

        Returns:
            One mesh per frame; arbitrary, and possibly NaN, where the solution is not valid.
        """
        pose = jax.tree.map(lambda values: values[n, frames], self.solution.poses)
        return np.asarray(_window_cam(self._rig, pose))

    def vertices_screen_window(self, n: int, frames: slice = slice(None)) -> Float[np.ndarray, "T V 3"]:
        """Return `vertices_screen` of many frames, by one compiled call; arguments as for `vertices_cam_window`."""
        return self.to_image(self.vertices_cam_window(n, frames), n, frames)

    def to_image(
        self, vertices_cam: Float[np.ndarray, "T V 3"], n: int, frames: slice = slice(None)
    ) -> Float[np.ndarray, "T V 3"]:
        """Project vertices from the camera frame of the crops (model units) to image pixels and depth.

        The divisor is at least 1e-3, also for smaller depths.
        """
        s, crop = self.solution, self.solution.crops.square_px[n, frames][:, None]
        size, depth = crop[..., 2:], np.maximum(vertices_cam[..., 2:], 1e-3)
        if self._lens is None:
            xy = vertices_cam[..., :2] * (s.crops.focal_px * size / s.crops.crop_px / depth) + size / 2 + crop[..., :2]
        else:
            xy = self._lens.project(np.concatenate([vertices_cam[..., :2], depth], axis=-1))
        return np.concatenate([xy, vertices_cam[..., 2:]], axis=-1).astype(np.float32)


@jax.jit
def _window_cam(rig: Rig, pose: Pose) -> Float[Array, "T V 3"]:
    # bone lengths and shape differ between the windows of a track, so the rig cannot be folded for the whole track
    return jax.vmap(lambda frame: posed_vertices(rig, joint_transforms(rig, frame), frame))(pose)


def projected_observations(solution: Solution) -> Observations:
    """Return the projected keypoints of all valid poses, with confidence 1, and their boxes."""
    N, T = solution.valid.shape
    K = len(solution.keypoint_names)
    confidence = np.broadcast_to(solution.valid[..., None], (N, T, K)).astype(np.float32)
    points = np.where(solution.valid[..., None, None], solution.keypoints.px, 0)
    box = box_of_keypoints(points, confidence > 0)
    sizes = solution.crops.image_size_px[solution.valid]
    return Observations(
        track_id=solution.track_id,
        frame_index=solution.frame_index,
        present=solution.valid,
        keypoints_px=points,
        confidence=confidence,
        box_px=np.where(solution.valid[..., None], np.concatenate([box[..., :2], np.maximum(box[..., 2:], 1)], -1), 0),
        image_size_px=np.tile(sizes.max(0) if len(sizes) else np.ones(2, np.int64), (T, 1)),
        file_name=np.array([f"frame {number}" for number in solution.frame_index.tolist()], str).reshape(T),
        keypoint_names=solution.keypoint_names,
        skeleton=skeleton_pairs(solution.keypoint_names),
        timestamp_s=solution.timestamp_s,
        fps=solution.fps,
    )
