"""Animated birds as binary glTF (`.glb`), for Blender, three.js and viewers.

A bird is a mesh with a skeleton. The scene has y up, and lengths in metres where the length of a model unit is known.
The node `footage_camera` is a camera with the field of view of the images: a picture of this camera shows the birds at
their places in the footage. Birds have the size of the model, because one camera measures neither size nor distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit import __version__
from jaxfit.export.folder import describe_tracks, export_folder
from jaxfit.export.gltf_bird import add_bird, weight_error
from jaxfit.export.gltf_file import GltfBuilder
from jaxfit.export.gltf_ground import Ground, add_ground, level_ground
from jaxfit.export.gltf_motion import Motion, bird_motion
from jaxfit.export.result import Exported
from jaxfit.progress import ProgressTask
from jaxfit.storage.files import write_whole

__all__ = ["write_glb"]

_CAMERA_TO_GLTF = np.diag([1.0, -1.0, -1.0])
"""Rotation from the camera frame (y down, z forward) to that of glTF (y up, z backward)."""


def write_glb(
    exported: Exported,
    out: Path,
    progress: ProgressTask,
    one_file: bool = False,
    ground: bool = False,
    overwrite: bool = False,
) -> tuple[list[Path], list[str]]:
    """Write one `.glb` for every bird with a pose, or one for all birds.

    Args:
        exported: the result.
        out: a folder, or the file with `one_file`.
        progress: shows progress.
        one_file: write all birds into one file.
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
        if one_file:
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
