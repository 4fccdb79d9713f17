"""The extended tests of species compile as for users."""

import pytest


@pytest.fixture(autouse=True, scope="module")
def _as_for_users(request):
    if request.config.option.markexpr == "extended":
        request.getfixturevalue("optimised")
