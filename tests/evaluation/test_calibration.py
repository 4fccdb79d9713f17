"""Calibration of error bars whose errors are drawn from known Gaussians; the command and its plot."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import error_bars, solution_of, toy_bird

from jaxfit.cli.main import main
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.projection import projected_observations
from jaxfit.data.solution import save_solution
from jaxfit.evaluation.calibration import calibration
from jaxfit.evaluation.truth import Truth
from jaxfit.foundation.errors import InputError
from jaxfit.simulation.flock import smooth_motion

BIRD = toy_bird()
N, T, K, J = 2, 60, BIRD.num_keypoints, BIRD.num_joints
SD_RAD = 0.05


def made(scale=1.0, seed=0):
    """Return a result and its truth: the errors of the result are draws from its error bars, times `scale`."""
    rng = np.random.default_rng(seed)
    true = solution_of(BIRD, [smooth_motion(BIRD, T, n) for n in range(N)])
    half = 0.05 * (np.diag([1.0, 1.0, 2.0]) + 0.3 * rng.normal(size=(N, T, 1, 3, 3)))
    half = np.broadcast_to(half, (N, T, K, 3, 3))
    covariance_cam = (1 - 1 / K) * half @ half.swapaxes(-1, -2)  # of the errors without their mean
    half_px = rng.normal(size=(N, T, K, 2, 2)) + np.eye(2)
    covariance_px = half_px @ half_px.swapaxes(-1, -2)
    error_cam = scale * (half @ rng.normal(size=(N, T, K, 3, 1)))[..., 0]
    error_px = scale * (half_px @ rng.normal(size=(N, T, K, 2, 1)))[..., 0]

    def turned(axis_angles):
        delta = Rotation.from_rotvec(scale * SD_RAD * rng.normal(size=(axis_angles.size // 3, 3)))
        return (Rotation.from_rotvec(axis_angles.reshape(-1, 3)) * delta).as_rotvec().reshape(axis_angles.shape)

    error_cam -= error_cam.mean(2, keepdims=True)
    covariances = {"keypoints_centred_cov": covariance_cam, "keypoints_px_cov": covariance_px}
    result = true.with_arrays(
        keypoints_cam=true.keypoints.cam + error_cam,
        keypoints_px=true.keypoints.px + error_px,
        global_orient=turned(true.poses.global_orient),
        body_pose=turned(true.poses.body_pose),
        **error_bars(true, **covariances, global_orient_sd=SD_RAD, body_pose_sd=SD_RAD, misfit=1.0),
    )
    return result, Truth(projected_observations(true), true, BIRD)


def test_errors_from_the_error_bars_are_calibrated():
    result = calibration(*made())
    assert list(result.groups) == ["keypoints, image", "keypoints, 3D", "angles"]
    assert (result.frames, result.without_error_bars) == (N * T, 0)
    counts = {"keypoints, image": N * T * K, "keypoints, 3D": N * T * K, "angles": 3 * N * T * J}
    for name, group in result.groups.items():
        assert group.overall.count == counts[name]
        for p, inside in (*group.overall.coverage.items(), *group.reliability.items()):
            assert inside == pytest.approx(float(p), abs=0.05), (name, p)
        if name != "angles":  # their error bars are constant
            assert group.overall.nll < group.overall.nll_constant
    angles = result.groups["angles"]
    assert set(angles.parts) == set(BIRD.joint_names)
    assert angles.overall.sd == pytest.approx(SD_RAD)
    assert angles.overall.error == pytest.approx(SD_RAD, rel=0.03)


def test_errors_twice_as_large_are_not_calibrated():
    for group in calibration(*made(scale=2.0)).groups.values():
        assert group.overall.coverage["0.68"] < 0.45
        assert group.overall.error > 1.5 * group.overall.sd


def test_poses_without_error_bars_do_not_count():
    result, truth = made()
    misfit = np.ones((N, T), np.float32)
    misfit[0, :10] = np.nan
    found = calibration(result.with_arrays(misfit=misfit), truth)
    assert (found.frames, found.without_error_bars) == (N * T - 10, 10)
    assert found.groups["angles"].overall.count == 3 * (N * T - 10) * J
    with pytest.raises(InputError, match="shares no bird"):
        calibration(result.with_arrays(misfit=np.full((N, T), np.nan)), truth)


def test_command(tmp_path, capsys):
    result, truth = made()
    save_solution(result, BIRD, "", {}, tmp_path / "result")
    write_coco(truth.observations, tmp_path / "truth.json")
    command = ["evaluate", str(tmp_path / "result"), "--truth", str(tmp_path / "truth.json")]
    assert main([*command, "--calibration"]) == 0
    shown = capsys.readouterr().out
    assert "68 %" in shown
    assert "bill_tip" in shown
    assert main([*command, "--calibration", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["groups"]["keypoints, image"]["overall"]["count"] == N * T * K
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    assert main([*command, "--calibration", "--plot", str(tmp_path / "plot.png")]) == 0
    assert (tmp_path / "plot.png").read_bytes()[:4] == b"\x89PNG"
    capsys.readouterr()
    assert main([*command, "--plot", str(tmp_path / "plot.png")]) != 0
    assert "without --calibration" in capsys.readouterr().err.replace("\n", " ")
    save_solution(dataclasses.replace(result, error_bars=None), BIRD, "", {}, tmp_path / "plain")
    command[1] = str(tmp_path / "plain")
    assert main([*command, "--calibration"]) != 0
    assert "no error bars" in capsys.readouterr().err.replace("\n", " ")
