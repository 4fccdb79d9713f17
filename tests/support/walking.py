"""Birds that walk through the image, with boxes as masks, for the tests of windows."""

import numpy as np

from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations

K, WIDTH, HEIGHT = 5, 400, 300


def walk(numbers, birds=2, seed=0):
    """Return birds that walk to the right by about 4 px per frame number. Frame t has the number `numbers[t]`."""
    rng = np.random.default_rng(seed)
    T = len(numbers)
    centre = np.stack([np.array([60 + 50 * n, 90 + 60 * n]) + np.outer(numbers, [4, 1]) for n in range(birds)])
    keypoints = centre[:, :, None] + rng.uniform(-18, 18, (birds, T, K, 2))
    low, high = keypoints.min(2) - 2, keypoints.max(2) + 2
    masks = {}
    for n in range(birds):
        for t in range(T):
            mask = np.zeros((HEIGHT, WIDTH), bool)
            (x0, y0), (x1, y1) = low[n, t].astype(int), high[n, t].astype(int)
            mask[max(y0, 0) : y1, max(x0, 0) : x1] = True
            masks[n, t] = encode_mask(mask)
    return Observations(
        track_id=np.arange(birds) + 7,
        frame_index=np.array(numbers),
        present=np.ones((birds, T), bool),
        keypoints_px=keypoints,
        confidence=rng.uniform(0.5, 1, (birds, T, K)),
        box_px=np.concatenate([low, high - low], -1),
        image_size_px=np.full((T, 2), [WIDTH, HEIGHT]),
        file_name=np.array([f"{t}.png" for t in numbers]),
        keypoint_names=tuple("abcde"),
        masks=masks,
    )
