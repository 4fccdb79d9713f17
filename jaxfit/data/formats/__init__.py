"""File formats of observations, and the file names of a simulated scene."""

from __future__ import annotations

__all__ = ["DETECTIONS", "FOOTAGE", "MARKER", "TRUE_POSES", "TRUTH"]

FOOTAGE = "footage.mp4"
TRUTH = "truth.json"
"""Exact annotations, a COCO file."""
TRUE_POSES = "truth"
"""Exact poses, a result folder."""
DETECTIONS = "detections.json"
"""Simulated output of detectors, a COCO file."""
MARKER = "scene.json"
"""Description of the scene: arguments, camera, behaviours. Every folder of a scene holds this file."""
