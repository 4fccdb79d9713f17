"""The folder of results: what is written comes back, and what is damaged is refused by name."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support.birds import toy_bird

from jaxfit.data.solution import FORMAT_VERSION, Solution, load_solution, save_solution
from jaxfit.foundation.errors import InputError
from jaxfit.model.files import save_bird

BIRD = replace(toy_bird(), joint_names=("körper", *toy_bird().joint_names[1:]))
N, T, J, K, S = 2, 3, BIRD.num_joints, BIRD.num_keypoints, BIRD.num_shapes


def make(**changes):
    rng = np.random.default_rng(0)

    def some(*shape):
        return rng.normal(size=(N, T, *shape)).astype(np.float32)

    values = {
        "track_id": [3, 8],
        "frame_index": [5, 6, 9],
        "valid": rng.random((N, T)) < 0.5,
        "global_orient": some(3),
        "body_pose": some(J - 1, 3),
        "transl": some(3),
        "scale": np.exp(some()),
        "bone_length": some(J - 1),
        "betas": some(S),
        "keypoints_cam": some(K, 3),
        "keypoints_px": some(K, 2),
        "crop": np.exp(some(3)),
        "image_size_px": rng.integers(1, 4000, (N, T, 2)),
        "focal_px": 2167.0,
        "crop_px": 256,
        "keypoint_names": BIRD.keypoint_names,
        "joint_names": BIRD.joint_names,
        "loss": {"keypoints": [1.5, math.nan], "mask": np.array([2.5, 3])},
        "status": ["ok", "no usable frame"],
        "timestamp_s": [0.2, np.nan, 0.36],
        "fps": 25.0,
        "ambiguity_deg": some() ** 2,
        "doubts": rng.integers(-1, 32, (N, T)),
    }
    return Solution.from_arrays(**values | changes)


def assert_same(a: Solution, b: Solution):
    assert a.arrays().keys() == b.arrays().keys()
    for name, value in (a.arrays() | {"timestamp_s": a.timestamp_s}).items():
        again = (b.arrays() | {"timestamp_s": b.timestamp_s})[name]
        np.testing.assert_array_equal(value, again, err_msg=name)
        assert np.asarray(value).dtype == np.asarray(again).dtype, name
    assert (a.keypoint_names, a.joint_names, a.fps) == (b.keypoint_names, b.joint_names, b.fps)
    assert list(a.loss) == list(b.loss)
    for term in a.loss:
        np.testing.assert_array_equal(a.loss[term], b.loss[term])


@pytest.mark.parametrize(
    "changes",
    [{}, {"loss": {}, "fps": None}, {"global_orient": np.full((N, T, 3), np.nan), "valid": np.zeros((N, T), bool)}],
    ids=["plain", "no terms", "failed"],
)
def test_what_is_saved_is_loaded(tmp_path, changes):
    save_solution(make(**changes), BIRD, "a: 1\n", {}, tmp_path / "out")
    solution, bird = load_solution(tmp_path / "out")
    assert_same(solution, make(**changes))
    assert bird.joint_names == BIRD.joint_names
    np.testing.assert_array_equal(bird.vertices, BIRD.vertices)


def test_old_attributes_name_their_place():
    with pytest.raises(AttributeError, match=r"use solution\.keypoints\.px"):
        getattr(make(), "keypoints_" + "px")
    assert not hasattr(make(), "no_such_thing")


def test_a_solution_prints_a_summary():
    lines = str(make(valid=np.ones((N, T), bool))).splitlines()
    assert 8 <= len(lines) <= 12
    assert "2: 1 ok, 1 no usable frame" in lines[1]
    assert "6 of 6, 8 joints" in lines[4]


def test_no_birds_at_all(tmp_path):
    arrays = {name: value[:0] for name, value in make().arrays().items() if np.shape(value)[:1] == (N,)}
    empty = make().with_arrays(**arrays, loss={"mask": np.zeros(0)})
    save_solution(empty, BIRD, "", {}, tmp_path / "out")
    assert_same(load_solution(tmp_path / "out")[0], empty)


def test_files_of_the_folder(tmp_path):
    summary = {
        "me_p": np.float32(0.5),
        "me_v": math.nan,
        "worst": np.array([1, np.inf]),
        "n": np.int64(3),
        "nested": {"path": "ü", "ok": True, "none": None, "all": (1, 2)},
        5: [np.bool_(False)],
    }
    save_solution(make(), BIRD, "stages: [ü]\n", summary, tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "config.yaml",
        "model.npz",
        "poses.npz",
        "summary.json",
    ]
    assert (tmp_path / "out" / "config.yaml").read_text(encoding="utf-8") == "stages: [ü]\n"

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    assert json.loads((tmp_path / "out" / "summary.json").read_text(), parse_constant=refuse) == {
        "me_p": 0.5,
        "me_v": None,
        "worst": [1, None],
        "n": 3,
        "nested": {"path": "ü", "ok": True, "none": None, "all": [1, 2]},
        "5": [False],
    }
    with np.load(tmp_path / "out" / "poses.npz", allow_pickle=False) as arrays:
        assert arrays["loss"].shape == (N, 2)
        assert arrays["loss_terms"].tolist() == ["keypoints", "mask"]
        assert arrays["format_version"] == FORMAT_VERSION


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"valid": np.ones((N, T + 1), bool)}, "valid must have shape .* T is 3 in frame_index"),
        ({"bone_length": np.ones((N, T, 3))}, "bone_length must have shape .* bones is 7 in body_pose"),
        ({"joint_names": ("root",)}, "joint_names must be 8"),
        ({"keypoint_names": ("a",)}, "keypoint_names must have shape .* K is 12 in keypoints_cam"),
        ({"loss": {"mask": [1.0]}}, r"loss\[mask\] must have shape"),
        ({"focal_px": 0}, "focal_px must be above 0"),
        ({"crop_px": 2**40}, "crop_px must be in 1…16384"),
    ],
)
def test_contradictions_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)


def rewrite(folder, **changes):
    with np.load(folder / "poses.npz") as arrays:
        kept = {name: arrays[name] for name in arrays.files}
    np.savez(folder / "poses.npz", **{k: v for k, v in (kept | changes).items() if v is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": np.int64(FORMAT_VERSION + 1)}, "newer than this jaxfit reads .*needs a newer jaxfit"),
        ({"format_version": np.array("one")}, "format_version is one"),
        ({"format_version": None}, "lacks the array format_version"),
        ({"betas": None}, "lacks the array betas"),
        ({"scale": np.ones((N, T + 1))}, "scale must have shape .* T is 3 in frame_index"),
        ({"joint_names": np.array(["a"])}, r"joint_names must have shape \(J\)|joint_names must be 8"),
        ({"loss_terms": np.array(["a"])}, "loss_terms must have shape .* L is 2 in loss"),
        ({"timestamp_s": np.full(T, np.inf)}, "timestamp_s must be finite, or NaN"),
        ({"fps": np.array(-1.0)}, "fps must be positive and finite"),
        ({"status": np.array([None, {}], dtype=object)}, "Object arrays cannot be loaded"),
    ],
)
def test_damaged_folders_are_refused_by_name(tmp_path, changes, message):
    save_solution(make(), BIRD, "", {}, tmp_path / "out")
    rewrite(tmp_path / "out", **changes)
    with pytest.raises(InputError, match=message) as caught:
        load_solution(tmp_path / "out")
    assert str(caught.value).startswith(str(tmp_path / "out" / "poses.npz"))


def test_a_folder_of_an_older_version_is_rejected_by_its_version(tmp_path):
    """Version 1 has other names; the message names the version and not one of the missing arrays."""
    save_solution(make(), BIRD, "", {}, tmp_path / "out")
    with np.load(tmp_path / "out" / "poses.npz") as arrays:
        older = {"keypoints_3d": arrays["keypoints_cam"], "keypoints_2d": arrays["keypoints_px"]}
    newer = {"keypoints_cam": None, "keypoints_px": None, "focal_px": None}
    rewrite(tmp_path / "out", format_version=np.int64(1), focal=np.float64(2167), **older, **newer)
    with pytest.raises(InputError, match=r"poses\.npz: format_version is 1, older than this jaxfit reads \(2\)"):
        load_solution(tmp_path / "out")


def test_a_folder_without_times_is_read(tmp_path):
    """Version 2 of the file has no times."""
    save_solution(make(), BIRD, "", {}, tmp_path / "out")
    rewrite(tmp_path / "out", format_version=np.int64(2), timestamp_s=None, fps=None, ambiguity_deg=None, doubts=None)
    solution, _ = load_solution(tmp_path / "out")
    assert_same(solution, make(timestamp_s=None, fps=None, ambiguity_deg=None, doubts=None))
    assert np.isnan(solution.timestamp_s).all()
    assert solution.fps is None


def test_a_model_that_is_not_the_poses_is_refused(tmp_path):
    save_solution(make(), BIRD, "", {}, tmp_path / "out")
    save_bird(toy_bird(), tmp_path / "out" / "model.npz")
    with pytest.raises(InputError, match=r"model\.npz: is not the model of poses\.npz"):
        load_solution(tmp_path / "out")
    save_bird(replace(toy_bird(1), joint_names=BIRD.joint_names), tmp_path / "out" / "model.npz")
    with pytest.raises(InputError, match=r"has 1 shape coefficients, but poses\.npz has 2"):
        load_solution(tmp_path / "out")
    (tmp_path / "out" / "model.npz").unlink()
    with pytest.raises(InputError, match=r"model\.npz"):
        load_solution(tmp_path / "out")


def test_what_is_no_folder_of_results(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load_solution(tmp_path / "absent")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file, not a folder"):
        load_solution(tmp_path / "file")
    with pytest.raises(InputError, match=r"poses\.npz: does not exist"):
        load_solution(tmp_path)
    (tmp_path / "poses.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(InputError, match=r"is not an \.npz file"):
        load_solution(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"track_id": [3, 3]}, "track_id holds track 3 twice"),
        ({"frame_index": [5, 9, 6]}, "frame_index must increase, but 6 follows 9"),
        ({"frame_index": [-1, 0, 1]}, "frame_index must be 0 or more, not -1"),
        ({"frame_index": np.array([5, 6, 2**63], np.uint64)}, "frame_index must be of type int64, but holds"),
        ({"scale": "negative"}, "scale is not above 0 for track 8, frame 6"),
        ({"transl": "nan"}, "transl holds NaN or infinite numbers for track 8, frame 6"),
        ({"body_pose": "1e11"}, r"body_pose holds numbers beyond 10000 for track 8, frame 6"),
        ({"transl": "1e33"}, r"transl holds numbers beyond 1e\+12 for track 8, frame 6"),
        ({"crop": "negative"}, "crop has a size that is not above 0 for track 8, frame 6"),
        ({"image_size_px": "negative"}, "image_size_px is not in 1…16384 for track 8, frame 6"),
        ({"status": ["ok", "lost"]}, "status of track 8 is 'lost', expected one of: ok, partly diverged"),
        ({"keypoint_names": ("a",) * K}, "keypoint_names must name each part once"),
        ({"focal_px": True}, "focal_px must be of type float64, not bool"),
        ({"crop_px": 2.5}, "crop_px must be of type int64"),
    ],
)
def test_values_that_no_fit_gives(changes, message):
    changes = {"valid": np.ones((N, T), bool)} | changes
    (name, kind) = list(changes.items())[-1]
    if isinstance(kind, str):
        changes[name] = np.array(make().arrays()[name])
        changes[name][1, 1] = -1 if kind == "negative" else float(kind)
    with pytest.raises(ValueError, match=message):
        make(**changes)
    if isinstance(kind, str):  # values are arbitrary where the solution is not valid
        changes["valid"] = ~np.eye(N, T, dtype=bool)
        make(**changes)


def test_unasked_arrays_are_not_read(tmp_path):
    save_solution(make(), BIRD, "", {}, tmp_path / "out")
    rewrite(tmp_path / "out", extra=np.array([{}], dtype=object))
    load_solution(tmp_path / "out")
