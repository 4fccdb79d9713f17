"""Toy birds over several windows with their result folder, for the tests of corrections."""

import dataclasses

import numpy as np

import jaxfit
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.masks import box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.simulation.flock import smooth_motion
from support.fits import BIRD, config, keypoints_of

WINDOW, FRAMES, TRACKS = 6, 17, (2, 4, 5)
CONFIG = dataclasses.replace(
    config(window=WINDOW, steps=(5, 1)), stages=config(steps=(5, 1)).stages[:1], filter_window=3
)
"""Three windows of a track: frames 0 to 5, 6 to 11, 12 to 16."""


def observations() -> Observations:
    """Three birds that stand still side by side; track 5 lacks frames 12 to 16."""
    points = keypoints_of([smooth_motion(BIRD, FRAMES, seed) for seed in range(3)])
    present = np.ones((3, FRAMES), bool)
    present[2, 12:] = False
    return Observations(
        track_id=np.array(TRACKS),
        frame_index=np.arange(100, 100 + FRAMES),
        present=present,
        keypoints_px=points,
        confidence=np.broadcast_to(present[..., None], points.shape[:3]).astype(np.float32),
        box_px=np.where(present[..., None], box_of_keypoints(points, np.ones(points.shape[:3], bool)), 0),
        image_size_px=np.full((FRAMES, 2), 64),
        file_name=np.array([f"{t}.png" for t in range(FRAMES)]),
        keypoint_names=BIRD.keypoint_names,
        fps=25.0,
    )


def write(folder, settings=CONFIG):
    """Write the result folder of a fit of the observations."""
    observed = observations()
    solution = jaxfit.fit(observed, BIRD, settings)
    jaxfit.save_solution(solution, BIRD, config_to_yaml(settings), {"video": {"file": "clip.mp4"}}, folder)
    jaxfit.write_coco(observed, folder / "observations.json")
