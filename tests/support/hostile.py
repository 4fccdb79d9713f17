"""Run a reader on hostile files in forked children, with bounds on memory and time.

A server process imports the reader once and forks one child per file, so that a crash, a hang or gigabytes of memory
end one child and not the tests. The server does not start JAX's threads, so forks are safe.

    with Isolated("jaxfit.foundation.array_files:load_npz") as reader:
        outcome = reader(path, {})
        assert outcome.acceptable
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, settings

MEMORY_MB = 400
SECONDS = 5
EXAMPLES = int(os.environ.get("JAXFIT_EXAMPLES", "40"))

many_examples = settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
"""Settings of the property tests of readers. The variable JAXFIT_EXAMPLES changes the number of examples."""
fewer_examples = settings(many_examples, max_examples=max(EXAMPLES // 4, 1))
"""The same for readers that start JAX or import a model, which takes 0.1 s."""


@dataclass(frozen=True)
class Outcome:
    """The end of one call."""

    kind: str
    """`success`, `InputError`, the name of another exception, `signal N` or `timeout`."""
    message: str
    peak_mb: float
    """Largest resident memory beyond the memory at the start of the call."""
    seconds: float

    memory_mb: float
    """Bound on `peak_mb`."""

    @property
    def acceptable(self) -> bool:
        """Whether the call succeeded, or raised an InputError with one short line, within the bound on memory."""
        one_line = self.message.isprintable() and len(self.message) <= 292
        return self.peak_mb <= self.memory_mb and (self.kind == "success" or (self.kind == "InputError" and one_line))


class Isolated:
    """Calls one function, `module:name`, in forked children; use as a context manager."""

    def __init__(self, function: str, memory_mb: float = MEMORY_MB, seconds: float = SECONDS):
        self.function, self.memory_mb, self.seconds = function, memory_mb, seconds

    def __enter__(self) -> Isolated:
        tests = Path(__file__).resolve().parents[1]
        paths = [str(tests), str(tests.parent), os.environ.get("PYTHONPATH", "")]
        # one thread per library, because a fork copies only the calling thread
        threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
        environment = os.environ | threads | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
        command = [sys.executable, "-m", "support.hostile", self.function, str(self.memory_mb), str(self.seconds)]
        self._server = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stdin.close()
        self._server.wait()
        self._server.stdout.close()

    def __call__(self, *arguments: Any) -> Outcome:
        """Call the function with arguments that JSON can represent; paths become text."""
        self._server.stdin.write(json.dumps(arguments, default=os.fsdecode) + "\n")
        self._server.stdin.flush()
        return Outcome(**json.loads(self._server.stdout.readline()), memory_mb=self.memory_mb)


def _serve(name: str, memory_mb: float, seconds: float) -> None:
    module, _, attribute = name.partition(":")
    function = getattr(import_module(module), attribute)
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the reader's own output must not mix with the outcomes
    for line in sys.stdin:
        print(json.dumps(_in_child(function, json.loads(line), memory_mb, seconds)), file=output, flush=True)


def _in_child(function: Any, arguments: list, memory_mb: float, seconds: float) -> dict[str, Any]:
    began, (reading, writing) = time.monotonic(), os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        os.write(writing, f"{_resident_bytes()}\n".encode())
        _limit(memory_mb, seconds)
        try:
            function(*arguments)
            kind, message = "success", ""
        except BaseException as error:
            kind, message = type(error).__name__, str(error)
        os.write(writing, json.dumps({"kind": kind, "message": message[:4000]}).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as file:
        own, answer = int(file.readline()), file.read()
    _, status, usage = os.wait4(child, 0)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        kind = "timeout" if number in (signal.SIGALRM, signal.SIGXCPU) else f"signal {number}"
        answer = json.dumps({"kind": kind, "message": ""}).encode()
    peak_mb = max(usage.ru_maxrss * 1024 - own, 0) / 1e6
    return json.loads(answer) | {"peak_mb": peak_mb, "seconds": time.monotonic() - began}


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _limit(memory_mb: float, seconds: float) -> None:
    """Bound the memory beyond that of the server, and the time of this process."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    # above the bound, so that a reader that catches MemoryError does not pass
    resource.setrlimit(resource.RLIMIT_AS, (now + int(8 * memory_mb * 1e6), resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    _serve(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]))
