"""Fitted windows as files, so that an interrupted fit continues after its last stored windows."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from jaxfit.fitting.batch import FittedWindow
from jaxfit.fitting.bodies import BodyEvidence
from jaxfit.fitting.error_bars import ErrorBars, pack, unpack
from jaxfit.fitting.tiles import tile_size
from jaxfit.fitting.windows import Windows, window_hash
from jaxfit.foundation.unfinished import Parts
from jaxfit.model.kinematics import Pose

MIN_FRAMES = 100
"""Frames of every bird between two writes, for windows of fewer frames."""

_POSE = {
    "global_orient": "W T 3",
    "body_pose": "W T J-1 3",
    "transl": "W T 3",
    "scale": "W Z",  # T, or 1 for a common size
    "bone_length": "W J-1",
    "betas": "W S",
}
_LAYOUT = {
    "content": "W",  # hash of the content of the window
    "failure": "W",
    "loss": "W L",
    "loss_terms": "L",
    "keypoints_cam": "W T K 3",
    "keypoints_px": "W T K 2",
    "ambiguity_deg": "W T",
    "error_bars": "W T E",  # no number (E = 0) for a config without error bars
    "body": "W F",  # no number (F = 0) for a stage that shares no body
    **_POSE,
}


class StoredWindows:
    """Fitted windows of one config and one model, found by the content of the window.

    Args:
        parts: the files. The record of the parts must hold the config and the model.
    """

    def __init__(self, parts: Parts):
        self._parts, self._count = parts, 0

    @property
    def state(self) -> str:
        """The number of windows that were found or added, for progress."""
        return f"{self._count} {'window' if self._count == 1 else 'windows'} fitted"

    def find(self, windows: Windows, contents: Mapping[int, bytes]) -> dict[int, FittedWindow]:
        """Return row → result of the windows that are stored.

        Args:
            windows: all windows.
            contents: row → what determines the result beside the window; only these rows count.

        Raises:
            InputError: a file is damaged.
        """
        rows: dict[str, list[int]] = {}
        for w in np.argsort(windows.frame.max(1), kind="stable").tolist() if self._parts.numbers else ():
            if w in contents:
                rows.setdefault(window_hash(windows, w, contents[w]), []).append(w)
        found = {}
        for number in self._parts.numbers:
            arrays = self._parts.load(number, _LAYOUT)
            terms = arrays["loss_terms"].tolist()
            for i, content in enumerate(arrays["content"].tolist()):
                result = FittedWindow(
                    Pose(**{name: arrays[name][i] for name in _POSE}),
                    dict(zip(terms, arrays["loss"][i].tolist(), strict=True)),
                    arrays["keypoints_cam"][i],
                    arrays["keypoints_px"][i],
                    str(arrays["failure"][i]),
                    arrays["ambiguity_deg"][i],
                    _error_bars(arrays, i),
                    _evidence(arrays, i),
                )
                found |= {w: result for w in rows.get(content, ())}
        self._count += len(found)
        return found

    def add(self, windows: Windows, results: Mapping[int, FittedWindow], contents: Mapping[int, bytes]) -> None:
        """Store the results of some windows, by row; `contents` as for `find`.

        Raises:
            InputError: the disk is full, or the folder cannot be written.
        """
        self._count += len(results)
        some = list(results.values())
        poses = {name: np.stack([getattr(result.pose, name) for result in some]) for name in _POSE}
        self._parts.add(
            {
                "content": np.array([window_hash(windows, w, contents[w]) for w in results]),
                "failure": np.array([result.failure for result in some]),
                "loss": np.array([list(result.loss.values()) for result in some], np.float64),
                "loss_terms": np.array(list(some[0].loss)),
                "keypoints_cam": np.stack([result.keypoints_cam for result in some]),
                "keypoints_px": np.stack([result.keypoints_px for result in some]),
                "ambiguity_deg": np.stack([result.ambiguity_deg for result in some]),
                "error_bars": np.stack([_packed(result) for result in some]),
                "body": np.stack([_packed_evidence(result) for result in some]),
                **poses,
            }
        )


def _packed(result: FittedWindow) -> np.ndarray:
    no_numbers = np.zeros((len(result.ambiguity_deg), 0), np.float32)
    return no_numbers if result.error_bars is None else pack(result.error_bars)


def _error_bars(arrays: Mapping[str, np.ndarray], i: int) -> ErrorBars | None:
    packed = arrays["error_bars"][i]
    if not packed.shape[1]:
        return None
    sizes = arrays["body_pose"].shape[2], arrays["betas"].shape[1], arrays["keypoints_cam"].shape[2]
    return unpack(packed, *sizes)


def _packed_evidence(result: FittedWindow) -> np.ndarray:
    return np.zeros(0) if result.body is None else np.concatenate([np.ravel(each) for each in result.body])


def _evidence(arrays: Mapping[str, np.ndarray], i: int) -> BodyEvidence | None:
    packed, K, D = arrays["body"][i], arrays["keypoints_cam"].shape[2], 3 * arrays["body_pose"].shape[2]
    if not len(packed):
        return None
    # P + P² + P·D + 4K + 1 numbers
    P = round((math.sqrt((1 + D) ** 2 + 4 * (len(packed) - 4 * K - 1)) - 1 - D) / 2)
    shapes = (P,), (P, P), (P, D), (K, 2), (K,), (K,), ()
    ends = np.cumsum([math.prod(shape) for shape in shapes])[:-1]
    parts = np.split(packed, ends)
    return BodyEvidence(*(part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)))


def windows_per_part(birds: int, frames: int) -> int:
    """Return the number of windows that are fitted between two writes.

    An interruption costs at most so many windows: about one window of every bird, or `MIN_FRAMES` frames. Tiles are
    full.

    Args:
        birds: number of tracks.
        frames: frames of a window.
    """
    size = tile_size(frames)
    return -(-birds * -(-MIN_FRAMES // frames) // size) * size
