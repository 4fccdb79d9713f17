"""Temporal consistency: on smooth motion with known truth, `paper` has smaller errors than `baseline`."""

import dataclasses

import numpy as np
import pytest
from support.birds import pose_window

from jaxfit.config.fit import load_config
from jaxfit.evaluation.metrics import distances, procrustes_align, squared_errors, squared_velocity_errors
from jaxfit.fitting.fit import fit
from jaxfit.model.camera import CropCamera, project
from jaxfit.model.published import import_model
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

pytestmark = pytest.mark.extended

BIRDS, FRAMES = 2, 50
MASK_STEPS = 20
"""Steps of the mask stage in both configs (in the shipped configs 400). The keypoint stage has all its steps."""


@pytest.fixture(scope="module")
def metrics(reference_dir):
    """Errors of both configs against the noise-free truth: {config: {metric: value}}."""
    bird = import_model("aves", [reference_dir / "models" / "aves"])
    poses = [smooth_motion(bird, FRAMES, seed) for seed in range(BIRDS)]
    observed = detect(bird, poses, noise_px=2.0, outliers=0.05, seed=0)
    posed = [pose_window(bird, pose) for pose in poses]
    true_3d = np.stack([keypoints for keypoints, _ in posed])
    true_px = np.asarray(project(true_3d, CropCamera()))
    sides = np.ptp(np.stack([project(vertices, CropCamera()) for _, vertices in posed]), axis=2).max(-1)
    visible = np.ones(true_px.shape[:3], bool)
    measured = {}
    for name in ("paper", "baseline"):
        config = load_config(name)
        stages = (config.stages[0], dataclasses.replace(config.stages[1], steps=MASK_STEPS))
        window = min(config.window, FRAMES)
        crop = dataclasses.replace(config.crop, mode="image")
        solution = fit(observed, bird, dataclasses.replace(config, stages=stages, window=window, crop=crop))
        assert (solution.status == "ok").all()
        keypoints = solution.keypoints.px
        values = {
            "me_p": np.sqrt(np.nanmean(squared_errors(keypoints, true_px, visible, sides))),
            "me_v": np.sqrt(np.nanmean(squared_velocity_errors(keypoints, true_px, visible, sides))),
            "3d": distances(centred(solution.keypoints.cam), centred(true_3d)).mean(),
            "aligned 3d": distances(procrustes_align(solution.keypoints.cam, true_3d), true_3d).mean(),
        }
        measured[name] = {metric: float(value) for metric, value in values.items()}
    return measured


def centred(points):
    return points - points.mean(-2, keepdims=True)


def test_paper_has_smaller_errors_than_baseline(metrics, record_property):
    record_property("metrics", metrics)
    print(metrics)  # noqa: T201
    paper, baseline = metrics["paper"], metrics["baseline"]
    assert paper["me_p"] < baseline["me_p"]
    assert paper["me_v"] < 2 / 3 * baseline["me_v"]
    assert paper["aligned 3d"] < baseline["aligned 3d"]
    assert paper["3d"] < baseline["3d"]
