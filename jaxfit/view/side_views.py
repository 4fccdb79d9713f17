"""Side views: the strip below an overlay with every bird seen from its left, one tile per track."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial.transform import Rotation

from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import draw, shade
from jaxfit.view.colours import PAPER, tinted, track_colour
from jaxfit.view.drawing import tag, text

__all__ = ["SideViews", "up_direction"]

LIGHT = (-0.35, -0.6, -0.7)
"""Direction from the bird to the light, which is above and to the left of the camera."""
FOOT_WORDS = ("foot", "toe", "shin", "ankle")


def up_direction(solution: Solution) -> Float[np.ndarray, "3"]:
    """Estimate the upward direction in the camera frame: a unit vector.

    A standing bird has its body above its feet. So up is the mean over all birds and frames of the direction from the
    feet to the other keypoints; the leans of birds that face different directions cancel. Without keypoints on the
    feet, up is the upward direction of the image.
    """
    names, valid = solution.keypoint_names, solution.valid
    feet = np.array([any(word in name for word in FOOT_WORDS) for name in names], bool)
    if not feet.any() or feet.all() or not valid.any():
        return np.array([0.0, -1.0, 0.0])
    points = solution.keypoints_cam[valid].astype(np.float64)
    directions = points[:, ~feet].mean(1) - points[:, feet].mean(1)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
    total = directions.mean(0)
    length = np.linalg.norm(total)
    return total / length if length > 0.1 else np.array([0.0, -1.0, 0.0])


class SideViews:
    """Draws a strip with one tile per track; each tile shows the bird from its left at eye level, so it faces left.

    The layout is the same in all frames. All birds are drawn at one size, independent of the scale of the fit, in
    parallel projection.

    Args:
        solution: the result.
        bird: the model of the result.
        width: width of the strip, pixels.
        text_px: height of the text, pixels.
    """

    def __init__(self, solution: Solution, bird: Bird, width: int, text_px: float):
        N, valid = len(solution.track_id), solution.valid
        self.solution, self.text_px, self.width = solution, text_px, width
        self.columns = max(1, min(N, max(2, width // 150), 8))
        self.tile_px = min(width // self.columns, max(width // 5, 128))
        self.height = math.ceil(N / self.columns) * self.tile_px
        self._faces = np.asarray(bird.faces)
        self._colours = [tinted(np.asarray(bird.vertex_colours), n, 0.75) for n in range(N)]
        up = up_direction(solution)
        turns = Rotation.from_rotvec(np.where(valid[..., None], solution.global_orient, 0).reshape(-1, 3))
        left = turns.apply(_left(bird)).reshape(*valid.shape, 3)
        left -= (left @ up)[..., None] * up
        left /= np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-6)
        down = np.broadcast_to(-up, left.shape)
        self._R_view_cam = np.stack([np.cross(down, -left), down, -left], axis=-2)  # x right, y down, z forward
        points = np.where(valid[..., None, None], solution.keypoints_cam, 0).astype(np.float64)
        self._centre_cam = points.mean(2)
        spread = np.einsum("ntij,ntkj->ntki", self._R_view_cam, points - self._centre_cam[:, :, None])
        reach = np.abs(spread[..., :2]).max((2, 3)) / np.where(valid, solution.scale, 1)
        # a percentile, so that a few failed frames do not make all other birds small
        self._zoom = 0.5 * self.tile_px / max(1.12 * float(np.percentile(reach[valid], 98)), 1e-6) if valid.any() else 1

    def draw(
        self, t: int, shown: Bool[np.ndarray, "N"], vertices_cam: Sequence[Float[np.ndarray, "V 3"]]
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Return the strip of the frame at position `t`.

        Args:
            t: position of the frame.
            shown: whether each track has a pose in this frame.
            vertices_cam: mesh of each track in the camera frame of its crop, model units.
        """
        strip = np.full((self.height, self.width, 3), PAPER, np.uint8)
        for n, track in enumerate(self.solution.track_id):
            y, x = (i * self.tile_px for i in divmod(n, self.columns))
            tile = strip[y : y + self.tile_px, x : x + self.tile_px]
            if shown[n]:
                tile[:] = self._bird(n, t, vertices_cam[n])
            else:
                text(tile, "not here", 0.6 * self.text_px, 3 * self.text_px, self.text_px, (170, 170, 170))
            tile[:, -1:] = (222, 222, 222)
            tile[:1] = tile[-1:] = (222, 222, 222)
            tag(tile, f"track {track}", 0.5 * self.text_px, 1.3 * self.text_px, self.text_px, track_colour(n))
        return strip

    def _bird(self, n: int, t: int, vertices_cam: Float[np.ndarray, "V 3"]) -> UInt8[np.ndarray, "S S 3"]:
        blank = np.full((self.tile_px, self.tile_px, 3), PAPER, np.uint8)
        offset = (vertices_cam - self._centre_cam[n, t]) @ self._R_view_cam[n, t].T / self.solution.scale[n, t]
        return draw_parallel(blank, offset * self._zoom, self._faces, self._colours[n])


def draw_parallel(
    image: UInt8[np.ndarray, "H W 3"],
    points_px: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
    samples: int = 2,
    light: tuple[float, float, float] = LIGHT,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw a shaded mesh in parallel projection over a copy of an image.

    Args:
        image: the background.
        points_px: x right, y down, z away from the viewer, relative to the centre of the image, pixels.
        faces, colours: faces and vertex colours of the mesh; the channels are in the order of the image.
        samples: as for `jaxfit.raster.zbuffer.draw`.
        light: as for `jaxfit.raster.zbuffer.shade`.
    """
    middle = np.array([image.shape[1] / 2, image.shape[0] / 2, 10 * max(image.shape)])
    lit = shade(points_px, faces, colours, light)
    return draw(image, (points_px + middle).astype(np.float32), faces, lit, samples)


def _left(bird: Bird) -> Float[np.ndarray, "3"]:
    """Return the bird's left in the rest pose, a unit vector: from pairs of joints or keypoints, else −x."""
    for places, pairs in ((bird.joints, bird.joint_pairs), (bird.keypoints, bird.keypoint_pairs)):
        if pairs:
            direction = np.mean([np.asarray(places)[a] - np.asarray(places)[b] for a, b in pairs], axis=0)
            if np.linalg.norm(direction) > 1e-6:
                return direction / np.linalg.norm(direction)
    return np.array([-1.0, 0.0, 0.0])
