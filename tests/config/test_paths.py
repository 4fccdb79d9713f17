"""Access to config values by path: changed values, unchanged values and unknown paths."""

import dataclasses

import pytest

from jaxfit.config.build import get_value, with_values
from jaxfit.config.checks import ConfigKeyError
from jaxfit.config.fit import load_config

PAPER = load_config("paper")


def test_no_value_changes_nothing():
    assert with_values(PAPER, {}) == PAPER


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("window", 50, dataclasses.replace(PAPER, window=50)),
        ("crop.padding", 0.5, dataclasses.replace(PAPER, crop=dataclasses.replace(PAPER.crop, padding=0.5))),
        ("terms.velocity", 7, dataclasses.replace(PAPER, terms={**PAPER.terms, "velocity": 7})),
        # a new weight keeps the term's settings, and a new setting keeps the weight
        (
            "terms.keypoints",
            3,
            dataclasses.replace(PAPER, terms={**PAPER.terms, "keypoints": {"weight": 3, "sigma_px": 50}}),
        ),
        (
            "terms.velocity.beta_global",
            4.0,
            dataclasses.replace(PAPER, terms={**PAPER.terms, "velocity": {"weight": 100, "beta_global": 4.0}}),
        ),
        # a term without a weight in the config
        ("terms.bone_prior", 2, dataclasses.replace(PAPER, terms={**PAPER.terms, "bone_prior": 2})),
    ],
)
def test_one_value(path, value, expected):
    assert with_values(PAPER, {path: value}) == expected


@pytest.mark.parametrize("path", ["stages.mask.steps", "stages[1].steps", "stages.1.steps"])
def test_a_stage_by_name_or_number(path):
    changed = with_values(PAPER, {path: 9})
    assert [stage.steps for stage in changed.stages] == [600, 9]
    assert get_value(changed, path) == 9


def test_a_reference_to_another_value_does_not_depend_on_the_order():
    for order in (1, -1):
        values = dict([("terms.acceleration", "=terms.velocity"), ("terms.velocity", 5)][::order])
        changed = with_values(PAPER, values)
        assert (changed.terms["velocity"], changed.terms["acceleration"]) == (5, 5)


def test_a_reference_to_a_reference_has_the_new_value():
    chain = {"terms.acceleration": "=terms.velocity", "terms.velocity": "=terms.pose_prior", "terms.pose_prior": 5}
    for order in (1, -1):
        terms = with_values(PAPER, dict(list(chain.items())[::order])).terms
        assert (terms["acceleration"], terms["velocity"], terms["pose_prior"]) == (5, 5, 5)
    with pytest.raises(ConfigKeyError, match="refers to itself"):
        with_values(PAPER, chain | {"terms.pose_prior": "=terms.acceleration"})


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(
    "chain",
    [
        {"window": "=stages[0].steps", "stages.keypoints.steps": "=stages.1.steps", "stages.mask.steps": 40},
        {"terms.velocity": "=terms.keypoints.weight", "terms.keypoints": "=terms.mask", "terms.mask": 40},
        {"terms.velocity": "=terms.mask", "terms.mask.weight": "=stages.mask.steps", "stages[1].steps": 40},
    ],
)
def test_a_reference_to_a_reference_in_another_spelling(chain, order):
    changed = with_values(PAPER, dict(list(chain.items())[::order]))
    assert {get_value(changed, path) for path in chain} == {40}


def test_a_reference_to_itself_in_another_spelling():
    with pytest.raises(ConfigKeyError, match=r"`stages\[0\].steps` refers to itself"):
        with_values(PAPER, {"stages[0].steps": "=stages.keypoints.steps"})


def test_a_name_of_two_stages():
    twice = dataclasses.replace(PAPER, stages=(PAPER.stages[0], PAPER.stages[0]))
    with pytest.raises(ConfigKeyError, match=r"`stages.keypoints.steps` names 2 stages \(name a stage by its number"):
        with_values(twice, {"stages.keypoints.steps": 3})
    assert with_values(twice, {"stages[1].steps": 3}).stages[1].steps == 3


def test_the_value_of_a_term_is_its_weight():
    assert get_value(PAPER, "terms.keypoints") == 1
    assert get_value(PAPER, "terms.keypoints.sigma_px") == 50
    assert get_value(PAPER, "common_size") is True


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"windw": 1}, ("windw", "window")),
        ({"window.frames": 1}, ("window.frames",)),
        ({"stages.msk.steps": 1}, ("msk", "did you mean mask", "keypoints")),
        ({"stages.².steps": 1}, ("'²'",)),
        ({f"stages.{'9' * 5000}.steps": 1}, ("99999",)),
        ({"terms.mask": 10**400}, ("expected a number",)),
        ({"crop.mode": []}, ("crop.mode", "is []")),
        ({"window": "=no.such"}, ("no.such",)),
        ({"window": "=terms.no_such"}, ("terms.no_such", "not set")),
        ({"window": 0}, ("window", "above 0")),
        ({"terms.no_such": 1}, ("no_such",)),
    ],
)
def test_unknown_paths_and_values(values, words):
    with pytest.raises(ConfigKeyError) as caught:
        with_values(PAPER, values)
    for word in words:
        assert word in str(caught.value)
