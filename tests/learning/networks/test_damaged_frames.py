"""Damaged frames for training end in frames or in one error."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.hostile import Isolated, many_examples
from support.mutations import damaged_arrays, damaged_bytes

from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks.labelled_frames import load_frames, save_labels
from jaxfit.learning.networks.scenes import HEIGHT, WIDTH
from jaxfit.model.anatomy import MURRE_KEYPOINTS

K = len(MURRE_KEYPOINTS)
LABELS = {
    "keypoints_px": np.full((1, 2, K, 2), 40, np.float32),
    "visibility": np.full((1, 2, K), 2, np.uint8),
    "pixels_per_unit": np.full(1, 9, np.float32),
}


@pytest.fixture
def folder(tmp_path):
    np.save(tmp_path / "pictures.npy", np.zeros((1, HEIGHT, WIDTH, 3), np.uint8))
    np.save(tmp_path / "owner.npy", np.zeros((1, HEIGHT, WIDTH), np.uint8))
    np.savez(tmp_path / "frames.npz", **LABELS)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("keypoints_px", np.full((1, 2, K, 2), np.nan, np.float32), "wrong position of a keypoint"),
        ("visibility", np.full((1, 2, K), 4, np.uint8), "wrong visibility"),
        ("visibility", np.zeros((1, 2, K)), "wrong type of numbers"),
        ("pixels_per_unit", np.zeros(1, np.float32), "wrong scale"),
        ("pixels_per_unit", np.full(1, 1e30, np.float32), "wrong scale"),
    ],
)
def test_impossible_labels(folder, name, value, message):
    assert len(load_frames(folder).pictures) == 1
    np.savez(folder / "frames.npz", **LABELS | {name: value})
    with pytest.raises(InputError, match=message):
        load_frames(folder)


def test_keypoints_far_outside_the_picture_are_clipped(folder):
    points, visibility = LABELS["keypoints_px"].copy(), LABELS["visibility"].copy()
    points[0, 1, 3], visibility[0, 1, 3] = (-6e8, 20), 0
    save_labels(folder, points, visibility, LABELS["pixels_per_unit"])
    assert load_frames(folder).keypoints_px[0, 1, 3].tolist() == [-1e6, 20]
    visibility[0, 1, 3] = 2  # a visible keypoint cannot lie there
    save_labels(folder, points, visibility, LABELS["pixels_per_unit"])
    with pytest.raises(InputError, match="wrong position of a keypoint"):
        load_frames(folder)


@pytest.mark.extended
def test_damaged_labels(folder):
    valid = (folder / "frames.npz").read_bytes()

    def as_bytes(arrays):
        file = io.BytesIO()
        np.savez(file, **arrays)
        return file.getvalue()

    with Isolated("jaxfit.learning.networks.labelled_frames:load_frames") as reader:
        assert reader(folder).kind == "success"

        @many_examples
        @given(st.one_of(damaged_bytes(valid), damaged_arrays(LABELS).map(as_bytes)))
        def check(damaged):
            (folder / "frames.npz").write_bytes(damaged)
            outcome = reader(folder)
            assert outcome.acceptable, outcome

        check()
