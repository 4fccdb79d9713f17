"""Keypoint detection: crops of single birds, and the networks that process the crops."""

from jaxfit.perception.keypoints.crops import Crop, crop_bird
from jaxfit.perception.keypoints.detector import load_keypoint_detector

__all__ = ["Crop", "crop_bird", "load_keypoint_detector"]
