"""Birds that are not seen from above: eight frames of a track decide about the search for its initial poses."""

import dataclasses
import logging

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.birds import tiny_bird

from jaxfit.config.fit import load_config
from jaxfit.fitting.fit import fit, fit_runs, model_of_fit, windows_of
from jaxfit.fitting.side_views import seen_from_the_side
from jaxfit.fitting.tasks import initial_poses_of
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import CropCamera
from jaxfit.model.rotation import unwrap_axis_angle
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

BIRD, T = tiny_bird(shapes=0), 12
CAMERA = CropCamera(2167.0, 256, 512)


def config(method="auto", **changes):
    fast = load_config("fast")
    stage = dataclasses.replace(fast.stages[0], steps=8)
    terms = {"keypoints": 1.0, "pose_prior": 100.0, "velocity": 1.0, "acceleration": 1.0}
    start = dataclasses.replace(fast.initialise, method=method, turns=15, directions=60)
    plain = dataclasses.replace(fast, window=6, filter_window=1, stages=(stage,), terms=terms, initialise=start)
    return dataclasses.replace(plain, **changes)


def motion(seed, tilt_deg):
    """Return the motion of a bird that is seen from above, or turned by an angle about the x axis of the camera."""
    pose = smooth_motion(BIRD, T, seed)
    turned = Rotation.from_rotvec([np.deg2rad(tilt_deg), 0, 0]) * Rotation.from_rotvec(pose.global_orient)
    return dataclasses.replace(pose, global_orient=unwrap_axis_angle(jnp.float32(turned.as_rotvec())))


def observe(*tilts_deg, frames=T, seed=0):
    poses = [motion(seed + n, tilt) for n, tilt in enumerate(tilts_deg)]
    seen = detect(BIRD, poses, 0.5, 0.0, seed, masks=False, camera=CAMERA)
    return seen.select(frames=np.arange(frames)), poses


def decided(observations, how=None):
    """Return whether all orientations are searched for each track."""
    how = how or config()
    windows = windows_of(observations, how, "test")
    side = seen_from_the_side(windows, how, model_of_fit(BIRD, how))
    return [bool(side[windows.track == n].all()) for n in range(observations.num_tracks)]


def errors_deg(solution, poses):
    """Return the median error of the orientation of each track."""
    true = [np.asarray(pose.global_orient) for pose in poses]
    pairs = zip(solution.poses.global_orient, true, strict=True)
    return [
        np.rad2deg(np.median((Rotation.from_rotvec(a).inv() * Rotation.from_rotvec(b)).magnitude())) for a, b in pairs
    ]


def test_a_film_from_above_has_the_same_result_and_says_so(caplog):
    observed, _ = observe(0, 0, 0)
    with caplog.at_level(logging.INFO):
        auto, above = (fit(observed, BIRD, config(method)) for method in ("auto", "viewing_axis"))
    assert "3 of 3 tracks: seen from above" in caplog.text
    for name, values in above.arrays().items():
        np.testing.assert_array_equal(auto.arrays()[name], values, err_msg=name)


def test_all_orientations_are_searched_for_birds_from_the_side_only(caplog):
    observed, poses = observe(0, 180, 0, 150)
    with caplog.at_level(logging.INFO):
        auto = fit(observed, BIRD, config())
    assert "2 of 4 tracks: seen from the side: all orientations are searched" in caplog.text
    above, around = (fit(observed, BIRD, config(method)) for method in ("viewing_axis", "so3"))
    for n, other in enumerate((above, around, above, around)):
        np.testing.assert_array_equal(auto.poses.global_orient[n], other.poses.global_orient[n])
    assert max(errors_deg(auto, poses)) < 15
    assert max(errors_deg(above, poses)) > 60


def test_the_best_pose_from_above_stays_a_hypothesis():
    observed, _ = observe(180, 0)
    how = dataclasses.replace(config(), initialise=dataclasses.replace(config().initialise, hypotheses=2))
    windows, model = windows_of(observed, how, "test"), model_of_fit(BIRD, how)
    side = windows.track == 0
    found = initial_poses_of(dataclasses.replace(windows, all_orientations=side), how, model).global_orient

    def alone(method, hypotheses):
        start = dataclasses.replace(how.initialise, method=method, hypotheses=hypotheses)
        return initial_poses_of(windows, dataclasses.replace(how, initialise=start), model).global_orient

    np.testing.assert_array_equal(found[~side], alone("viewing_axis", 2)[~side])
    np.testing.assert_array_equal(found[side][:, :1], alone("so3", 1)[side])
    np.testing.assert_array_equal(found[side][:, 1:], alone("viewing_axis", 2)[side][:, :1])


@pytest.mark.parametrize("frames", [1, 3])
def test_short_tracks(frames):
    observed, _ = observe(0, 180, frames=frames)
    assert decided(observed) == [False, True]


def test_wrong_keypoints_of_one_frame_do_not_decide():
    """The keypoints of another bird, seen from below, stand in one of eight frames."""
    observed, _ = observe(0, 180)
    points = observed.keypoints_px.copy()
    points[0, 0] = points[1, 0] - points[1, 0].mean(0) + points[0, 0].mean(0)
    wrong = observed.with_keypoints(points, observed.confidence)
    assert decided(wrong) == [False, True]
    alone = wrong.select(tracks=[0], frames=[0])
    assert decided(alone) == [True]


def test_the_decision_does_not_depend_on_scales():
    """An objective in other units, as squared pixels, and larger noise than the config assumes."""
    observed, _ = observe(0, 180)
    times = {name: 1000 * weight for name, weight in config().terms.items()}
    assert decided(observed, config(terms=times)) == [False, True]


def test_tracks_without_confident_keypoints():
    observed, _ = observe(0, 180)
    confidence = observed.confidence.copy()
    confidence[1] = 0
    some = observed.with_keypoints(observed.keypoints_px, confidence)
    solution = fit(some, BIRD, config())
    assert solution.status.tolist() == ["ok", "no usable frame"]
    with pytest.raises(InputError, match="no track has a frame with 4 confident keypoints"):
        fit(some.with_keypoints(observed.keypoints_px, 0 * confidence), BIRD, config())


def test_runs_of_a_sweep_decide_for_themselves():
    observed, _ = observe(0, 180)
    other = {name: 3 * weight for name, weight in config().terms.items()}
    sweep = [config(), config("viewing_axis"), config(terms=other)]
    for solution, how in zip(fit_runs(observed, BIRD, sweep), sweep, strict=True):
        np.testing.assert_array_equal(solution.poses.body_pose, fit(observed, BIRD, how).poses.body_pose)


def test_published_configs_search_as_published():
    methods = {name: load_config(name).initialise.method for name in ("paper", "baseline", "aves")}
    assert methods == {"paper": "viewing_axis", "baseline": "viewing_axis", "aves": "so3"}
