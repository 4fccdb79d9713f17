"""Six views of a bird model, with a scale bar."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_vertices
from jaxfit.model.murre import POSTURES, Posture
from jaxfit.model.murre.skeleton import CM_PER_UNIT
from jaxfit.model.pose import Pose
from jaxfit.view.colours import DARK, GREY, PAPER
from jaxfit.view.drawing import text, text_width, write_png
from jaxfit.view.side_views import draw_parallel

__all__ = ["six_views"]

TILE_PX, MARGIN_PX, TITLE_PX, FOOT_PX, TEXT_PX = 400, 26, 44, 64, 17
LIGHT = (-0.3, -0.4, -0.85)
"""Direction to the light for `raster.zbuffer.shade`: towards the viewer, so that all views are equally bright."""

VIEWS = {  # name → right and down of the view, in the axes of the bird: x right, y forward, z up
    "left": ((0, -1, 0), (0, 0, -1)),
    "front": ((-1, 0, 0), (0, 0, -1)),
    "above": ((1, 0, 0), (0, -1, 0)),
    "right": ((0, 1, 0), (0, 0, -1)),
    "back": ((1, 0, 0), (0, 0, -1)),
    "below": ((-1, 0, 0), (0, -1, 0)),
}


def six_views(bird: Bird, path: str | Path, posture: Posture | str | None = None) -> None:
    """Draw a bird from left, right, front, back, above and below at one scale, and write a PNG.

    The projection is parallel, and the light comes from the viewer. The bird looks along +y and +z is up, as in the
    published models. In the views from above and below, the head is at the top.

    Args:
        bird: the model. The scale bar of the murre is in centimetres, of other models in model units.
        path: PNG file to write, 1200 pixels wide.
        posture: a body pose and its pitch, or a name in `jaxfit.model.murre.POSTURES`. None: the murre stands, other
            models have the rest pose.

    Raises:
        ValueError: the posture is unknown, or has another number of joints.
        InputError: the system rejects the write.
    """
    if posture is None:
        posture = POSTURES["standing"] if bird.name == "murre" else None
    elif isinstance(posture, str):
        if posture not in POSTURES:
            raise ValueError(f"posture must be one of {', '.join(POSTURES)}, not {posture!r}")
        posture = POSTURES[posture]
    vertices = _posed(bird, posture)
    vertices = vertices - (vertices.min(0) + vertices.max(0)) / 2
    zoom = (TILE_PX - 2 * MARGIN_PX) / np.ptp(vertices, axis=0).max()
    colours, faces = np.asarray(bird.vertex_colours)[:, ::-1], np.asarray(bird.faces)
    # lighter than in nature, since shading is invisible on dark plumage
    colours = np.clip(0.1 + 0.9 * colours**0.75, 0, 1)
    spans = {name: np.ptp(vertices @ np.array(axes, float).T, axis=0) * zoom for name, axes in VIEWS.items()}
    names = list(VIEWS)
    heights = [max(spans[name][1] for name in row) + 2 * MARGIN_PX for row in (names[:3], names[3:])]
    tiles = []
    for name, (right, down) in VIEWS.items():
        axes = np.array([right, down, np.cross(right, down)], float)
        height = round(heights[names.index(name) // 3])
        tile = np.full((height, TILE_PX, 3), PAPER, np.uint8)
        tile = draw_parallel(tile, vertices @ axes.T * zoom, faces, colours, samples=4, light=LIGHT)
        title = np.full((TITLE_PX, TILE_PX, 3), PAPER, np.uint8)
        text(title, name, (TILE_PX - text_width(name, TEXT_PX)) / 2, TITLE_PX * 0.6, TEXT_PX, DARK)
        tiles.append(np.vstack([title, tile]))
    sheet = np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:]), _scale(bird, zoom)])
    write_png(path, sheet)


def _posed(bird: Bird, posture: Posture | None) -> Float[np.ndarray, "V 3"]:
    """Return the mesh in a posture, with the pitch of the posture, in the axes of the bird."""
    if posture is None:
        return np.asarray(bird.vertices, np.float64)
    bones = bird.num_joints - 1
    if np.shape(posture.body_pose) != (bones, 3):
        raise ValueError(f"posture must have a body_pose of shape ({bones}, 3), not {np.shape(posture.body_pose)}")
    pose = Pose(
        global_orient=np.array([posture.pitch_rad, 0, 0], np.float32),
        body_pose=np.asarray(posture.body_pose, np.float32),
        transl=np.zeros(3, np.float32),
        scale=np.ones((), np.float32),
        bone_length=np.ones(bones, np.float32),
        betas=np.zeros(bird.num_shapes, np.float32),
    )
    rig = fold_bird(bird)
    return np.asarray(posed_vertices(rig, joint_transforms(rig, pose), pose), np.float64)


def _scale(bird: Bird, zoom: float) -> np.ndarray:
    """Return the bottom strip of the sheet: name of the model and a scale bar of a round length."""
    per_unit, unit = (CM_PER_UNIT, "cm") if bird.name == "murre" else (1.0, "model units")
    longest = 0.6 * TILE_PX / zoom * per_unit
    power = 10.0 ** np.floor(np.log10(longest))
    length = next(step * power for step in (5, 2, 1) if step * power <= longest)
    bar = round(length / per_unit * zoom)
    foot = np.full((FOOT_PX, 3 * TILE_PX, 3), PAPER, np.uint8)
    x, y = MARGIN_PX, FOOT_PX // 2
    cv2.rectangle(foot, (x, y - 2), (x + bar, y + 2), DARK, -1)
    for end in (x, x + bar):
        cv2.rectangle(foot, (end - 1, y - 8), (end + 1, y + 8), DARK, -1)
    text(foot, f"{length:g} {unit}", x + bar + 14, y, TEXT_PX, DARK)
    words = f"{bird.name}: {len(bird.vertices)} vertices, {len(bird.faces)} faces, {bird.num_joints} joints"
    text(foot, words, 3 * TILE_PX - MARGIN_PX - text_width(words, TEXT_PX), y, TEXT_PX, GREY)
    return foot
