"""Shared fixtures (reference data, a private cache, input files of the command line), and the rule about skips."""

import os
import re
from pathlib import Path

import jax
import pytest
from support.cli_files import write_inputs

DEFAULT_REFERENCE = Path(__file__).resolve().parents[1] / ".." / "shared"

ACCEPTED_SKIPS = (
    r"no \w+ kernels here",  # the processor lacks this instruction set
    "no Chromium is installed",  # the report is plain HTML, which the other tests parse
    "trackers",  # tests/packaging runs these tests in an environment of their own
    "mounting a small disk is not allowed here",  # needs the rights of root
)
"""Reasons of the skips that do not fail a run with JAXFIT_FAIL_ON_SKIP=1, which is how the gate runs the tests."""


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
def _programs_of_one_module():
    """Free the compiled programs after each module, because the number of memory maps of a process is limited."""
    yield
    jax.clear_caches()


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """Give the test a private cache of compiled programs instead of the user's cache."""
    before = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield
    jax.config.update("jax_compilation_cache_dir", before[0])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before[1])


@pytest.fixture
def distant_birds(monkeypatch):
    """Let a fit accept birds at any distance, whose objective overflows."""
    monkeypatch.setattr("jaxfit.fitting.distant.DISTANCE_IMAGE_SIDES", 1e35)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder of input files for the command line."""
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder
