"""The masks of the other birds of an image."""

import numpy as np

from jaxfit.data.masks import decode_mask, encode_mask
from jaxfit.data.observations import FrameMasks, Observations

SIZE = WIDTH, HEIGHT = 40, 30
FRAMES = 5


def column(x):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[10:20, x : x + 4] = True
    return mask


def test_masks_of_the_other_birds_in_a_region():
    """Three birds stand side by side."""
    masks = {(n, t): encode_mask(column(5 + 10 * n + t)) for t in range(FRAMES) for n in range(3)}
    observations = Observations(
        track_id=np.arange(3),
        frame_index=np.arange(FRAMES),
        present=np.ones((3, FRAMES), bool),
        keypoints_px=np.zeros((3, FRAMES, 1, 2)),
        confidence=np.zeros((3, FRAMES, 1)),
        box_px=np.ones((3, FRAMES, 4)),
        image_size_px=np.full((FRAMES, 2), SIZE),
        file_name=np.array([f"{t}.png" for t in range(FRAMES)]),
        keypoint_names=("bill",),
        masks=masks,
    )
    masks_of_frame = FrameMasks(observations)
    region = np.array([0, 0, 40, 40], float)
    (left, right), near = masks_of_frame.others(1, 1, region), masks_of_frame.others(1, 3, region / 2)
    np.testing.assert_array_equal(decode_mask(left), column(6))
    np.testing.assert_array_equal(decode_mask(right), column(26))
    assert len(near) == 1  # bird 2 is outside the region
    np.testing.assert_array_equal(decode_mask(near[0]), column(8))
