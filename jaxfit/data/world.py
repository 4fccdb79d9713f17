"""A solution in a world, as its cameras see it.

A solution in a world (`data.solution.World`) holds its birds in the frame of its first camera, whose crop is the whole
picture. A fit with one camera and no ledge holds its birds in crops.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxfit.cameras.camera import Camera
from jaxfit.data.result_folder import CAMERAS
from jaxfit.data.solution import Crops, Keypoints, Solution, World
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CROP_PX

_AGREES_PX = 1.0
"""Largest error of a pixel whose distortion is removed again; a larger error: the lens model does not hold there."""


def whole_picture(lens: Camera, valid: Bool[np.ndarray, "N T"], size_px: tuple[int, int]) -> Crops:
    """Return the crops of a solution where the crop of every bird is the whole picture of a camera.

    Args:
        lens: the camera, with its distortion or without.
        valid: `Solution.valid`.
        size_px: width and height of the picture, where the camera does not state them.
    """
    width, height = lens.size_px or size_px
    side = max(width, height)
    crop = np.array([*(lens.matrix[:2, 2] - side / 2), side], np.float32)
    return Crops(
        square_px=np.broadcast_to(crop, (*valid.shape, 3)),
        image_size_px=np.where(valid[..., None], np.array([width, height]), 0),
        focal_px=float(lens.matrix[0, 0]) * CROP_PX / side,
        crop_px=CROP_PX,
    )


def largest_image_px(solution: Solution) -> tuple[int, int]:
    """Return the width and the height of the largest picture with a pose."""
    width, height = solution.crops.image_size_px[solution.valid].max(axis=0, initial=1).tolist()
    return width, height


def in_world(
    camera: Camera,
    unit_m: float,
    orientation: Float[np.ndarray, "N T 3"],
    root: Float[np.ndarray, "N T 3"],
    keypoints: Float[np.ndarray, "N T K 3"],
) -> World:
    """Return the places in the world of poses in the frame of a camera; NaN without a pose.

    Args:
        camera: the camera in the world.
        unit_m: length of a model unit, metres.
        orientation: axis-angle from the model to the camera, radians.
        root, keypoints: positions in the camera frame, model units.
    """
    orient = scipy.spatial.transform.Rotation.from_rotvec(np.nan_to_num(orientation).reshape(-1, 3)).as_matrix()
    R = camera.R_cam_world.T @ orient.reshape(*orientation.shape, 3)
    return World(
        R_world_root=np.where(np.isnan(orientation)[..., None], np.nan, R).astype(np.float32),
        transl_world_m=camera.to_world(root * unit_m),
        keypoints_world_m=camera.to_world(keypoints * unit_m),
    )


def in_frame_of_camera(solution: Solution) -> bool:
    """Whether the birds are in the frame of a camera with a known focal length, not in crops."""
    side, crops = solution.crops.image_size_px.max(axis=-1), solution.crops.square_px[solution.valid]
    whole = bool((solution.crops.square_px[..., 2] >= side)[solution.valid].all())
    return solution.world is not None and whole and bool((crops == crops[:1]).all())


def _sees(camera: Camera, points_m: Float[np.ndarray, "N T K 3"]) -> Bool[np.ndarray, "N T"]:
    """Return whether all points are before a camera, where its lens model holds."""
    pixels, straight = camera.project(points_m), camera.pinhole().project(points_m)
    with np.errstate(invalid="ignore"):
        known = np.abs(camera.undistort(pixels) - straight).max(axis=-1) < _AGREES_PX
    return (known & (camera.to_camera(points_m)[..., 2] > 0)).all(axis=-1)


def in_camera(solution: Solution, bird: Bird, camera: Camera) -> Solution:
    """Return a solution in a world as another camera sees it.

    Args:
        solution: poses in a world.
        bird: the model of the solution.
        camera: a camera of this world, as it films.

    Returns:
        Poses in the frame of the camera, whose crop is the whole picture, with the distortion of the lens in
        `keypoints_px`. A bird has no pose where it is behind the camera, or so far to the side that the lens model does
        not hold. The solution has no error bars and no footage.
    """
    s, unit_m = solution, bird.metres_per_unit or 1.0
    assert s.world is not None
    places_m, points_m = s.world.transl_world_m, s.world.keypoints_world_m
    root, points = camera.to_camera(places_m) / unit_m, camera.to_camera(points_m) / unit_m
    joint = np.asarray(bird.joints[0], np.float64)
    # birds in crops have another size than in the world: the keypoints of both have the ratio
    extent = np.linalg.norm(points - root[:, :, None], axis=(-2, -1))
    before = s.keypoints.cam - (s.poses.transl + s.poses.scale[..., None] * joint)[:, :, None]
    with np.errstate(all="ignore"):
        scale = s.poses.scale * extent / np.linalg.norm(before, axis=(-2, -1))
    pixels, valid = camera.project(points_m), s.valid & _sees(camera, points_m)
    turns = camera.R_cam_world @ np.where(valid[..., None, None], s.world.R_world_root, np.eye(3))
    orient = scipy.spatial.transform.Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(*valid.shape, 3)
    return replace(
        s,
        valid=valid,
        poses=replace(
            s.poses,
            global_orient=orient.astype(np.float32),
            transl=(root - scale[..., None] * joint).astype(np.float32),
            scale=scale.astype(np.float32),
        ),
        keypoints=Keypoints(cam=points.astype(np.float32), px=np.nan_to_num(pixels).astype(np.float32)),
        crops=whole_picture(camera, valid, largest_image_px(s)),
        error_bars=None,
        footage=None,
    )


def as_filmed(folder: Path, solution: Solution, bird: Bird, name: str | None = None) -> tuple[Solution, Camera | None]:
    """Return the solution of a result folder in the frame of one of its cameras, and this camera.

    Args:
        folder: the result, whose cameras are in `CAMERAS`.
        solution, bird: the content of the result.
        name: the camera; None is the first camera.

    Returns:
        The solution as it is for the first camera, else by `in_camera`; and the camera, None for a solution without a
        world or without cameras.

    Raises:
        InputError: a name is given and the result is in no world, has no such camera, or the camera sees no bird.
    """
    from jaxfit.cameras.files import read_cameras

    path = folder / CAMERAS
    if name is not None and solution.world is None:
        problem = f"is {name}, but the result is in no world that several cameras could see"
        raise InputError("--camera", problem, "remove --camera, or fit with --cameras or --ledge")
    if name is None and (solution.world is None or not path.is_file()):
        return solution, None
    cameras = read_cameras(path)
    by_name = {camera.name: camera for camera in cameras}
    camera = cameras[0] if name is None else by_name.get(name)
    if camera is None:
        raise InputError("--camera", f"is {name}, which {path} does not hold", f"choose one of: {', '.join(by_name)}")
    first = camera is cameras[0]
    side = max(camera.size_px or largest_image_px(solution))
    own = np.isclose(solution.crops.focal_px, camera.matrix[0, 0] * CROP_PX / side, rtol=1e-4)  # else poses in crops
    if first and own and solution.world is not None and in_frame_of_camera(solution):
        valid = solution.valid & _sees(camera, solution.world.keypoints_world_m)
        return (solution if (valid == solution.valid).all() else replace(solution, valid=valid)), camera
    seen = in_camera(solution, bird, camera)
    if solution.valid.any() and not seen.valid.any():
        raise InputError("--camera", f"is {camera.name}, which sees no bird of the result", "choose another camera")
    return replace(seen, footage=solution.footage if first else None), camera
