"""A result folder of three toy birds with gaps and a diverged track, for the tests of exports."""

import dataclasses
import json

import numpy as np

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.projection import projected_observations
from jaxfit.data.solution import Solution, save_solution
from jaxfit.simulation.flock import smooth_motion
from support.birds import solution_of, toy_bird

BIRD = dataclasses.replace(toy_bird(), metres_per_unit=0.02)
TRACKS, FRAMES = (3, 7, 8), (10, 12, 14, 18, 20)
"""Frame 16 is missing; every second frame of the footage was used."""
FPS = 25.0


def solution(**changes) -> Solution:
    """Track 3 has all frames, track 7 lacks two frames, track 8 diverged."""
    fitted = solution_of(BIRD, [smooth_motion(BIRD, len(FRAMES), seed) for seed in range(3)])
    valid = np.ones((3, len(FRAMES)), bool)
    valid[1, 1:3] = valid[2] = False
    arrays = {"scale": np.where(valid, fitted.poses.scale, np.nan), "body_pose": fitted.poses.body_pose.copy()}
    arrays["body_pose"][~valid] = np.nan
    parts = {"track_id": np.array(TRACKS), "frame_index": np.array(FRAMES), "valid": valid, **arrays}
    parts |= {"status": np.array(["ok", "partly diverged", "diverged"]), "fps": FPS}
    return fitted.with_arrays(**(parts | {"timestamp_s": np.array(FRAMES) / FPS} | changes))


def write_result(folder, with_detections=False, video=None, bird=BIRD, **changes):
    """Write the result folder and return its solution."""
    made = solution(**changes)
    summary = {"video": {"file": str(video)}} if video else {}
    save_solution(made, bird, "", json.loads(json.dumps(summary)), folder)
    if with_detections:
        detected = projected_observations(solution_of_all(made))
        confidence = np.linspace(0.1, 1, detected.confidence.size).reshape(detected.confidence.shape)
        write_coco(detected.with_keypoints(detected.keypoints_px, confidence), folder / "observations.json")
    return made


def solution_of_all(made: Solution) -> Solution:
    """The same result with a pose in every frame."""
    full = solution_of(BIRD, [smooth_motion(BIRD, len(FRAMES), seed) for seed in range(3)])
    parts = {"track_id": made.track_id, "frame_index": made.frame_index}
    return full.with_arrays(**parts)
