"""Worker processes that compute tasks: of this machine, or of a Dask cluster that the user has started.

Dask sends functions, arguments and results between its processes as pickles. Everybody who can connect to the scheduler
can therefore run code in the workers, and the workers can run code in this process. The scheduler of local workers
listens on this machine only.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import LIBRARIES, TRACKING_LIBRARIES, library_versions, require_package
from jaxfit.foundation.reading import read_json_file

ATTEMPTS = 3
"""Number of times that a task may fail, or that its worker may end, before the task counts as failed."""
CONNECT_S = 10
"""Longest time until the scheduler answers, seconds."""
TASKS_PER_THREAD = 3
"""Number of tasks that are sent ahead for each thread of the workers. A low number bounds the memory."""
_CHECKED = (*LIBRARIES, *TRACKING_LIBRARIES, "dask", "distributed")

_logger = logging.getLogger(__name__)
_one_task = threading.Lock()
"""A task uses all cores of its process, so a process with several threads computes one task at a time."""


class FailedTask(NamedTuple):
    """The result of a task that failed `ATTEMPTS` times."""

    reason: str


class Cluster:
    """Worker processes. They start, or are connected, at the first use.

    Args:
        connect: returns the `distributed.Client`.
        name: name of the cluster in messages.
    """

    def __init__(self, connect: Callable[[], Any], name: str):
        self._connect, self._name = connect, name

    def run(
        self, function: Callable[[Any, Any], Any], shared: Any, tasks: Iterable[Any]
    ) -> Iterator[tuple[int, Any | FailedTask]]:
        """Compute `function(shared, task)` for every task on the workers.

        If a worker ends, its tasks are computed by other workers. `shared` is sent once.

        Args:
            function: a function of an importable module.
            shared: data for all tasks.
            tasks: taken from the iterator when workers need them.

        Yields:
            The number and the result of every task, in the order of arrival.

        Raises:
            InputError: a task raised InputError; a worker has other versions of libraries; the scheduler ended; or, at
                the end, all tasks have failed.
        """
        from distributed import as_completed

        client: Any = self._connect()
        # the result of a task, not scattered data, which is lost if all workers with a copy end
        sent = client.submit(_received, shared, pure=False)
        remaining, versions = enumerate(tasks), _versions()
        number: dict[str, int] = {}  # of the tasks that are sent, by key
        running = as_completed(loop=client.loop)

        def send() -> None:
            wanted = max(TASKS_PER_THREAD * sum(client.nthreads().values()), 1)
            for i, task in islice(remaining, max(wanted - len(number), 0)):
                future = client.submit(_run, function, sent, task, versions, retries=ATTEMPTS - 1, pure=False)
                number[future.key] = i
                running.add(future)

        send()
        result, has_result = None, False
        for future in running:
            i, result = number.pop(future.key), self._result(future)
            has_result |= not isinstance(result, FailedTask)
            send()
            yield i, result
        if isinstance(result, FailedTask) and not has_result:
            remedy = "repeat the command without workers, which shows the cause"
            raise InputError(self._name, f"no task could be computed: {result.reason}", remedy)

    def _result(self, future: Any) -> Any:
        """Return the result of a task that has finished.

        Waits if a worker ended before its result was here: the task is computed again.
        """
        from distributed.scheduler import KilledWorker

        try:
            result = future.result()
        except Exception as error:
            if future.status != "error":
                problem, remedy = "the connection to the scheduler is lost", "start the cluster and repeat the command"
                raise InputError(self._name, problem, remedy) from error
            if isinstance(error, KilledWorker):
                return FailedTask(f"{error.allowed_failures + 1} workers ended during the task")
            return FailedTask(f"failed {ATTEMPTS} times on the workers: {type(error).__name__}: {error}")
        if isinstance(result, InputError):
            raise result
        return result


@contextmanager
def open_cluster(workers: int | None = None, scheduler: str | None = None) -> Iterator[Cluster | None]:
    """Open worker processes, as a context manager; None if neither argument is given.

    Args:
        workers: number of processes on this machine. They start at the first task and share the cores: a process uses
            its own cores only (on Linux). They have no limit of memory.
        scheduler: address of the scheduler of a Dask cluster, such as `tcp://host:8786`, or the scheduler file (.json).
            The connection is made at once.

    Raises:
        InputError: the extra `cluster` is missing, the number of workers is not above 0, no scheduler answers, or
            scheduler and workers have other versions of libraries.
    """
    if workers is None and scheduler is None:
        yield None
        return
    option = "--workers" if scheduler is None else "--scheduler"
    for package in ("dask", "distributed"):
        require_package(package, option)
    if workers is not None and workers < 1:
        raise InputError(option, f"is {workers}", "give a number of at least 1")
    with ExitStack() as stack:
        if scheduler is None:
            yield Cluster(cache(lambda: stack.enter_context(_local_client(workers or 1))), "workers")
        else:
            client = stack.enter_context(_remote_client(scheduler))
            yield Cluster(lambda: client, scheduler)


@contextmanager
def _local_client(workers: int) -> Iterator[Any]:
    """Start worker processes on this machine."""
    import jax
    from dask import config
    from distributed import Client, LocalCluster

    from jaxfit.foundation.worker_cores import WorkerCores

    settings = {
        "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
        "distributed.scheduler.worker-saturation": 1.0,  # a worker that ends costs the task that it computes only
        "distributed.comm.timeouts.connect": "60s",  # a busy machine starts processes slowly
    }
    cached = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
    options: dict[str, Any] = {
        "n_workers": workers,
        "threads_per_worker": 1,
        "memory_limit": 0,
        "host": "127.0.0.1",
        "dashboard_address": "127.0.0.1:0",
        "env": {name.upper(): str(value) for name in cached if (value := getattr(jax.config, name)) is not None},
        "silence_logs": logging.ERROR,
    }
    with ExitStack() as stack, config.set(settings):
        try:
            cluster = stack.enter_context(LocalCluster(**options))
            client: Any = stack.enter_context(Client(cluster, set_as_default=False))
            client.register_plugin(WorkerCores(workers))
        except (OSError, RuntimeError) as error:
            problem = f"the worker processes do not start: {error.__cause__ or error}"
            raise InputError(
                f"--workers {workers}", problem, "repeat the command with -v for messages of Dask"
            ) from error
        yield client


@contextmanager
def _remote_client(scheduler: str) -> Iterator[Any]:
    """Connect to a scheduler, and check the versions of its workers."""
    from distributed import Client

    named = f"--scheduler {scheduler}"
    address = scheduler
    if scheduler.endswith(".json"):
        content = read_json_file(scheduler)
        address = str(content.get("address")) if isinstance(content, dict) else ""
    try:
        with ThreadPoolExecutor(1) as thread:  # a notebook's thread already runs an event loop
            thread.submit(asyncio.run, _handshake(address)).result()
        client: Any = Client(address, timeout=CONNECT_S, set_as_default=False)
    except Exception as error:  # a server of another kind may answer with anything
        reason = str(error).partition("\n")[0] or f"no answer within {CONNECT_S} s"
        remedy = "start `dask scheduler`, and give the address that it prints"
        raise InputError(named, f"is not a scheduler: {reason}", remedy) from None
    with client:
        own, known = _versions(), client.get_versions(check=False)["scheduler"]["packages"]
        _check_versions(named, own | {name: known[name] for name in ("dask", "distributed")}, own)
        found: Any = client.run(_versions, on_error="return")
        for worker, versions in found.items():
            _check_versions(f"worker {worker}", versions, own)
        if not found:
            _logger.warning("%s: the cluster has no workers yet; the command waits for workers", named)
        yield client


async def _handshake(address: str) -> None:
    """Connect to a scheduler and disconnect. Without a limit, `Client` waits for ever if the other side is silent."""
    from distributed import Security
    from distributed.comm.core import connect

    arguments = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=CONNECT_S, **arguments), CONNECT_S)
    await comm.close()


def _received(shared: Any) -> Any:
    return shared


def _run(function: Callable[[Any, Any], Any], shared: Any, task: Any, versions: dict[str, str]) -> Any:
    """Compute a task in a worker. An InputError is returned, because Dask repeats tasks that raise errors."""
    from distributed import get_worker

    try:
        _check_versions(f"worker {get_worker().address}", _versions(), versions)
        with _one_task:
            return function(shared, task)
    except InputError as error:
        return error


def _versions() -> dict[str, str]:
    """Return the versions that must agree between the processes."""
    from jaxfit.raster.kernels import ISA_VARIABLE, isa_problem, kernels_available

    problem = isa_problem()
    if problem is not None:
        raise InputError(f"environment variable {ISA_VARIABLE}", *problem)
    return library_versions(_CHECKED) | {"compiled kernels": "yes" if kernels_available() else "no"}


def _check_versions(process: str, found: Any, expected: dict[str, str]) -> None:
    """Raise InputError if a process has other versions. An exception instead of versions: jaxfit is missing."""
    remedy = "install the same packages there and here"
    if not isinstance(found, dict):
        raise InputError(process, f"cannot use jaxfit: {type(found).__name__}: {found}", remedy)
    other = [
        f"{name} {found.get(name)} instead of {value}" for name, value in expected.items() if found.get(name) != value
    ]
    if other:
        raise InputError(process, f"has {', '.join(other)}", remedy)
