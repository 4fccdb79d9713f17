"""Plugin of Dask workers: every worker process of one machine uses its own share of the cores."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from distributed import Worker, WorkerPlugin


class WorkerCores(WorkerPlugin):
    """Limits a worker to its share of the cores of this process, on Linux.

    XLA and the kernels use as many threads as the worker process has cores when its first computation starts, so the
    plugin works before the first task. A worker that replaces an ended worker has its name and its share.

    Args:
        workers: number of workers, whose names are 0, 1, ….
    """

    name = "jaxfit-cores"

    def __init__(self, workers: int):
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        self._shares = [share_of_cores(cores, i, workers) for i in range(workers)]

    def setup(self, worker: Worker) -> None:
        """Limit all threads of the worker process."""
        share = self._shares[int(worker.name)]
        if share:
            for thread in Path("/proc/self/task").iterdir():
                with suppress(ProcessLookupError):  # a thread that has just ended
                    os.sched_setaffinity(int(thread.name), share)


def share_of_cores(cores: list[int], worker: int, workers: int) -> list[int]:
    """Return the cores of a worker: disjoint shares of about equal size, or one core if there are more workers."""
    if len(cores) <= workers:
        return cores[worker % len(cores) :][:1] if cores else []
    return cores[worker * len(cores) // workers : (worker + 1) * len(cores) // workers]
