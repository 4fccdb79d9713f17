"""Run a command: exit codes, signals and the cache of compiled programs."""

from __future__ import annotations

import gc
import io
import logging
import os
import signal
import sys
import warnings
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from jaxfit.cli.parser import build_parser
from jaxfit.foundation.errors import MAX_MESSAGE_CHARACTERS, InputError, one_line, shortened

STOPPED = 130
"""Exit code of an interrupted command."""


def run() -> NoReturn:
    """Run `main` on the arguments of the terminal and end the process: the installed command."""
    gc.disable()  # until the modules are loaded, which live on: collections would visit them again and again
    _prepare_streams(verbose=bool({"-v", "--verbose"} & set(sys.argv)))
    # NumPy's products here are small: with several threads, most of their time is spent waiting for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    received: list[int] = []

    def interrupt(number: int, _frame: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    def interrupt_again(lost: sys.UnraisableHookArgs) -> None:
        """Send the interrupt again if a callback of the garbage collector swallowed the first interrupt."""
        if not received or not issubclass(lost.exc_type, KeyboardInterrupt):
            sys.__unraisablehook__(lost)
            return
        signal.signal(signal.SIGALRM, interrupt)
        signal.setitimer(signal.ITIMER_REAL, 0.05)

    sys.unraisablehook = interrupt_again
    for number in (signal.SIGINT, signal.SIGTERM):  # a batch system's SIGTERM cleans up as Ctrl-C does
        if signal.getsignal(number) is not signal.SIG_IGN:  # shells ignore signals for background jobs
            signal.signal(number, interrupt)
    try:
        code = main()
    except Exception:
        if not received:
            raise
        code = _stopped()  # compiled code replaced the interrupt by an error of its own
    if code == STOPPED:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):  # the reader of the output may have closed the pipe
                stream.flush()
        # XLA's threads still run, and they crash if the interpreter shuts down in the usual way
        os._exit(code)
    sys.exit(code)


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return the exit code: 0 success, 2 unusable input, 130 interrupted by Ctrl-C.

    Args:
        arguments: the command's arguments; None takes the arguments of the process.
    """
    if (sys.argv[1:] if arguments is None else arguments)[:1] == ["bench"]:
        return _rejected(InputError("bench", "was removed", "in a checkout of jaxfit, `make bench` measures the speed"))
    try:
        options = build_parser().parse_args(arguments)
        _prepare_logging(options.verbose)
        use_cache()
        module, command = options.run.split(".")
        if command != "doctor":  # which reports the variable
            _check_isa()
        # imported here, so that help and wrong arguments do not wait for the imports of commands
        run_command = getattr(import_module(f"jaxfit.cli.{module}"), command)
        if not gc.isenabled():
            gc.freeze()
            gc.enable()
        run_command(options)
    except InputError as error:
        return _rejected(error)
    except KeyboardInterrupt:
        return _stopped()
    except BrokenPipeError:  # the reader of the output closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a path that no earlier check rejects, such as a name that is too long
        if error.filename is None:
            raise
        return _rejected(InputError(os.fsdecode(error.filename), error.strerror or str(error), "check the path"))
    return 0


READERS = "jaxfit.data.formats.recognise"
"""Logger of the readers of observations: one line for each file, also without `--verbose`."""


class OneLine(logging.Formatter):
    """Formats a record as one line of at most `MAX_MESSAGE_CHARACTERS`, since names may come from damaged files."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the prefix of the command and the message."""
        prefix = "jaxfit: "
        return prefix + shortened(one_line(record.getMessage()), MAX_MESSAGE_CHARACTERS - len(prefix))


def _prepare_logging(verbose: bool) -> None:
    """Log warnings of jaxfit on stderr, and what its readers read; further messages only if `verbose`."""
    handler = logging.StreamHandler()
    handler.setFormatter(OneLine())
    if not verbose:
        handler.addFilter(logging.Filter("jaxfit"))
        handler.addFilter(lambda record: record.levelno >= logging.WARNING or record.name == READERS)
    logging.basicConfig(handlers=[handler], level=logging.INFO)


def _prepare_streams(verbose: bool) -> None:
    """Make every text printable, and discard what libraries print on stderr unless `verbose`.

    Compiled libraries (libpng, OpenCV, ONNX Runtime, XLA) write their warnings to the file descriptor of stderr.
    jaxfit reports the same problems itself, with the name of the file.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if verbose:
        logging.captureWarnings(True)
        return
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    if not isinstance(sys.stderr, io.TextIOWrapper):
        return
    descriptor, encoding = sys.stderr.fileno(), sys.stderr.encoding
    own = os.fdopen(os.dup(descriptor), "w", buffering=1, encoding=encoding, errors="backslashreplace")
    discarded = os.open(os.devnull, os.O_WRONLY)
    os.dup2(discarded, descriptor)
    os.close(discarded)
    sys.stderr = own


def _check_isa() -> None:
    """Reject a wrong `JAXFIT_KERNEL_ISA` at once: a reconstruction uses kernels only after minutes of tracking."""
    if not os.environ.get("JAXFIT_KERNEL_ISA"):
        return  # without the imports
    from jaxfit.raster.kernels import ISA_VARIABLE, isa_problem

    problem = isa_problem()
    if problem is not None:
        raise InputError(f"environment variable {ISA_VARIABLE}", *problem)


def _rejected(error: InputError) -> int:
    print(f"jaxfit: {error}", file=sys.stderr)  # noqa: T201
    return 2


def _stopped() -> int:
    print("jaxfit: stopped; no incomplete files are left", file=sys.stderr)  # noqa: T201
    return STOPPED


def use_cache() -> None:
    """Store compiled programs in the user's cache folder, for later runs."""
    import jax

    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def cache_folder() -> Path:
    """Return the user's folder for compiled programs."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxfit"
