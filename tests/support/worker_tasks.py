"""Tasks for worker processes, which import them from this module."""

import os
import signal
import zlib
from pathlib import Path

import jax
import numpy as np

from jaxfit.fitting.batch import FittedWindow
from jaxfit.fitting.tasks import failed_windows
from jaxfit.fitting.windows import window_content
from jaxfit.foundation.errors import InputError

attempts = []
"""Tasks that `failing` received in this process."""


def add(shared, task):
    return shared + task


def quick_fit(model, task, _report_progress=None):
    """Return poses that depend on the content of the window and on the config, as `fit_task` does, in no time."""
    results = []
    for r, w in task.problems:
        config = task.configs[r]
        content = repr(window_content(task.windows[r], w)) + repr(config)
        value = np.float32(zlib.crc32(content.encode()) / 2**32 + 0.5)
        (empty,) = failed_windows(model, config, 1, "")
        filled = jax.tree.map(lambda x, value=value: np.full_like(x, value), empty.pose)
        points = np.full_like(empty.keypoints_cam, value), np.full_like(empty.keypoints_px, value)
        angle_deg = np.full_like(empty.ambiguity_deg, value)
        results.append(FittedWindow(filled, dict.fromkeys(empty.loss, float(value)), *points, "", angle_deg))
    return results


def failing(shared, task):
    """Fail as many times as `shared` says for the task."""
    attempts.append(task)
    if attempts.count(task) <= shared.get(task, 0):
        raise RuntimeError(f"task {task}")
    return task


def ending(_model, _task, _report_progress=None):
    raise MemoryError


def refusing(_shared, task):
    if task == 1:
        raise InputError("term 'far'", "cannot be imported", "install it")
    return task


def deadly(shared, task):
    """End the worker: always for task 0, once for task 1 (`shared` is a folder), never for other tasks."""
    if task == 0 or (task == 1 and not (Path(shared) / "once").exists()):
        (Path(shared) / ("always" if task == 0 else "once")).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return task
