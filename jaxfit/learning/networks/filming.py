"""Simulated scenes that are filmed in other processes while the network trains on the scenes that are complete."""

from __future__ import annotations

import os
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from types import TracebackType

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.learning.networks.labelled_frames import MARKER, LabelledFrames, join_frames, load_frames
from jaxfit.learning.networks.scenes import film_scene

WORKERS = 2
"""Number of processes that film; more would slow the training down on small machines."""
_STOP: list[Event] = []
"""In a worker: the event that ends the filming."""


class Filming:
    """The folders of `count` scenes, one folder per scene; absent scenes are filmed while the context is open.

    The content of a folder depends only on its number, so later trainings use the folders again. A folder with the
    frames of all scenes, as `film_scenes` writes it, is used as one scene.

    Args:
        folder: the folder above the folders of the scenes.
        count: number of scenes, 1 or more.
        progress: reports every scene.

    Raises:
        InputError: the folder holds other files.
    """

    def __init__(self, folder: Path, count: int, progress: ProgressTask = silent):
        self.folders = _scene_folders(folder, count)
        self._folder, self._progress, self._open = folder, progress, ExitStack()
        self._futures: dict[int, Future[None]] = {}

    def __enter__(self) -> Filming:
        missing = [seed for seed, folder in enumerate(self.folders) if not (folder / MARKER).exists()]
        if missing:
            name = f"Filming {len(missing)} simulated scenes for the training"
            report_progress = self._open.enter_context(self._progress(name, len(missing)))
            context = get_context("spawn")  # a fork breaks compiled code
            stop = context.Event()
            pool = ProcessPoolExecutor(min(WORKERS, len(missing)), context, _prepare_worker, (stop,))
            self._open.callback(self._stop, stop)
            for seed in missing:
                self._futures[seed] = pool.submit(_film, self.folders[seed], seed)
                self._futures[seed].add_done_callback(lambda done: done.cancelled() or report_progress(1, ""))
            pool.shutdown(wait=False)  # the processes end after the last scene
        return self

    def _stop(self, stop: Event) -> None:
        """Wait for the scenes that are being filmed; later scenes are not filmed."""
        stop.set()
        wait([future for future in self._futures.values() if not future.cancel()])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._open.close()

    @property
    def identity(self) -> bytes:
        """What determines the frames: the labels of a folder with all scenes, or the number of scenes."""
        labels = self._folder / MARKER
        return labels.read_bytes() if labels.exists() else f"{len(self.folders)} scenes".encode()

    def wait(self, count: int) -> None:
        """Return when the first `count` scenes are complete.

        Raises:
            InputError: a scene cannot be written, or the system ended a process.
        """
        for seed, future in self._futures.items():
            if seed < count:
                try:
                    future.result()
                except BrokenProcessPool as error:
                    problem = "is incomplete, because the system ended a process that films scenes"
                    remedy = "free memory and repeat the command, or train without simulated scenes by --scenes 0"
                    raise InputError(self.folders[seed], problem, remedy) from error

    def frames(self, count: int) -> LabelledFrames:
        """Return the frames of the first `count` scenes when they are complete; errors as `wait` and `load_frames`."""
        self.wait(count)
        return join_frames([load_frames(folder) for folder in self.folders[:count]])


def missing_scenes(folder: Path, count: int) -> int:
    """Return how many of the first `count` scenes must be filmed; errors as `Filming`."""
    return sum(not (own / MARKER).exists() for own in _scene_folders(folder, count))


def _scene_folders(folder: Path, count: int) -> tuple[Path, ...]:
    if (folder / MARKER).exists():
        return (folder,)
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    others = sorted(name for name in names if not name.startswith((".", "scene_")))
    if others:
        problem = f"holds other files than simulated scenes: {others[0]}"
        raise InputError(folder, problem, "give another folder by --frames")
    return tuple(folder / f"scene_{seed:04d}" for seed in range(count))


def _prepare_worker(stop: Event) -> None:
    """Let the training go first; without scenes to draw from, the training waits and leaves the cores."""
    _STOP.append(stop)
    if hasattr(os, "nice"):
        os.nice(10)


def _film(folder: Path, seed: int) -> None:
    """Film a scene in a worker; a pool also starts some tasks that cannot be cancelled any more."""
    if not any(stop.is_set() for stop in _STOP):
        film_scene(folder, seed)
