"""A result with its film, for the tests of the viewer."""

import pytest
from support.viewed import shown, write_result


@pytest.fixture(scope="session")
def result(tmp_path_factory):
    """A result as the page shows it, and its film; no test changes them."""
    folder, video = write_result(tmp_path_factory.mktemp("viewed"))
    return shown(folder), video
