"""Temporal consistency pays: on smooth motion with known truth, `paper` beats `baseline` as the paper says."""

import dataclasses

import numpy as np
import pytest
from support.birds import pose_window

from jaxfit.config.fit import load_config
from jaxfit.evaluation.metrics import me_p, me_v, mpjpe, pa_mpjpe
from jaxfit.fitting.fit import fit
from jaxfit.model.camera import Camera, project
from jaxfit.model.importers.import_model import import_model
from jaxfit.simulation.detections import detect
from jaxfit.simulation.motion import smooth_motion

pytestmark = pytest.mark.extended

BIRDS, FRAMES = 2, 50
MASK_STEPS = 20
"""Of 400, in both configs alike: the keypoint stage, run in full, is where the temporal terms count most."""


@pytest.fixture(scope="module")
def figures(reference_dir):
    """Errors against the noise-free truth of both configs: {config: {metric: value}}."""
    bird = import_model("aves", [reference_dir / "models" / "aves"])
    poses = [smooth_motion(bird, FRAMES, seed) for seed in range(BIRDS)]
    observed = detect(bird, poses, noise_px=2.0, outliers=0.05, seed=0)
    posed = [pose_window(bird, pose) for pose in poses]
    true_3d = np.stack([keypoints for keypoints, _ in posed])
    true_px = np.asarray(project(true_3d, Camera()))
    sides = np.ptp(np.stack([project(vertices, Camera()) for _, vertices in posed]), axis=2).max(-1)
    visible = np.ones(true_px.shape[:3], bool)
    found = {}
    for name in ("paper", "baseline"):
        config = load_config(name)
        stages = (config.stages[0], dataclasses.replace(config.stages[1], steps=MASK_STEPS))
        window = min(config.window, FRAMES)
        crop = dataclasses.replace(config.crop, mode="image")
        solution = fit(observed, bird, dataclasses.replace(config, stages=stages, window=window, crop=crop))
        assert (solution.status == "ok").all()
        keypoints = solution.keypoints_px
        found[name] = {
            "me_p": me_p(keypoints, true_px, visible, sides),
            "me_v": me_v(keypoints, true_px, visible, sides),
            "3d": mpjpe(centred(solution.keypoints_cam), centred(true_3d)),
            "aligned 3d": pa_mpjpe(solution.keypoints_cam, true_3d),
        }
    return found


def centred(points):
    return points - points.mean(-2, keepdims=True)


def test_paper_beats_baseline(figures, record_property):
    record_property("figures", figures)
    print(figures)  # noqa: T201
    paper, baseline = figures["paper"], figures["baseline"]
    assert paper["me_p"] < baseline["me_p"]
    assert paper["me_v"] < 2 / 3 * baseline["me_v"]
    assert paper["aligned 3d"] < baseline["aligned 3d"]
    assert paper["3d"] < baseline["3d"]
