"""YAML text: plain values as PyYAML reads them, and one line with file and line for what is not accepted."""

import time

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support.hostile import Isolated, many_examples
from support.mutations import damaged_bytes, damaged_tree

from jaxfit.config.yaml_file import _shipped_folder, line_of, read_yaml, rounded, shipped_configs
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import CONFIG_LEVELS

NINE = ", ".join(f"k{i}: 1" for i in range(9))
ANCHORS = f"a0: &a0 {{{NINE}}}\n" + "".join(
    f"a{j}: &a{j} {{{', '.join(f'k{i}: *a{j - 1}' for i in range(9))}}}\n" for j in range(1, 10)
)
MERGES = f"a0: &a0 {{{NINE}}}\n" + "".join(
    f"a{j}: &a{j} {{<<: [{', '.join([f'*a{j - 1}'] * 9)}]}}\n" for j in range(1, 10)
)
DEEPEST = "a: " + "[" * (CONFIG_LEVELS - 1) + "]" * (CONFIG_LEVELS - 1)


def test_shipped_files_are_read_as_by_pyyaml():
    for name in shipped_configs():
        text = (_shipped_folder() / f"{name}.yaml").read_text()
        assert read_yaml(text, name).values == yaml.safe_load(text)


def test_values_are_those_of_pyyaml():
    for text in [
        "a: 1:30\nb: 1e5\nc: 1.0e+2\nd: yes\ne: ~\nf: '1'\ng: .inf\nh: 0x1F\ni: 017\nj: -1_000\nk: Off\nl: .5\nm:",
        "a: |\n  x\n  y\nb: >-\n  x\n  y\nc: 'it''s'\nd: \"tab\\t\"\n? e\n: []\n",
        "a: &x {k: 1, l: [1, {m: 2}]}\nb: {<<: *x, k: 3}\nc: {n: 0, <<: [{k: 4}, *x]}\nd: [*x, *x]\n&e f: *x\n",
        "{a: {}, b: [], 'on': 1, '1': 2}",
        DEEPEST,
    ]:
        values, expected = read_yaml(text, "x").values, yaml.safe_load(text)
        assert values == expected
        assert yaml.safe_dump(values, sort_keys=False).count("&") == 0  # no list or mapping is shared
        assert str(values) == str(expected)  # the same order and types


def test_dates_are_text():
    assert read_yaml("a: 2021-99-99\nb: 2021-01-01", "x").values == {"a": "2021-99-99", "b": "2021-01-01"}


def test_lines():
    text = "base: x\nstages:\n- name: a\n  steps: 2\n- {name: b,\n   steps: 1}\nterms: {m:f.g: 1}\n"
    lines = read_yaml(text, "x").lines
    paths = {"stages": 2, "stages[0].steps": 4, "stages[1].steps": 6, "stages[1].absent": 5, "terms.m:f.g.weight": 7}
    assert {path: line_of(lines, path) for path in paths} == paths
    assert line_of(lines, "absent") is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: !!int foo", "line 1 holds the tag `!!int`"),
        ("\na: !!python/object/apply:os.getcwd []", "line 2 holds the tag"),
        ("a: !own {}", "holds the tag `!own`"),
        ("a: " + "9" * 5000, "a number of 5000 digits"),
        ("a: 99999999999999999999", "exceeds 64 bits"),
        ("a: 0x_", "'0x_', which is no number"),
        ("a: " + "[" * 2000 + "]" * 2000, "more than 50 levels"),
        (DEEPEST.replace("[]", "[[]]"), "more than 50 levels"),
        ("{a: " * 200_000, "more than 50 levels"),
        ("- " * 200_000, "more than 50 levels"),
        ("a: &a [x]\n" + "".join(f"b{i}: &a [*a]\n" for i in range(60)), "line 50 is nested more than 50"),
        ("a: 1\n{on: 1}", "line 3 is not valid YAML"),
        ("x: 1\non: 1", "line 2 holds a key that is true or false, not text.*quotes"),
        ("1: 1", "a key that is a number"),
        ("? [a]\n: 1", "a key that is a list"),
        ("&a ~: 1", "a key that is null"),
        ("a: &b {}\n*b : 1", "line 2 holds a key that is a mapping"),
        ("a: 1\nb: 2\na: 3", "line 3 holds the key `a`, which line 1 holds too"),
        ("x" * 1001 + ": 1", "a key of 1001 characters"),
        ("a: 'x\x00'", r"line 1 holds the character U\+0000"),
        ('b: 1\na: "\\0"', r"line 2 holds the character U\+0000"),
        ("a: '\x1b[31m'", r"U\+001B"),
        ("a: '\ud800'", r"U\+D800"),
        ("a: &a [*a]", r"`\*a`, which no earlier value defines"),
        ("a: *b", "no earlier value"),
        ("a: {<<: 3}", "`<<` a value that is not a mapping"),
        ("a: 1\n---\nb: 2", "line 2 begins a second document"),
        ("a: [1,\n", "line 2 is not valid YAML"),
        ("%YAML 3.0\n---\na: 1", "not valid YAML"),
        (ANCHORS, "line 5 is value number 100,001"),
        (MERGES, "line 5 is value number 100,001"),
        ("- a", "no mapping"),
        ("", "no mapping"),
        ("3", "no mapping"),
    ],
    ids=lambda value: value[:20],
)
def test_what_is_not_accepted(text, words):
    began = time.process_time()
    with pytest.raises(InputError, match=words) as caught:
        read_yaml(text, "mine.yaml")
    assert str(caught.value).startswith("mine.yaml: ")
    assert time.process_time() - began < 5


FIT = """\
base: paper
crop: &crop {mode: image, size_px: 64}
terms: {keypoints: {weight: 6.25, sigma_px: 20}, pose_prior: 0.1, velocity: 0.1, mask: 1}
stages:
  - {name: a, steps: 5, terms: [keypoints, pose_prior, velocity], step_scale: {transl: [1, 1, 0]}}
  - name: b
    steps: 2
    terms: [mask]
    override: {mask: {weight: 2}}
    keypoints_off: ["bill_tip"]
initialise: {method: so3, turns: 24}
memory_gb: 1.5
"""
RECONSTRUCT = """\
base: reconstruct
fit: {base: baseline, terms: {<<: &terms {velocity: 3}, mask: 1}}
track: {segmenter: {tile_px: 864, classes: [bird]}, frames: {start: 2, stop: 9}, min_track_frames: 25}
overlay: {side_views: false, max_width_px: null}
"""
GRID = """\
config: paper
crosses:
  - set: {window: 1}
    cross: {filter_window: [5, 1], terms.velocity: [0, 1.0e+2]}
  - cross: {stages.mask.steps: [3, 4], terms.acceleration: [=terms.velocity], common_size: [true, false]}
claims:
  - {claim: it helps, better: {filter_window: 5}, worse: {filter_window: 1}, harmless: true}
"""


@pytest.fixture(scope="module")
def readers():
    # a valid grid of thousands of runs takes seconds
    with Isolated("support.hostile_configs:call", seconds=30) as call:
        yield call


@pytest.mark.parametrize(("reader", "valid"), [("fit", FIT), ("reconstruct", RECONSTRUCT), ("grid", GRID)])
def test_any_damage_is_one_error(tmp_path, readers, reader, valid):
    tree = yaml.safe_load(valid)
    # escapes, because UTF-8 cannot represent lone surrogates
    trees = damaged_tree(tree).map(lambda changed: yaml.dump(changed, allow_unicode=False).encode())
    path = tmp_path / "mine.yaml"
    path.write_text(valid)
    assert readers(reader, path).kind == "success"

    @many_examples
    @given(st.one_of(damaged_bytes(valid.encode()), trees))
    def check(content):
        path.write_bytes(content)
        outcome = readers(reader, path)
        assert outcome.acceptable, outcome

    check()


@pytest.mark.parametrize(
    ("value", "text"), [(0.00001234, "0.0000123"), (12.3456, "12.3"), (1, "1"), (123456, "123000")]
)
def test_numbers_have_three_digits_and_no_exponent(value, text):
    assert rounded(value) == text
    assert isinstance(yaml.safe_load(rounded(value)), int | float)
