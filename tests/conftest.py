"""Shared fixtures: where the reference data lies, and what the command line is tried on."""

import os
from pathlib import Path

import jax
import pytest
from support.cli_files import write_inputs

DEFAULT_REFERENCE = Path(__file__).resolve().parents[1] / ".." / "shared"


@pytest.fixture(scope="session")
def reference_dir() -> Path:
    """The folder of reference data; the test skips where there is none."""
    named = os.environ.get("JAXFIT_REFERENCE")
    folder = Path(named) if named else DEFAULT_REFERENCE
    if not (folder / "reference").is_dir():
        if named:  # whoever names a folder wants its tests run: a gate must not pass on skips
            pytest.fail(f"JAXFIT_REFERENCE={named} holds no reference data")
        pytest.skip("no reference data: set JAXFIT_REFERENCE to its folder")
    return folder.resolve()


@pytest.fixture(autouse=True, scope="module")
def _programs_of_one_module():
    """Compiled programs go when their module is done: a process may hold only so many pieces of memory."""
    yield
    jax.clear_caches()


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """The command keeps compiled programs in the user's cache: here in one of the test's own."""
    before = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield
    jax.config.update("jax_compilation_cache_dir", before[0])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before[1])


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder of files for the command line."""
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder
