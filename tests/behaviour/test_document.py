"""The documents of behaviour: the table of features is true, and the examples work."""

import re
import sys
from pathlib import Path

from support.described import flock, pair

from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.registry import find_feature, own_features
from jaxfit.behaviour.rules import load_behaviour_config

DOCUMENTS = Path(__file__).resolve().parents[2] / "docs"
FEATURES = (DOCUMENTS / "reference" / "features.md").read_text(encoding="utf-8")
RULES = (DOCUMENTS / "guide" / "behaviour.md").read_text(encoding="utf-8")


def test_the_table_states_the_definitions():
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*) \|$", FEATURES, re.MULTILINE)
    assert [(name, definition) for name, _, definition in rows] == [
        (each.name, each.definition) for each in own_features()
    ]
    shown = {"°": "deg", "°/s": "deg/s", "Hz": "Hz", "m or bl": "length", "m/s or bl/s": "length/s"}
    for (_, unit, _), feature in zip(rows, own_features(), strict=True):
        assert shown.get(unit) == (None if feature.unit in ("1", "id") else feature.unit)


def test_the_examples_work(tmp_path, monkeypatch):
    code = re.search(r"```python\n# my_features.py\n(.*?)```", FEATURES, re.DOTALL)[1]
    (tmp_path / "my_features.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    rules = re.search(r"```yaml\n# mine.yaml\n(.*?)```", RULES, re.DOTALL)[1]
    (tmp_path / "mine.yaml").write_text(rules, encoding="utf-8")
    config = load_behaviour_config(tmp_path / "mine.yaml")
    assert list(config.behaviours)[-1] == "looking_down"
    feature = find_feature("my_features:bill_height")
    values = describe(flock(pair()), [feature]).values["bill_height"]
    assert (values > 0).all()
    sys.modules.pop("my_features")
