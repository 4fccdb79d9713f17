"""The meshes of a solution, posed again in the image."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxfit.camera import Camera, to_screen
from jaxfit.fitting.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import Rig, fold_bird, joint_transforms, posed_vertices
from jaxfit.model.pose import Pose

__all__ = ["PosedBirds"]


class PosedBirds:
    """A solution's mesh, track by track and frame by frame (positions, not numbers)."""

    def __init__(self, solution: Solution, bird: Bird):
        self.solution = solution
        self._rig = fold_bird(bird)

    @property
    def faces(self) -> Array:
        """Vertex indices of each triangle, (F, 3)."""
        return self._rig.faces

    def vertices_screen(self, n: int, t: int) -> Float[np.ndarray, "V 3"]:
        """Vertices as x, y in image pixels and depth in model units."""
        s = self.solution
        x0, y0, size = s.crop[n, t]
        camera = Camera(s.focal * size / s.crop_px, size / 2)
        pose = Pose(**{name: np.asarray(getattr(s, name)[n, t]) for name in Pose.__dataclass_fields__})
        return np.asarray(_screen(self._rig, pose, camera)) + np.array([x0, y0, 0], np.float32)


@jax.jit
def _screen(rig: Rig, pose: Pose, camera: Camera) -> Float[Array, "V 3"]:
    return to_screen(posed_vertices(rig, joint_transforms(rig, pose), pose), camera)
