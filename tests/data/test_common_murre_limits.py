"""Positions and tables of common_murre_temporal that are no pixels, or too large."""

import cv2
import numpy as np
import pytest

from jaxfit.data.formats.common_murre import read_common_murre
from jaxfit.foundation.errors import InputError

T, N, WIDTH, HEIGHT = 3, 2, 32, 24


def annotations():
    rng = np.random.default_rng(0)
    return np.concatenate([rng.uniform(2, 22, (T, N, 20, 2)), np.ones((T, N, 20, 1))], axis=-1)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "images").mkdir()
    for t in range(T):
        cv2.imwrite(str(tmp_path / "images" / f"{t}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    np.save(tmp_path / "annotations.npy", annotations())
    return tmp_path


@pytest.mark.parametrize("value", [1e300, -1e7])
def test_one_very_large_position(folder, value):
    """Below the fraction of keypoints that may lie outside their image, but no number of float32."""
    array = annotations()
    array[0, 0, 0, 0] = value
    np.save(folder / "annotations.npy", array)
    with pytest.raises(InputError, match=r"holds a position of .* which is no pixel"):
        read_common_murre(folder)


def test_a_large_array_of_small_numbers_is_refused(folder):
    """Numbers of one byte would become numbers of eight bytes in several copies."""
    np.save(folder / "annotations.npy", np.zeros((T, 200_000, 20, 3), np.uint8))
    with pytest.raises(InputError, match=r"the annotations need 3\.6 GB, more than 2 GB"):
        read_common_murre(folder)
