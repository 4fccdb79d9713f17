"""Results in a world: true poses of a simulated scene on its ledge, which need no fit."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxfit.cameras.files import write_cameras
from jaxfit.data.result_folder import CAMERAS
from jaxfit.data.solution import save_solution
from jaxfit.model.files import load_murre

BIRD, FRAMES = load_murre(), 2
UNIT = BIRD.metres_per_unit
"""Length of a model unit in metres."""


def placed_on(scene, camera):
    """Return the true poses of a scene in the world of a camera, in the frame of this camera; all birds stand."""
    s, R = scene.poses, camera.R_cam_world
    root = s.poses.transl + s.poses.scale[..., None] * np.asarray(BIRD.joints[0], np.float64)
    orient = Rotation.from_rotvec(s.poses.global_orient.reshape(-1, 3)).as_matrix().reshape(*s.valid.shape, 3, 3)
    return s.with_arrays(
        R_world_root=R.T @ orient,
        transl_world_m=(root * UNIT - camera.transl_cam) @ R,
        keypoints_world_m=(s.keypoints.cam.astype(np.float64) * UNIT - camera.transl_cam) @ R,
        contact=np.ones(s.valid.shape),
    )


def write_world(folder, solution, cameras, summary=None):
    """Write a result folder with its cameras, and return the folder."""
    save_solution(solution, BIRD, "", summary or {}, folder)
    write_cameras(cameras, folder / CAMERAS)
    return folder
