"""What the files in the folder of a simulated scene are called, for those who write it and those who read it."""

from __future__ import annotations

__all__ = ["DETECTIONS", "FOOTAGE", "MARKER", "TRUE_POSES", "TRUTH"]

FOOTAGE = "footage.mp4"
TRUTH = "truth.json"
"""Exact annotations, a COCO file."""
TRUE_POSES = "truth"
"""Exact poses, a folder of results."""
DETECTIONS = "detections.json"
"""What detectors would report, a COCO file."""
MARKER = "scene.json"
"""How the scene was made; a folder that holds it is a scene."""
