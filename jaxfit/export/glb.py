"""Animated birds as glTF: one file, or a file per bird, with the ground.

A bird is a mesh with a skeleton. The scene has y up, and lengths in metres where the length of a model unit is known.
The node `footage_camera` is a camera with the field of view of the images: a picture of this camera shows the birds at
their places in the footage. Birds have the size of the model, because one camera measures neither size nor distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxfit.export.gltf import INDICES, VERTICES, GltfBuilder, Motion, add_bird, bird_motion, body_length, weight_error
from jaxfit.export.result import Exported, describe_tracks, export_folder
from jaxfit.foundation.extras import __version__
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask

_MARGIN = 0.5
"""Margin of the ground around the birds, as a share of their spread and of a body length."""
_FARTHEST = 5.0
"""Birds beyond this multiple of the median distance do not widen the ground: their fits are wrong."""
_BACKS = 0.1
"""Weight of the direction of the birds' backs, which decides where the lateral axes do not."""


class Ground(NamedTuple):
    """Rotation and translation from the camera frame of the image to a frame with the ground at y = 0, y up."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    low: Float[np.ndarray, "2"]
    """Smallest x and z of the ground."""
    high: Float[np.ndarray, "2"]


def level_ground(exported: Exported, motions: dict[int, Motion]) -> Ground:
    """Estimate the ground from the birds.

    The lateral axes of standing birds are level, so the upward direction n minimises Σ (n · x)² − w (n · z̄)² over the
    lateral axes x of all poses, with the mean direction z̄ of the birds' backs. The height is the median over the birds
    of the median height of their lower foot. Both are estimates: the depth of a bird is not measured.

    Args:
        exported: the result.
        motions: position of a track → its motion.
    """
    s, bird = exported.solution, exported.bird
    feet = [k for k, name in enumerate(s.keypoint_names) if "foot" in name] or list(range(len(s.keypoint_names)))
    lateral, backs, points = [], [], []
    for n, motion in motions.items():
        turn = Rotation.from_quat(motion.facing)
        body = turn * Rotation.from_rotvec(s.global_orient[n, motion.at].astype(np.float64))
        lateral.append(body.apply([1.0, 0, 0]))
        backs.append(body.apply([0, 0, 1.0]))
        relative = (s.keypoints_cam[n, motion.at] - s.transl[n, motion.at][:, None])[:, feet]
        relative = relative / s.scale[n, motion.at][:, None, None] * exported.length
        turned = np.einsum("mij,mkj->mki", turn.as_matrix(), relative.astype(np.float64))
        points.append(turned + motion.place[:, None])
    x, back = np.concatenate(lateral), np.concatenate(backs).mean(0)
    up = np.linalg.eigh(x.T @ x / len(x) - _BACKS * np.outer(back, back))[1][:, 0]
    up = up if up @ back > 0 else -up
    forward = np.array([0, 0, 1.0]) if abs(up[2]) < 0.99 else np.array([0, -1.0, 0])
    backward = -(forward - (forward @ up) * up)
    backward /= np.linalg.norm(backward)
    rotation = np.stack([np.cross(up, backward), up, backward])
    placed = [each @ rotation.T for each in points]
    height = float(np.median([np.median(each[..., 1].min(axis=1)) for each in placed]))
    flat = np.concatenate([each.reshape(-1, 3) for each in placed])[:, [0, 2]]
    distance = np.linalg.norm(np.concatenate([each.reshape(-1, 3) for each in points]), axis=1)
    flat = flat[distance <= _FARTHEST * np.median(distance)]
    low, high = flat.min(0), flat.max(0)
    margin = _MARGIN * (body_length(bird) * exported.length + float((high - low).max()))
    return Ground(rotation, np.array([0, -height, 0]), low - margin, high + margin)


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


_CAMERA_TO_GLTF = np.diag([1.0, -1.0, -1.0])
"""Rotation from the camera frame (y down, z forward) to that of glTF (y up, z backward)."""


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
        ground: turn the scene so that the ground is level, and add a rectangle below the feet.
        overwrite: replace an earlier export in the folder.

    Returns:
        The files, and notes on the precision.

    Raises:
        InputError: no pose is chosen, or the frame rate is unknown.
    """
    exported.require_poses()
    exported.require_fps()
    focal_px = exported.focal_px
    fitted = np.flatnonzero(exported.solution.valid.any(axis=1)).tolist()
    with progress("Writing glTF", len(fitted)) as report_progress:
        motions: dict[int, Motion] = {}
        for n in fitted:
            motions[n] = bird_motion(exported, n)
            report_progress(0.5, f"track {exported.solution.track_id[n]}")
        level = level_ground(exported, motions) if ground else None
        error = weight_error(exported)
        facts = {"largest_error_of_four_weights": error, "focal_length_px": focal_px}
        if out.suffix == ".glb":
            write_whole(out, _content(exported, motions, fitted, focal_px, level, facts))
            files = [out]
        else:
            tracks = {n: int(exported.solution.track_id[n]) for n in fitted}
            names = {track: f"bird_{track}.glb" for track in tracks.values()}
            with export_folder(exported, out, overwrite, names, facts) as folder:
                for n, track in tracks.items():
                    write_whole(folder / names[track], _content(exported, motions, [n], focal_px, level, facts))
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
    focal_px: float,
    ground: Ground | None,
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
    rotation = _CAMERA_TO_GLTF if ground is None else ground.rotation
    node = builder.root["nodes"][frame]
    node["rotation"] = _quaternion(rotation)
    if ground is not None:
        node["translation"] = ground.translation.tolist()
        add_ground(builder, ground)
    width, height = np.median(s.image_size_px[s.valid], axis=0).tolist()
    view = {"yfov": 2 * float(np.arctan(height / 2 / focal_px)), "aspectRatio": width / height, "znear": 0.01}
    camera = builder.add("cameras", {"type": "perspective", "perspective": view})
    looking = {"name": "footage_camera", "camera": camera, "rotation": _quaternion(_CAMERA_TO_GLTF)}
    node["children"] = [builder.add("nodes", looking)]
    animation = builder.add("animations", {"name": "motion", "channels": [], "samplers": []})
    for n in chosen:
        add_bird(builder, exported, n, motions[n], frame, animation)
    return builder.content()


def _quaternion(rotation: np.ndarray) -> list[float]:
    return [float(value) for value in Rotation.from_matrix(rotation).as_quat().astype(np.float32)]
