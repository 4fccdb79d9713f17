"""Rules of behaviours: conditions, messages about wrong rules, the shipped rules, own rules in a file."""

import numpy as np
import pytest
from support.cli_files import rejected
from support.described import flock, pair, rules

from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.registry import own_features
from jaxfit.behaviour.rules import BehaviourConfig, BehaviourRule, Range, load_behaviour_config, read_range
from jaxfit.cli.main import main
from jaxfit.config.checks import ConfigKeyError
from jaxfit.foundation.errors import InputError

UP = {"body_pitch": "> 50"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("> 3", Range(3, np.inf)),
        (" <-0.5 ", Range(-np.inf, -0.5)),
        ("-3 to 3", Range(-3, 3)),
        ("+1.5 to 20", Range(1.5, 20)),
        ("3 to 3", None),
        ("3 to -3", None),
        ("= 3", None),
        ("3", None),
        ("> 3 m", None),
        ("> nan", None),
        ("> 1e3", Range(1000, np.inf)),
        ("< .5", Range(-np.inf, 0.5)),
        ("-1E-1 to 2.", Range(-0.1, 2)),
        ("> 1e999", None),
        ("> .", None),
        ("> 1e", None),
        ("", None),
    ],
)
def test_conditions(text, expected):
    assert read_range(text) == expected


def rule(**keys):
    return lambda: BehaviourRule(**({"definition": "The bird does this.", "begins": UP} | keys))


@pytest.mark.parametrize(
    ("build", "key", "words"),
    [
        (rule(definition="  "), "definition", "is empty"),
        (rule(begins={}), "", "has 0 of begins, start_of and end_of"),
        (rule(start_of="flight"), "", "has 2 of begins"),
        (rule(begins={}, lasts=UP, end_of="up"), "lasts", "without begins"),
        (rule(begins={"body_pitch": "50"}), "begins.body_pitch", "'50'"),
        (rule(lasts={"body_pitch": "9 to 1"}), "lasts.body_pitch", "'9 to 1'"),
        (rule(begins={"tallness": "> 1"}), "begins.tallness", "is not known"),
        (rule(begins={"no_module:tall": "> 1"}), "begins.no_module:tall", "cannot be imported"),
        (rule(least_s=-1), "least_s", "-1"),
        (rule(bridge_s=float("nan")), "bridge_s", "finite"),
        (lambda: BehaviourConfig({}), "behaviours", "has no rules"),
        (lambda: rules(**{"Big bird": {"begins": UP}}), "behaviours.Big bird", "is no name"),
        (lambda: rules(other={"begins": UP}), "behaviours.other", "is the name of frames"),
        (lambda: rules(off={"start_of": "flight"}), "behaviours.off.start_of", "'flight'"),
        (lambda: rules(a={"start_of": "b"}, b={"end_of": "a"}), "behaviours.a.start_of", "begins"),
    ],
)
def test_wrong_rules_are_named(build, key, words):
    with pytest.raises(ConfigKeyError) as caught:
        build()
    assert caught.value.key == key
    assert words in str(caught.value)


def test_the_shipped_rules():
    config = load_behaviour_config()
    assert set(config.features) <= set(own_features())
    assert list(config.behaviours)[-1] == "standing"
    names = {each.name for each in config.features}
    assert {"airborne", "wing_spread", "beat_amplitude", "gaze_elevation", "speed"} <= names
    for name, each in config.behaviours.items():
        assert each.definition.endswith("."), name


def test_own_rules_in_a_file(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text('base: behaviour\nbehaviours:\n  walking:\n    begins: {speed: "> 0.5"}\n')
    own, shipped = load_behaviour_config(path), load_behaviour_config()
    assert own.behaviours["walking"].begins["speed"] == "> 0.5"
    assert own.behaviours["walking"].lasts == shipped.behaviours["walking"].lasts
    assert list(own.behaviours) == list(shipped.behaviours)
    for text, words in [
        ('begins: {spead: "> 0.5"}', "behaviours.walking.begins.spead"),
        ('begins: {speed: "fast"}', "behaviours.walking.begins.speed"),
        ("begins: {speed: 0.5}", "behaviours.walking.begins.speed"),
        ("least_s: -2", "behaviours.walking.least_s"),
        ("shortest_s: 2", "behaviours.walking.shortest_s"),
    ]:
        path.write_text(f"base: behaviour\nbehaviours:\n  walking:\n    {text}\n")
        with pytest.raises(InputError, match=rf"own\.yaml.*`{words}`"):
            load_behaviour_config(path)


def own(tmp_path, text, name="own.yaml"):
    """Write a config and return its path."""
    (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path / name


def test_conditions_of_a_file_replace_those_of_the_base(tmp_path):
    text = 'base: behaviour\nbehaviours:\n  walking:\n    lasts: {speed: "> 0.1"}\n'
    found = load_behaviour_config(own(tmp_path, text)).behaviours["walking"]
    shipped = load_behaviour_config().behaviours["walking"]
    assert found.lasts == {"speed": "> 0.1"}  # without `airborne` of the base
    assert (found.begins, found.least_s, found.definition) == (shipped.begins, shipped.least_s, shipped.definition)


def test_null_removes_a_rule_of_the_base(tmp_path):
    shipped = load_behaviour_config()
    first = own(tmp_path, "base: behaviour\nbehaviours: {attack: null, bow: null}\n", "first.yaml")
    names = [name for name in shipped.behaviours if name not in ("attack", "bow")]
    assert list(load_behaviour_config(first).behaviours) == names
    again = 'base: first.yaml\nbehaviours: {bow: {definition: Bows., begins: {gaze_elevation: "< -60"}}}\n'
    second = load_behaviour_config(own(tmp_path, again))
    assert list(second.behaviours) == [*names, "bow"]
    assert second.behaviours["bow"].lasts is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "{atack: null}",
            "`behaviours.atack` is null, which removes it, but the base does not have it (did you mean attack",
        ),
        ("{flight: null}", "`behaviours.take_off.start_of` names 'flight', which is no behaviour with begins"),
        ("{walking: {start_of: flight}}", "`behaviours.walking` has 2 of begins, start_of and end_of"),
        ("{flight: {begins: {}, start_of: bow}}", "`behaviours.flight.lasts` is given without begins"),
        (
            '{bow: {begins: {"sys:nosuch": "> 1"}}}',
            "cannot be used: feature 'sys:nosuch': sys has no function 'nosuch'",
        ),
    ],
)
def test_errors_name_the_file_of_the_user(tmp_path, text, message):
    with pytest.raises(InputError) as caught:
        load_behaviour_config(own(tmp_path, f"base: behaviour\nbehaviours: {text}\n"))
    assert caught.value.source == str(tmp_path / "own.yaml")
    assert message in str(caught.value)


def test_a_rule_of_the_base_becomes_a_start(tmp_path):
    text = "base: behaviour\nbehaviours: {walking: {begins: {}, lasts: null, start_of: flight}}\n"
    assert load_behaviour_config(own(tmp_path, text)).behaviours["walking"].start_of == "flight"


def test_features_of_one_name_do_not_replace_each_other(tmp_path, monkeypatch):
    for module in ("first_birds", "second_birds"):
        (tmp_path / f"{module}.py").write_text("def depth(birds):\n    return birds.place[..., 1]\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    first, second = {"first_birds:depth": "> 1"}, {"second_birds:depth": "> 2"}
    with pytest.raises(ConfigKeyError, match="'depth', which is defined twice"):
        rules(up={"begins": first | second})
    with pytest.raises(ConfigKeyError, match="'speed', which is defined twice"):
        rules(up={"begins": {"speed": "> 1", "jaxfit.behaviour.motion:speed": "> 2"}})
    config = rules(up={"begins": first, "lasts": second})
    assert len(config.features) == 2
    with pytest.raises(InputError, match="feature 'depth': is defined twice"):
        describe(flock(pair()), config.features)


def test_the_command_shows_the_rules_of_a_file(tmp_path, capsys):
    path = own(tmp_path, "base: behaviour\nbehaviours: {attack: null, walking: {least_s: 0.7}}\n")
    assert main(["config", "show", str(path)]) == 0
    shown = own(tmp_path, capsys.readouterr().out, "shown.yaml")
    assert load_behaviour_config(shown) == load_behaviour_config(path)
    path.write_text("base: paper\n", encoding="utf-8")
    rejected(capsys, ["config", "show", str(path)], "holds no rules of behaviours")
    rejected(capsys, ["config", "show", "papre"], "is not a shipped config")
