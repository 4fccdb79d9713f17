"""Calls of the readers of networks for `support.hostile`."""

import numpy as np
import onnxruntime  # noqa: F401 - imported once in the server, not in every child

from jaxfit.perception.keypoints import load_keypoint_detector
from jaxfit.perception.network import instance_of
from jaxfit.perception.segmentation import load_segmenter

FRAME = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)


def segment(path: str) -> None:
    """Load a segmenter and segment a frame."""
    for instance in load_segmenter(path, threads=1)(FRAME):
        assert instance.mask.any()
        assert 0 <= instance.score <= 1


def detect_keypoints(path: str) -> None:
    """Load a keypoint network and detect the keypoints of two birds."""
    birds = [instance_of(np.ones((9, 12), bool), 1.0, "bird", x, 20) for x in (3, 40)]
    points_px, confidence = load_keypoint_detector(path, threads=1)(FRAME, [bird for bird in birds if bird])
    assert np.isfinite(points_px).all()
    assert ((confidence >= 0) & (confidence <= 1)).all()
