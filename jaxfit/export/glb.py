"""Animated birds as glTF: one file, or a file per bird, with the ground.

A bird is a mesh with a skeleton. The scene has y up, and lengths in metres where the length of a model unit is known.
The node `footage_camera` is a camera with the field of view of the images: a picture of this camera shows the birds at
their places in the footage. Birds have the size of the model, because one camera measures neither size nor distance.
Birds in a world have their own size, and the scene of a result on a ledge is the world: its ledge is y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.data.projection import upward
from jaxfit.export.gltf import INDICES, VERTICES, GltfBuilder, Motion, add_bird, bird_motion, body_length, weight_error
from jaxfit.export.result import Exported, describe_tracks, export_folder
from jaxfit.foundation.extras import __version__
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask

_MARGIN = 0.5
"""Margin of the ground around the birds, as a share of their spread and of a body length."""
_FARTHEST = 5.0
"""Birds beyond this multiple of the median distance do not widen the ground: their fits are wrong."""


_CAMERA_TO_GLTF = np.diag([1.0, -1.0, -1.0])
"""Rotation from the camera frame (y down, z forward) to that of glTF (y up, z backward)."""
_WORLD_TO_GLTF = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
"""Rotation from a world with z up to the frame of glTF."""


class Ground(NamedTuple):
    """Rotation and translation from the camera frame of the image to a frame with the ground at y = 0, y up."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    low: Float[np.ndarray, "2"]
    """Smallest x and z of the ground."""
    high: Float[np.ndarray, "2"]


def level_ground(exported: Exported, motions: dict[int, Motion]) -> Ground:
    """Estimate the ground from the birds.

    The upward direction is that of `upward`. The height is the median over the birds of the median height of their
    lower foot. Both are estimates: the depth of a bird is not measured.

    Args:
        exported: the result.
        motions: position of a track → its motion.
    """
    s = exported.solution
    bodies = []
    for n, motion in motions.items():
        turn = Rotation.from_quat(motion.facing)
        bodies.append((turn * Rotation.from_rotvec(s.global_orient[n, motion.at].astype(np.float64))).as_matrix())
    up = upward(np.concatenate(bodies))
    forward = np.array([0, 0, 1.0]) if abs(up[2]) < 0.99 else np.array([0, -1.0, 0])
    backward = -(forward - (forward @ up) * up)
    backward /= np.linalg.norm(backward)
    rotation = np.stack([np.cross(up, backward), up, backward])
    feet = _feet(exported, motions)
    height = float(np.median([np.median((each @ rotation[1]).min(axis=1)) for each in feet]))
    return _below(exported, feet, rotation, np.array([0, -height, 0]))


def ledge_ground(exported: Exported, motions: dict[int, Motion]) -> Ground:
    """Return the ledge of the result, the plane z = 0 of its world, as the ground.

    Every pose is known in the frame of the camera and in the world, so the first pose gives the camera in the world.
    """
    s = exported.solution
    n, t = np.argwhere(s.valid)[0].tolist()
    R_cam_root = Rotation.from_rotvec(exported.in_image.orientation[n, t]).as_matrix()
    R_world_cam = np.asarray(s.R_world_root)[n, t] @ R_cam_root.T
    position_m = np.asarray(s.transl_world_m)[n, t] - R_world_cam @ exported.in_image.root[n, t] * exported.length
    return _below(exported, _feet(exported, motions), _WORLD_TO_GLTF @ R_world_cam, _WORLD_TO_GLTF @ position_m)


def _feet(exported: Exported, motions: dict[int, Motion]) -> list[Float[np.ndarray, "_ F 3"]]:
    """Return the feet of every bird in the camera frame of the image; all keypoints where none is on a foot."""
    s = exported.solution
    feet = [k for k, name in enumerate(s.keypoint_names) if "foot" in name] or list(range(len(s.keypoint_names)))
    points = exported.in_image.points(s.keypoints_cam[:, :, feet], s.scale) * exported.length
    return [points[n, motion.at] for n, motion in motions.items()]


def _below(
    exported: Exported,
    feet: list[Float[np.ndarray, "_ F 3"]],
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
) -> Ground:
    """Return the ground of a frame, with a size that the feet of the birds determine."""
    points = np.concatenate([each.reshape(-1, 3) for each in feet])
    distance = np.linalg.norm(points, axis=1)
    near = points[distance <= _FARTHEST * np.median(distance)]
    flat = (near @ rotation.T + translation)[:, [0, 2]]
    low, high = flat.min(0), flat.max(0)
    margin = _MARGIN * (body_length(exported.bird) * exported.length + float((high - low).max()))
    return Ground(rotation, translation, low - margin, high + margin)


def add_ground(builder: GltfBuilder, ground: Ground) -> None:
    """Add a level rectangle at y = 0."""
    (x0, z0), (x1, z1) = ground.low, ground.high
    corners = np.array([[x0, 0, z0], [x0, 0, z1], [x1, 0, z1], [x1, 0, z0]], np.float32)
    surface = {"baseColorFactor": [0.35, 0.33, 0.3, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"name": "ground", "pbrMetallicRoughness": surface, "doubleSided": True}
    primitive = {
        "attributes": {
            "POSITION": builder.add_array(corners, VERTICES, bounds=True),
            "NORMAL": builder.add_array(np.tile(np.array([[0, 1, 0]], np.float32), (4, 1)), VERTICES),
        },
        "indices": builder.add_array(np.array([0, 1, 2, 0, 2, 3], np.uint16), INDICES),
        "material": builder.add("materials", material),
    }
    mesh = builder.add("meshes", {"name": "ground", "primitives": [primitive]})
    builder.root["scenes"][0]["nodes"].append(builder.add("nodes", {"name": "ground", "mesh": mesh}))


def write_glb(
    exported: Exported,
    out: Path,
    progress: ProgressTask,
    ground: bool = False,
    overwrite: bool = False,
) -> tuple[list[Path], list[str]]:
    """Write one `.glb` for every bird with a pose, or one for all birds.

    Args:
        exported: the result.
        out: a folder for a file of every bird, or a file for all birds whose name ends with `.glb`.
        progress: shows progress.
        ground: add a rectangle below the feet, and turn the scene so that the rectangle is level. A result on a ledge
            is always in its world, and the rectangle is the ledge.
        overwrite: replace an earlier export in the folder.

    Returns:
        The files, and notes on the precision.

    Raises:
        InputError: no pose is chosen, or the frame rate is unknown.
    """
    exported.require_poses()
    exported.require_fps()
    fitted = np.flatnonzero(exported.solution.valid.any(axis=1)).tolist()
    with progress("Writing glTF", len(fitted)) as report_progress:
        motions: dict[int, Motion] = {}
        for n in fitted:
            motions[n] = bird_motion(exported, n)
            report_progress(0.5, f"track {exported.solution.track_id[n]}")
        scene = None
        if exported.solution.contact is not None:
            scene = ledge_ground(exported, motions)
        elif ground:
            scene = level_ground(exported, motions)
        error = weight_error(exported)
        facts = {"largest_error_of_four_weights": error, "focal_length_px": exported.focal_px}
        if out.suffix == ".glb":
            write_whole(out, _content(exported, motions, fitted, scene, ground, facts))
            files = [out]
        else:
            tracks = {n: int(exported.solution.track_id[n]) for n in fitted}
            names = {track: f"bird_{track}.glb" for track in tracks.values()}
            with export_folder(exported, out, overwrite, names, facts) as folder:
                for n, track in tracks.items():
                    write_whole(folder / names[track], _content(exported, motions, [n], scene, ground, facts))
                    report_progress(0.5, names[track])
            files = [out / name for name in names.values()]
    notes = []
    if error:
        notes.append(
            f"glTF has four joints for a vertex at most: vertices move by up to {error:.2%} of the body length"
        )
    return files, notes


def _content(
    exported: Exported,
    motions: dict[int, Motion],
    chosen: Sequence[int],
    scene: Ground | None,
    ground: bool,
    facts: dict[str, Any],
) -> bytes:
    """Return a `.glb` with some birds."""
    s = exported.solution
    times = {"fps": exported.fps, "first_frame": int(s.frame_index[0]), "first_time_s": float(exported.times_s[0])}
    extras = {"unit_of_lengths": exported.unit, "model": exported.bird.name, **times, **facts}
    if len(chosen) == len(motions):
        extras["tracks"] = describe_tracks(exported)
    builder = GltfBuilder({"generator": f"jaxfit {__version__}", "extras": extras})
    frame = builder.add("nodes", {"name": "camera_frame"})
    builder.root["scenes"][0]["nodes"].append(frame)
    rotation = _CAMERA_TO_GLTF if scene is None else scene.rotation
    node = builder.root["nodes"][frame]
    node["rotation"] = _quaternion(rotation)
    if scene is not None:
        node["translation"] = scene.translation.tolist()
        if ground:
            add_ground(builder, scene)
    width, height = np.median(s.image_size_px[s.valid], axis=0).tolist()
    view = {"yfov": 2 * float(np.arctan(height / 2 / exported.focal_px)), "aspectRatio": width / height, "znear": 0.01}
    camera = builder.add("cameras", {"type": "perspective", "perspective": view})
    looking = {"name": "footage_camera", "camera": camera, "rotation": _quaternion(_CAMERA_TO_GLTF)}
    node["children"] = [builder.add("nodes", looking)]
    animation = builder.add("animations", {"name": "motion", "channels": [], "samplers": []})
    for n in chosen:
        add_bird(builder, exported, n, motions[n], frame, animation)
    return builder.content()


def _quaternion(rotation: np.ndarray) -> list[float]:
    return [float(value) for value in Rotation.from_matrix(rotation).as_quat().astype(np.float32)]
