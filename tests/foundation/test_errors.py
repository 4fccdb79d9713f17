"""Errors that pass between processes."""

import pickle

import pytest

from jaxfit.config.checks import ConfigKeyError
from jaxfit.foundation.errors import InputError
from jaxfit.pipeline import NoTrackError


@pytest.mark.parametrize(
    "error",
    [
        InputError("a.json", "is damaged", "write it again"),
        ConfigKeyError("stages[0].steps", "is 0", "expected a number above 0"),
        NoTrackError("film.mp4", "has no bird"),
    ],
)
def test_a_pickled_error_keeps_its_fields(error):
    error.tracking = ["a field of a subclass"]
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)
