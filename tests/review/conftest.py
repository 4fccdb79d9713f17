"""A result with its observations, for the tests of corrections."""

import pytest
from support.corrected import write


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """The folder of a result, which no test changes."""
    folder = tmp_path_factory.mktemp("tracks") / "result"
    write(folder)
    return folder
