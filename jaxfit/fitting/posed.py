"""The meshes of a solution, posed again: vertices and hard masks in the image."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfit.camera import Camera, to_screen
from jaxfit.fitting.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, fold_bird, joint_transforms, posed_vertices
from jaxfit.model.pose import Pose
from jaxfit.silhouette import Blur, silhouette

__all__ = ["PosedBirds"]

SHARP = Blur(1e-6, 1e-3)
"""A blur far below a pixel: the soft silhouette is 0 or 1 at every pixel centre."""


class PosedBirds:
    """A solution's mesh, track by track and frame by frame (positions, not numbers)."""

    def __init__(self, solution: Solution, bird: Bird):
        self.solution, self.bird = solution, bird
        self._rig = fold_bird(bird)

    def vertices_screen(self, n: int, t: int) -> Float[np.ndarray, "V 3"]:
        """Vertices as x, y in image pixels and depth in model units."""
        s = self.solution
        x0, y0, size = s.crop[n, t]
        camera = Camera(s.focal * size / s.crop_px, size / 2, int(size))
        screen = np.asarray(_screen(self._rig, self._pose(n, t), camera))
        return screen + np.array([x0, y0, 0], np.float32)

    def mask(self, n: int, t: int, width: int, height: int) -> Bool[np.ndarray, "H W"]:
        """The bird's hard mask in an image of the given size: pixels whose centre the mesh covers."""
        screen = self.vertices_screen(n, t)
        low, high = np.floor(screen[:, :2].min(0)).astype(int), np.ceil(screen[:, :2].max(0)).astype(int)
        low, high = np.maximum(low, 0), np.minimum(high, [width, height])
        full = np.zeros((height, width), bool)
        if (low >= high).any():
            return full
        # squares of a few sizes only: each is a program of its own
        size = int(64 * np.ceil((high - low).max() / 64))
        covered = np.asarray(_covered(screen - np.array([*low, 0], np.float32), self._rig.faces, size))
        rows, columns = high[1] - low[1], high[0] - low[0]
        full[low[1] : high[1], low[0] : high[0]] = covered[:rows, :columns]
        return full

    def _pose(self, n: int, t: int) -> Pose:
        return Pose(**{name: getattr(self.solution, name)[n, t] for name in Pose.__dataclass_fields__})


@jax.jit
def _screen(rig: Rig, pose: Pose, camera: Camera) -> Float[Array, "V 3"]:
    return to_screen(posed_vertices(rig, joint_transforms(rig, pose), pose), camera)


@eqx.filter_jit
def _covered(vertices_screen: Float[Array, "V 3"], faces, size: int) -> Bool[Array, "size size"]:
    return silhouette(vertices_screen, faces, size, blur=SHARP) > 0.5
