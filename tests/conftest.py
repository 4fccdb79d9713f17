"""Shared fixtures (reference data, compiled programs, input files of the command line), and the rule about skips."""

import os
import re
import tempfile
from pathlib import Path

if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # the first process of a run; its workers and commands inherit these
    _cache = tempfile.TemporaryDirectory(prefix="jaxfit-tests-")
    os.environ |= {
        "XDG_CACHE_HOME": _cache.name,  # never the user's cache
        "XDG_DATA_HOME": _cache.name,  # never the user's networks
        "JAX_COMPILATION_CACHE_DIR": f"{_cache.name}/jaxfit",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }

import jax  # JAX reads these variables when it is imported
import pytest
from support.cli_files import write_inputs
from support.unchanged import REASON as UNCHANGED

DEFAULT_REFERENCE = Path(__file__).resolve().parents[1] / ".." / "shared"

MAX_MAPS = 8000
"""Linux allows 65530 memory maps per process by default. With 20,000 maps, a process of the tests takes 4 GB."""

ACCEPTED_SKIPS = (
    r"no \w+ kernels here",  # the processor lacks this instruction set
    "npm cannot install TypeScript here",  # needs a registry of packages, which no user needs
    "trackers",  # tests/packaging runs these tests in an environment of their own
    UNCHANGED,  # `make release` runs all notebooks and the first hour
    "mounting a small disk is not allowed here",  # needs the rights of root
)
"""Reasons of the skips that do not fail a run with JAXFIT_FAIL_ON_SKIP=1, which is how the gate runs the tests."""


def pytest_ignore_collect(collection_path, config):
    """Skip files without extended tests if only these run: the import of all files takes half a minute."""
    if config.option.markexpr == "extended" and collection_path.match("test_*.py"):
        return True if "mark.extended" not in collection_path.read_text() else None
    return None


def pytest_sessionfinish(session):
    """Fail a run with JAXFIT_FAIL_ON_SKIP if tests were skipped for other than accepted reasons."""
    terminal = session.config.pluginmanager.get_plugin("terminalreporter")
    if not os.environ.get("JAXFIT_FAIL_ON_SKIP") or terminal is None or hasattr(session.config, "workerinput"):
        return
    reasons = [report.longrepr[2] for report in terminal.stats.get("skipped", [])]
    wrong = {reason for reason in reasons if not any(re.search(accepted, reason) for accepted in ACCEPTED_SKIPS)}
    if wrong:
        terminal.ensure_newline()
        terminal.write_line(f"JAXFIT_FAIL_ON_SKIP: tests were skipped for other than accepted reasons: {wrong}")
        if session.exitstatus == 0:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session")
def reference_dir() -> Path:
    """The folder of the reference data. Without the data the test skips, or fails if JAXFIT_REFERENCE names it."""
    named = os.environ.get("JAXFIT_REFERENCE")
    folder = Path(named) if named else DEFAULT_REFERENCE
    if not (folder / "reference").is_dir():
        if named:  # a wrong name must not look like a passed run
            pytest.fail(f"JAXFIT_REFERENCE={named} holds no reference data")
        pytest.skip("no reference data: set JAXFIT_REFERENCE to its folder")
    return folder.resolve()


@pytest.fixture(autouse=True, scope="module")
def _few_memory_maps():
    """Free the compiled programs after a module if the process has many memory maps, whose number is limited."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > MAX_MAPS:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def _settings_of_the_cache():
    """Undo what a command changes: all tests of a run share one cache, which also stores small programs."""
    yield
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


@pytest.fixture(scope="module")
def optimised():
    """Optimise the programs, unlike most tests that the Makefile runs: for tests whose programs run long.

    JAX would use a program that it has compiled before with the other setting. Its results differ in the last digits.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    if before:
        jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
    if before:
        jax.clear_caches()


@pytest.fixture
def distant_birds(monkeypatch):
    """Let a fit accept birds at any distance, whose objective overflows."""
    monkeypatch.setattr("jaxfit.fitting.windows.MAX_DISTANCE_IMAGE_SIDES", 1e35)
    monkeypatch.setattr("jaxfit.data.observations.LARGEST_POSITION_PX", 1e35)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder of input files for the command line."""
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder
