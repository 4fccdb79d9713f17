"""`simulate_rig`: one scene as seen by several cameras, with the same truth for all."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.files import write_cameras
from jaxfit.data.formats import MARKER
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import new_folder, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.bird import Bird
from jaxfit.model.rotation import unwrap_axis_angle
from jaxfit.simulation.flock import SimulatedBird, simulate_flock
from jaxfit.simulation.individuals import BONE_SD, OFFSET
from jaxfit.simulation.scene import LEDGE_DEPTH, VERSION, Scene, check_scene, film_scene, scene_offsets, stage_view
from jaxfit.simulation.viewpoint import Viewpoint, ring_viewpoints, viewpoint_of

CAMERAS = "cameras.toml"
"""File of the cameras in the folder of a scene with several cameras."""
MAX_CAMERAS = 32


class RigScene(NamedTuple):
    """A simulated scene, as seen by V cameras."""

    cameras: tuple[Camera, ...]
    """World frame: x along the ledge to the right, y from its edge to the wall, z up; the ledge is z = 0. Metres."""
    scenes: tuple[Scene, ...]
    """What each camera sees. Track ids of the truth agree between cameras; track ids of detections do not."""


def stage_rig(
    bird: Bird,
    cameras: int | Sequence[Camera] = 4,
    birds: int = 5,
    frames: int = 100,
    size: tuple[int, int] = (2592, 1520),
    fps: float = 25.0,
    seed: int = 0,
    distorted: bool = False,
    bone_sd: float = BONE_SD,
    keypoint_offset: float = OFFSET,
    progress: ProgressTask = silent,
) -> RigScene:
    """Simulate birds on a ledge that several cameras see, with exact observations and detections for each camera.

    Args:
        bird: the model, as for `simulation.scene.stage_scene`.
        cameras: number of cameras on an arc in front of the ledge, or calibrated cameras in metres, in the world frame
            of `RigScene.cameras`.
        birds, frames, fps, seed, bone_sd, keypoint_offset: as for `stage_scene`. The offsets of the
            detector's keypoints are the same for all cameras.
        size: width and height of the pictures, pixels. Calibrated cameras have sizes of their own.
        distorted: whether the lenses of an arc have distortion.
        progress: reports every frame of every camera.

    Raises:
        InputError: a number outside its range, a model without a unit, or a camera that the simulator cannot describe.
    """
    check_scene(birds, frames, size, fps, seed, bone_sd, keypoint_offset)
    unit_m = bird.metres_per_unit
    if unit_m is None:
        raise InputError(f"model {bird.name}", "has no `metres_per_unit`", "use the built-in murre")
    if isinstance(cameras, int):
        if not 1 <= cameras <= MAX_CAMERAS:
            raise InputError("simulate: cameras", f"is {cameras}", f"give 1 to {MAX_CAMERAS} cameras, or a file")
        rng = np.random.default_rng((seed, 5))
        views = ring_viewpoints(rng, cameras, *size, LEDGE_DEPTH, distorted)
        cameras = tuple(view.camera(f"cam{i}", unit_m) for i, view in enumerate(views))
    else:
        views = [viewpoint_of(camera, unit_m) for camera in cameras]
        for view in views:
            check_scene(birds, frames, (view.width, view.height), fps, seed, bone_sd, keypoint_offset)
    flock = simulate_flock(bird, birds, frames, fps, LEDGE_DEPTH, views[0], seed, bone_sd=bone_sd)
    offsets = scene_offsets(bird, seed, keypoint_offset)
    scenes = []
    for i, (camera, view) in enumerate(zip(cameras, views, strict=True)):
        own = [_seen_from(simulated, views[0], view) for simulated in flock] if i else flock
        own_seed = int(np.random.SeedSequence((seed, i)).generate_state(1)[0])
        scene = stage_view(bird, own, view, fps, own_seed, offsets, progress, f"Staging {camera.name}")
        scenes.append(scene._replace(detections=_with_own_ids(scene, own_seed)))
    return RigScene(tuple(cameras), tuple(scenes))


def simulate_rig(
    bird: Bird,
    folder: str | Path,
    cameras: int | Sequence[Camera] = 4,
    birds: int = 5,
    frames: int = 100,
    size: tuple[int, int] = (2592, 1520),
    fps: float = 25.0,
    seed: int = 0,
    distorted: bool = False,
    bone_sd: float = BONE_SD,
    keypoint_offset: float = OFFSET,
    codec: str = "auto",
    overwrite: bool = False,
    progress: ProgressTask = silent,
) -> RigScene:
    """Simulate a scene of several cameras and write all files; the same arguments give the same bytes.

    The folder contains `cameras.toml`, `scene.json`, and for each camera a folder of its name with the files of
    `simulation.scene.simulate`.

    Args:
        bird, cameras, birds, frames, size, fps, seed, distorted, bone_sd, keypoint_offset, progress: as for
            `stage_rig`.
        folder: folder to create; after an error it does not exist.
        codec: codec of the footage, as for `VideoWriter`.
        overwrite: replace an existing scene.

    Raises:
        InputError: as for `stage_rig`, or the folder cannot be written.
    """
    with new_folder(folder, overwrite, marker=MARKER) as part:
        bodies = {"bone_sd": bone_sd, "keypoint_offset": keypoint_offset}
        rig = stage_rig(bird, cameras, birds, frames, size, fps, seed, distorted, **bodies, progress=progress)
        write_cameras(rig.cameras, part / CAMERAS)
        for camera, scene in zip(rig.cameras, rig.scenes, strict=True):
            own = part / camera.name
            own.mkdir()
            own_size = [scene.view.width, scene.view.height]
            arguments = {"birds": birds, "frames": frames, "size": own_size, "fps": fps, "seed": seed, **bodies}
            film_scene(bird, scene, own, arguments, codec, progress, f"Filming {camera.name}")
        facts = {"made_by": f"jaxfit {VERSION}, simulated", "cameras": [camera.name for camera in rig.cameras]}
        write_whole(part / MARKER, json.dumps(facts, indent=2).encode())
    return rig


def _seen_from(simulated: SimulatedBird, old: Viewpoint, new: Viewpoint) -> SimulatedBird:
    """Return the bird with its pose in the frame of another camera."""
    R = new.R_cam_world @ old.R_cam_world.T
    orient = (Rotation.from_matrix(R) * Rotation.from_rotvec(simulated.pose.global_orient)).as_rotvec()
    position_world = np.asarray(simulated.pose.transl, np.float64) @ old.R_cam_world + old.position_world
    pose = replace(
        simulated.pose,
        global_orient=unwrap_axis_angle(jnp.asarray(orient, jnp.float32)),
        transl=jnp.asarray(new.to_camera(position_world), jnp.float32),
    )
    return replace(simulated, pose=pose)


def _with_own_ids(scene: Scene, seed: int):
    """Return the detections with shuffled track ids, because trackers of different cameras do not agree on ids."""
    rng = np.random.default_rng((seed, 6))
    ids = rng.permutation(scene.detections.track_id)
    detections = replace(scene.detections, track_id=ids)
    return detections.select(tracks=np.argsort(ids))
