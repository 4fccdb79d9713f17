"""Posed meshes of a solution, in the camera frame and in the image."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, fold_bird, joint_transforms, posed_vertices
from jaxfit.model.pose import Pose

__all__ = ["PosedBirds"]


class PosedBirds:
    """The posed meshes of a solution; n and t are positions of tracks and frames, not their numbers."""

    def __init__(self, solution: Solution, bird: Bird):
        self.solution = solution
        self._rig = fold_bird(bird)

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
        pose = jax.tree.map(lambda values: values[n, frames], self.solution.pose)
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
        s, crop = self.solution, self.solution.crop[n, frames][:, None]
        size = crop[..., 2:]
        scale = s.focal_px * size / s.crop_px / np.maximum(vertices_cam[..., 2:], 1e-3)
        xy = vertices_cam[..., :2] * scale + size / 2 + crop[..., :2]
        return np.concatenate([xy, vertices_cam[..., 2:]], axis=-1).astype(np.float32)


@jax.jit
def _window_cam(rig: Rig, pose: Pose) -> Float[Array, "T V 3"]:
    # bone lengths and shape differ between the windows of a track, so the rig cannot be folded for the whole track
    return jax.vmap(lambda frame: posed_vertices(rig, joint_transforms(rig, frame), frame))(pose)
