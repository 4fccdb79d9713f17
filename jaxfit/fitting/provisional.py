"""Windows that are fitted while the video is tracked, as soon as their frames are there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.tracks import frame_step
from jaxfit.fitting.fit import checked_model
from jaxfit.fitting.solve import FitModel
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.fitting.tasks import FitTask, fit_batches, in_batches
from jaxfit.fitting.tiles import tile_size
from jaxfit.fitting.windows import Windows, first_frames, prepare_observations, window_starts, windows_at
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.workers import Cluster
from jaxfit.model.bird import Bird

STEP_FRAMES = 25
"""Number of frames after which complete windows are searched and fitted."""
LATER_FRAMES = 10
"""Number of tracked frames after a window before its fit. Within these frames, a hidden bird returns or its track ends,
and a new neighbour becomes a track that is not skipped; both change the content of the window."""


class ProvisionalFit:
    """Fits the complete windows of the frames so far, and stores the result.

    `fit` takes windows with the same content from the store and fits all others. Its result therefore does not depend
    on provisional fits. Where a later frame changes the content of a window, for example because the track of a
    neighbour is skipped in the end, `fit` does not use the provisional fit. With `learn_weights`, nothing is fitted:
    the weights are learnt from the whole video.

    Use it as a context manager, which ends the display of its progress, and call it after each frame. The frames of
    every search depend on the number of frames only. After an interruption, the calls for the earlier frames therefore
    find the windows that are stored.

    Args:
        bird: the model.
        config: the config of the fit.
        stored: receives the windows.
        progress: shows progress.
        source: name of the observations in error messages.
        cluster: worker processes that fit the windows. None: this process.
    """

    def __init__(
        self,
        bird: Bird,
        config: FitConfig,
        stored: StoredWindows,
        progress: ProgressTask = silent,
        source: object = "observations",
        cluster: Cluster | None = None,
    ):
        self._bird, self._config, self._stored, self._source, self._cluster = bird, config, stored, source, cluster
        self._progress, self._report, self._exit = progress, None, ExitStack()
        self._frames = 0
        self._first_frame: dict[int, int] = {}
        self._waiting: list[Windows] = []
        self._model: FitModel | None = None

    def __enter__(self) -> ProvisionalFit:
        return self

    def __exit__(self, *error: Any) -> bool | None:
        return self._exit.__exit__(*error)

    def __call__(self, observations_from: Callable[[int], Observations]) -> None:
        """Receive one more frame. After every `STEP_FRAMES` frames, fit the windows that have become complete.

        Windows that do not fill a tile wait for the next windows.

        Args:
            observations_from: returns the observations from the frame at a position to the frame of this call.

        Raises:
            InputError: as `fit`.
        """
        if self._config.learn_weights:
            return
        self._frames += 1
        margin = max(self._config.filter_window // 2, LATER_FRAMES)
        if self._frames % STEP_FRAMES or self._frames < self._config.window + margin:
            return
        first = max(self._frames - STEP_FRAMES - self._config.window - 2 * margin, 0)
        observations = observations_from(first)
        if not observations.num_tracks:
            return
        observations = check_keypoints(observations, self._bird.keypoint_names, self._source)
        if self._model is None:
            self._model = checked_model(observations, self._bird, [self._config], None, self._source)
        windows = self._complete_windows(observations, first, margin)
        self._waiting.append(windows[np.array(self._stored.missing(windows), int)])
        self._fit_full_tiles(self._model, observations.num_tracks)

    def _complete_windows(self, observations: Observations, first: int, margin: int) -> Windows:
        """Return the windows that have become complete with the last `STEP_FRAMES` frames.

        Args:
            observations: the last frames.
            first: position of their first frame in the video.
            margin: number of frames after a complete window, and before it if `first` is not 0.
        """
        prepared = prepare_observations(observations, self._config)
        numbers = prepared.frame_index
        # a track that is older than these frames begins at an unknown frame
        least = numbers[0] if first == 0 else numbers[margin]
        new = {track: number for track, number in first_frames(prepared, self._config).items() if number >= least}
        self._first_frame = new | self._first_frame
        starts = window_starts(prepared, self._config, self._first_frame)
        ends = (numbers - numbers[0]) // frame_step(numbers) + 1
        before = ends[-STEP_FRAMES - 1] if len(ends) > STEP_FRAMES else 0
        needed = starts[:, 1] + self._config.window + margin
        windows = windows_at(prepared, self._config, starts[(needed > before) & (needed <= ends[-1])])
        return replace(windows, frame=np.where(windows.frame < 0, -1, windows.frame + first))

    def _fit_full_tiles(self, model: FitModel, birds: int) -> None:
        """Fit the waiting windows, except the last windows if they do not fill a tile."""
        waiting = _joined(self._waiting)
        size = tile_size(self._config.window)
        count = len(waiting) // size * size
        self._waiting = [waiting[count:]]
        if not count:
            return
        if self._report is None:
            self._report = self._exit.enter_context(self._progress("Fitting", None))
        task = FitTask([self._config], [waiting[:count]], [(0, w) for w in range(count)])
        batches = in_batches(task, model, birds, self._stored, self._cluster)
        fit_batches(batches, task, model, self._stored, self._cluster, self._report)


def _joined(parts: Sequence[Windows]) -> Windows:
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0]) if name != "views"
    }
    return Windows(**arrays)
