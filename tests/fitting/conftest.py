"""The extended tests of fits compile as for users."""

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def _as_for_users(request):
    if request.config.option.markexpr == "extended":
        request.getfixturevalue("optimised")


@pytest.fixture
def compilations(caplog):
    """Return a function that returns the messages about what the test has compiled, in all threads.

    `jax.log_compiles` is for one thread only.
    """
    jax.config.update("jax_log_compiles", True)
    yield lambda: [m for m in (r.getMessage() for r in caplog.records) if m.startswith("Compiling")]
    jax.config.update("jax_log_compiles", False)
