"""The summary of a result folder: counts, status, timings and versions."""

from __future__ import annotations

import platform
from collections import Counter
from typing import Any

import numpy as np

from jaxfit.data.ambiguity import ambiguous_frames
from jaxfit.data.solution import Solution
from jaxfit.extras import LIBRARIES, library_versions
from jaxfit.model.bird import Bird
from jaxfit.model.describe import model_hash

__all__ = ["summarise"]


def summarise(solution: Solution, bird: Bird, seconds: dict[str, float]) -> dict[str, Any]:
    """Return the content of `summary.json`: counts; status, failures, second poses and loss of every track; timings;
    the identity of the video, where it is known.

    Args:
        solution: the result.
        bird: the model of the fit.
        seconds: duration of each part of the command.
    """
    summary = {} if solution.footage is None else {"video": solution.footage.entries()}
    return summary | {
        "tracks": len(solution.track_id),
        "frames": len(solution.frame_index),
        "fps": solution.fps,
        "poses": int(solution.valid.sum()),
        "status": dict(Counter(str(status) for status in solution.status)),
        "track_status": {int(t): str(s) for t, s in zip(solution.track_id, solution.status, strict=True)},
        "failures": solution.failures,
        "ambiguous": ambiguous_frames(solution),
        "loss": {name: np.asarray(value).tolist() for name, value in solution.loss.items()},
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "model": {"name": bird.name, "hash": model_hash(bird)},
        "versions": {"python": platform.python_version()} | library_versions(LIBRARIES),
    }
