"""Collect the fitted windows into the solution of the whole video."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfit.data.ambiguity import ambiguous_frames
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.fitting.batch import Fitted
from jaxfit.fitting.windows import Windows
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera, crop_to_image
from jaxfit.model.pose import Pose

__all__ = ["FittedWindow", "collect_windows", "track_status", "window_of_batch"]

_logger = logging.getLogger(__name__)


class FittedWindow(NamedTuple):
    """The result of one window of T frames, as NumPy arrays."""

    pose: Pose
    loss: dict[str, float]
    """Weighted value of each term in the objective."""
    keypoints_cam: np.ndarray
    """(T, K, 3) camera frame of the crop, model units."""
    keypoints_px: np.ndarray
    """(T, K, 2) crop pixels."""
    failure: str
    """Reason why the fit diverged; empty if the fit did not diverge."""
    ambiguity_deg: np.ndarray
    """(T,) as `Solution.ambiguity_deg`."""


def window_of_batch(fitted: Fitted, i: int) -> FittedWindow:
    """Return the result of problem `i` of a batch."""
    # copies, so that a window does not keep the arrays of its batch
    pose, report = jax.tree.map(lambda x: x[i].copy(), (fitted.pose, fitted.report))
    loss = {name: float(value) for name, value in report.loss.items()}
    failure = str(fitted.failure[i])
    if not failure and not (pose.scale > 0).all():  # a solver may step across 0
        failure = "the size of the bird is not above 0"
    ambiguity_deg = fitted.ambiguity_deg[i].copy()
    return FittedWindow(pose, loss, report.keypoints_cam, report.keypoints_px, failure, ambiguity_deg)


def collect_windows(
    observations: Observations,
    windows: Windows,
    results: list[FittedWindow],
    bird: Bird,
    camera: Camera,
    common_size: bool,
    skipped: Mapping[int, tuple[str, ...]],
) -> Solution:
    """Return the solution of one run.

    One camera cannot distinguish a small near bird from a large distant bird: a factor on size and position does not
    change the projection, and the factors of fitted windows are arbitrary. Where the frames of a window share one size,
    every bird therefore gets the size of the model, so that it has one size in the whole video.

    A window diverges or does not diverge by itself. Only windows that did not diverge have valid poses and contribute
    to the loss. The status of a track summarises its windows: `ok` (no window diverged), `partly diverged`, `diverged`
    (all windows diverged) or `no usable frame` (the track has no window).

    Args:
        observations: the observations that the windows were cut from.
        windows: W windows.
        results: the result of each window. The list is emptied, so that results and solution never lie in memory
            together.
        bird: the model.
        camera: the crop camera.
        common_size: as in the config.
        skipped: track → text about its skipped frames, for `Solution.failures`.
    """
    birds, frames = observations.num_tracks, observations.num_frames
    arrays = _empty_frame_values(birds, frames, bird)
    valid = np.zeros((birds, frames), bool)
    image_size_px = np.zeros((birds, frames, 2), np.int64)
    fitted, diverged = np.zeros(birds, int), np.zeros(birds, int)
    loss = {name: np.full(birds, np.nan) for name in results[0].loss}
    failures = dict(skipped)
    results.reverse()
    for w in range(len(results)):
        result = results.pop()
        n, present = int(windows.track[w]), windows.present[w]
        at = windows.frame[w][present]
        if result.failure:
            diverged[n] += 1
            first, last = observations.frame_index[at[[0, -1]]]
            track, text = int(windows.track_id[w]), f"frames {first} to {last}: {result.failure}"
            _logger.warning("track %d, %s", track, text)
            failures[track] = (*failures.get(track, ()), text)
            continue
        for name, value in result.loss.items():
            loss[name][n] = value + (loss[name][n] if fitted[n] else 0.0)
        fitted[n] += 1
        valid[n, at] = True
        image_size_px[n, at] = [observations.image_size(n, int(t)) for t in at]
        for name, value in _frame_values(result, windows.crop[w], present, bird, camera, common_size).items():
            arrays[name][n, at] = value
    for array in (valid, image_size_px, *arrays.values()):
        array.flags.writeable = False  # so that `Solution` needs no copy
    counts = zip(fitted.tolist(), diverged.tolist(), strict=True)
    solution = Solution(
        track_id=observations.track_id,
        frame_index=observations.frame_index,
        valid=valid,
        **arrays,
        image_size_px=image_size_px,
        focal_px=camera.focal_px,
        crop_px=camera.size_px,
        keypoint_names=bird.keypoint_names,
        joint_names=bird.joint_names,
        loss=loss,
        status=np.array([track_status(*count) for count in counts], "<U32"),
        failures=failures,
        timestamp_s=observations.timestamp_s,
        fps=observations.fps,
        footage=observations.footage,
    )
    for track, texts in ambiguous_frames(solution).items():
        for text in texts:
            _logger.warning("track %d, %s", track, text)
    return solution


def _empty_frame_values(birds: int, frames: int, bird: Bird) -> dict[str, Any]:
    """Return the arrays that `_frame_values` fills, for all birds and frames; NaN."""
    bones, keypoints = bird.num_joints - 1, bird.num_keypoints
    shapes = {
        "global_orient": (3,),
        "body_pose": (bones, 3),
        "transl": (3,),
        "scale": (),
        "bone_length": (bones,),
        "betas": (bird.num_shapes,),
        "keypoints_cam": (keypoints, 3),
        "keypoints_px": (keypoints, 2),
        "crop": (3,),
        "ambiguity_deg": (),
    }
    return {name: np.full((birds, frames, *shape), np.nan, np.float32) for name, shape in shapes.items()}


def _frame_values(
    result: FittedWindow, crop: np.ndarray, present: np.ndarray, bird: Bird, camera: Camera, common_size: bool
) -> dict[str, Any]:
    """Return the arrays of a solution at the present frames of one window."""
    pose, crop = result.pose, crop[present].astype(np.float32)
    betas = np.zeros(bird.num_shapes, np.float32)  # for a fit without shape coefficients
    betas[: len(pose.betas)] = pose.betas
    scale = np.broadcast_to(pose.scale, present.shape)[present]
    factor = scale if common_size else np.ones_like(scale)
    return {
        "global_orient": pose.global_orient[present],
        "body_pose": pose.body_pose[present],
        "transl": pose.transl[present] / factor[:, None],
        "scale": scale / factor,
        "bone_length": pose.bone_length,
        "betas": betas,
        "keypoints_cam": result.keypoints_cam[present] / factor[:, None, None],
        "keypoints_px": crop_to_image(result.keypoints_px[present], crop, camera.size_px),
        "crop": crop,
        "ambiguity_deg": result.ambiguity_deg[present],
    }


def track_status(fitted: int, diverged: int) -> str:
    """Return the status of a track from its numbers of fitted and diverged windows."""
    if fitted and diverged:
        return "partly diverged"
    return "ok" if fitted else "diverged" if diverged else "no usable frame"
