"""JSON of results: plain types, and null for what is no finite number."""

import json
import math

import numpy as np
import pytest

from jaxfit.foundation.reading import json_text, json_values


def test_numpy_values_become_plain_and_nan_becomes_none():
    content = {
        "nan": math.nan,
        "rows": (1, [np.float32(0.5), -math.inf]),
        "array": np.array([[1.0, math.nan]]),
        3: np.int64(7),
        "flag": np.bool_(True),
        "none": None,
        "text": "a",
    }
    expected = {
        "nan": None,
        "rows": [1, [0.5, None]],
        "array": [[1.0, None]],
        "3": 7,
        "flag": True,
        "none": None,
        "text": "a",
    }
    assert json_values(content) == expected
    assert json.loads(json_text(content, indent=None)) == expected


def test_a_value_without_a_form_in_json():
    with pytest.raises(TypeError):
        json_text({"set": {1, 2}})
