"""YAML 1.2: values and lines of a text, and one line with file and line for a text that is not accepted."""

import time

import pytest

from jaxfit.config.yaml_file import read_yaml, rounded


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", 10),  # 8 in YAML 1.1
        ("1:30", "1:30"),  # 90 in YAML 1.1
        ("1e1", 10.0),  # text in YAML 1.1
        ("1.0e-05", 1e-5),
        ("yes", "yes"),  # true in YAML 1.1
        ("True", True),
        ("~", None),
        ("", None),
        ("2021-99-99", "2021-99-99"),
        ("0x1F", 31),
        ("'1'", "1"),
        ("=terms.velocity", "=terms.velocity"),
        ("{<<: [{k: 4, l: 5}, {k: 6, m: 7}], l: 8}", {"k": 4, "l": 8, "m": 7}),
        ("|\n  x\n  y\n", "x\ny\n"),
    ],
)
def test_values(text, value):
    found = read_yaml(f"a: {text}", "x").values["a"]
    assert found == value
    assert type(found) is type(value)


def test_aliases_are_copies():
    values = read_yaml("a: &x {k: [1]}\nb: *x\nc: {<<: *x, l: 2}\n", "x").values
    assert values == {"a": {"k": [1]}, "b": {"k": [1]}, "c": {"k": [1], "l": 2}}
    assert values["a"] is not values["b"]
    assert values["a"]["k"] is not values["c"]["k"]


def test_lines():
    text = "base: x\nstages:\n- name: a\n  steps: 2\n- {name: b,\n   steps: 1}\nterms: {m:f.g: 1}\n"
    lines = read_yaml(text, "x").lines
    paths = {"stages": 2, "stages[0].steps": 4, "stages[1]": 5, "stages[1].steps": 6, "terms.m:f.g": 7}
    assert {path: lines[path] for path in paths} == paths


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: !!int foo", 'line 1 holds "foo", which is no number'),
        ("\na: !!python/object/apply:os.getcwd []", "line 2 holds the tag"),
        ("a: !own {}", "line 1 holds the tag `!own`"),
        ("a: " + "9" * 5000, "which is no number"),
        ("a: 0x_", "which is no number"),
        ("a: " + "[" * 2000 + "]" * 2000, "is nested too deeply"),
        ("{a: " * 20_000, "is nested too deeply"),
        ("1: 1", "line 1 holds the key '1', which is not text"),
        ("x: 1\n? [a]\n: 1", "line 2 holds the key .*, which is not text"),
        ("a: 1\nb: 2\na: 3", "line 3 holds the key `a`, which line 1 holds too"),
        ("a: 3\nb: 'x\x00'", "line 2 is not valid YAML: unacceptable character #x0000: [a-z ]*$"),
        ("a: &a [*a]", "is nested too deeply"),
        ("a: *b", "line 1 is not valid YAML: found undefined alias"),
        ("a: {<<: 3}", "`<<` a value that is not a mapping"),
        ("a: 1\n---\nb: 2", "line 2 is not valid YAML: but found another document"),
        ("a: [1,\n", "is not valid YAML"),
        ("- a", "no mapping"),
        ("", "no mapping"),
        ("3", "no mapping"),
    ],
    ids=lambda value: value[:20],
)
def test_what_is_not_accepted(text, words):
    began = time.process_time()
    with pytest.raises(ValueError, match=words) as caught:
        read_yaml(text, "mine.yaml")
    assert str(caught.value).startswith("mine.yaml: ")
    assert time.process_time() - began < 5


@pytest.mark.parametrize(
    ("value", "text"), [(0.00001234, "0.0000123"), (12.3456, "12.3"), (1, "1"), (123456, "123000")]
)
def test_numbers_have_three_digits_and_no_exponent(value, text):
    assert rounded(value) == text
    assert float(rounded(value)) == pytest.approx(value, rel=1e-2)
