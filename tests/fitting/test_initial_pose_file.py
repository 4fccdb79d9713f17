"""Initial poses from files: both layouts are matched to the birds, and unsuitable files are rejected."""

import dataclasses

import jax
import numpy as np
import pytest
from support.birds import tiny_bird

from jaxfit.config.fit import load_config
from jaxfit.data.observations import Observations
from jaxfit.fitting.initial_poses import load_initial_poses
from jaxfit.fitting.windows import cut_windows
from jaxfit.foundation.errors import InputError

BIRD = tiny_bird()
N, T, J = 2, 5, BIRD.num_joints
CONFIG = dataclasses.replace(load_config("paper"), window=T)


def observed(absent=((1, 2),)):
    rng = np.random.default_rng(0)
    present = np.ones((N, T), bool)
    for at in absent:
        present[at] = False
    return Observations(
        track_id=np.array([4, 9]),
        frame_index=np.array([10, 11, 12, 13, 14]),
        present=present,
        keypoints_px=rng.uniform(80, 160, (N, T, BIRD.num_keypoints, 2)),
        confidence=np.ones((N, T, BIRD.num_keypoints)) * present[..., None],
        box_px=np.broadcast_to([80.0, 80, 80, 80], (N, T, 4)),
        image_size_px=np.full((T, 2), 256),
        file_name=np.array(["a", "b", "c", "d", "e"]),
        keypoint_names=BIRD.keypoint_names,
    )


def result(seed=1, tracks=(9, 4), frames=(10, 11, 12, 13, 14), **changes):
    """Return the arrays of a result's poses.npz. The order of the tracks differs from the observations."""
    rng = np.random.default_rng(seed)
    lead = (len(tracks), len(frames))
    arrays = {
        "track_id": np.array(tracks),
        "frame_index": np.array(frames),
        "global_orient": rng.normal(size=(*lead, 3)),
        "body_pose": rng.normal(size=(*lead, J - 1, 3)),
        "transl": rng.normal(size=(*lead, 3)),
        "scale": rng.uniform(1, 2, lead),
        "bone_length": rng.uniform(0.5, 2, (*lead, J - 1)),
        "betas": rng.normal(size=(*lead, 2)),
        "crop": np.broadcast_to(cut_windows(observed(), CONFIG).crop[0, 0], (*lead, 3)),
    }
    return {name: np.asarray(value, value.dtype) for name, value in (arrays | changes).items() if value is not None}


def rows(count, **changes):
    """Return the arrays of a regressor's output."""
    rng = np.random.default_rng(2)
    arrays = {
        "init_pose": rng.normal(size=(count, J, 3)),
        "init_bone_length": rng.uniform(0.5, 2, (count, J - 1)),
        "init_translation": rng.normal(size=(count, 3)),
    }
    return {name: value for name, value in (arrays | changes).items() if value is not None}


def saved(tmp_path, arrays, name="initial.npz"):
    np.savez(tmp_path / name, **arrays)
    return tmp_path / name


def poses(initial, common_size=False, observations=None):
    observations = observed() if observations is None else observations
    windows = cut_windows(observations, CONFIG)
    initial.check_crops(windows)
    windowed = initial.window_poses(BIRD, windows, common_size)
    return [jax.tree.map(lambda x, w=w: np.asarray(x)[w, 0], windowed) for w in range(len(windows))]


def test_initial_poses_from_an_earlier_result(tmp_path):
    arrays = result()
    initial = load_initial_poses(saved(tmp_path, arrays), observed(), BIRD)
    assert initial.has_shape
    first, second = poses(initial)
    np.testing.assert_allclose(
        first.global_orient, arrays["global_orient"][1], rtol=1e-6
    )  # track 4 is the second track of the file
    np.testing.assert_allclose(second.body_pose[3], arrays["body_pose"][0, 3], rtol=1e-6)
    np.testing.assert_allclose(first.transl, arrays["transl"][1], rtol=1e-6)
    np.testing.assert_allclose(first.scale, arrays["scale"][1], rtol=1e-6)
    np.testing.assert_allclose(first.bone_length, np.median(arrays["bone_length"][1], 0), rtol=1e-6)
    np.testing.assert_allclose(first.betas, np.median(arrays["betas"][1], 0), rtol=1e-6)
    common = poses(initial, common_size=True)[0]
    np.testing.assert_allclose(common.scale, [np.median(arrays["scale"][1])], rtol=1e-6)


def test_a_frame_without_a_pose_has_the_pose_of_its_neighbour(tmp_path):
    arrays = result()
    arrays["global_orient"][1, 0] = np.nan  # track 4 has no pose in this frame
    first, second = poses(load_initial_poses(saved(tmp_path, arrays), observed(), BIRD))
    np.testing.assert_allclose(first.global_orient[0], arrays["global_orient"][1, 1], rtol=1e-6)
    np.testing.assert_allclose(second.transl[2], arrays["transl"][0, 1], rtol=1e-6)  # the bird is absent in this frame
    fewer = result(frames=(11, 14))
    first, _ = poses(load_initial_poses(saved(tmp_path, fewer), observed(), BIRD))
    np.testing.assert_allclose(first.transl, fewer["transl"][1, [0, 0, 0, 1, 1]], rtol=1e-6)


def test_initial_poses_from_a_regressor(tmp_path):
    observations = observed()
    arrays = rows(N * T - 1)
    initial = load_initial_poses(saved(tmp_path, arrays), observations, BIRD)
    assert not initial.has_shape
    first, second = poses(initial)
    np.testing.assert_allclose(first.global_orient, arrays["init_pose"][:5, 0], rtol=1e-6)
    np.testing.assert_allclose(second.body_pose[[0, 1, 3, 4]], arrays["init_pose"][5:, 1:], rtol=1e-6)
    np.testing.assert_allclose(second.transl[[0, 1, 3, 4]], arrays["init_translation"][5:], rtol=1e-6)
    np.testing.assert_array_equal(first.scale, 1)
    np.testing.assert_array_equal(first.betas, np.zeros(2))
    np.testing.assert_allclose(first.bone_length, np.median(arrays["init_bone_length"][:5], 0), rtol=1e-6)


def nan_at(array, *at):
    array[at] = np.nan
    return array


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (rows(8), "has 8 rows .*9 annotations"),
        (rows(9, init_translation=np.zeros((4, 3))), r"init_translation must have shape .* A is 9 in init_pose"),
        (rows(9, init_pose=np.zeros((9, 11, 3)), init_bone_length=np.ones((9, 10))), r"poses of 11 joints \(.* 4"),
        (rows(9, init_bone_length=np.ones((9, J))), "`init_bone_length`"),
        (rows(9, init_pose=nan_at(np.zeros((9, J, 3)), 2, 1)), "NaN or infinite"),
        (rows(9, init_translation=None), "init_translation"),
        (result(transl=None), "transl"),
        (result(body_pose=np.zeros((2, 5, J + 1, 3)), bone_length=np.ones((2, 5, J + 1))), "poses of 6 joints"),
        (result(betas=np.zeros((2, 5, 9))), "9 shape coefficients .*2"),
        (result(bone_length=np.ones((2, 5, J))), "bone_length"),
        (result(transl=nan_at(np.zeros((2, 5, 3)), 0, 1)), "transl.*NaN"),
        (result(scale=np.full((2, 5), -1.0)), "scale is not above 0 for track 9, frame 10"),
        (result(track_id=np.zeros(2, int)), "track_id holds track 0 twice"),
        (rows(9, init_pose=np.full((9, J, 3), "1")), "init_pose must be of type float32, not <U1"),
        (result(tracks=(), crop=np.zeros((0, 5, 3))), "no pose for any"),
        ({"something": np.ones(3)}, "init_pose"),
    ],
)
def test_unsuitable_files_are_rejected(tmp_path, arrays, message):
    path = saved(tmp_path, arrays)
    with pytest.raises(InputError, match=message) as caught:
        load_initial_poses(path, observed(), BIRD)
    assert str(caught.value).startswith(f"{path}: ")


def test_poses_of_other_crops_are_rejected(tmp_path):
    arrays = result()
    arrays["crop"] = arrays["crop"] + np.array([30, 0, 0])
    initial = load_initial_poses(saved(tmp_path, arrays), observed(), BIRD)
    with pytest.raises(InputError, match=r"initial\.npz: `crop` of track 4 differs by 30 pixels"):
        poses(initial)


def test_a_bird_without_initial_poses_is_rejected(tmp_path):
    initial = load_initial_poses(saved(tmp_path, result(tracks=(4,))), observed(), BIRD)
    with pytest.raises(InputError, match="has no pose for track 9"):
        poses(initial)
