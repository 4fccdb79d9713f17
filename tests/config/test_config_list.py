"""`jaxfit config list` prints the configs of fits as their files describe them."""

from jaxfit.cli.main import main
from jaxfit.config.fit import GROUPS, describe_fit_configs, shipped_fit_configs
from jaxfit.config.yaml_file import shipped_comment


def test_every_config_says_what_it_is_for():
    groups = {name: shipped_comment(name)["group"] for name in shipped_fit_configs()}
    published = {name for name, group in groups.items() if group == GROUPS[0]}
    assert published == {"paper", "baseline", "aves"}
    assert {name for name, group in groups.items() if group == GROUPS[1]} == {
        "fast",
        "few_labels",
        "map",
        "photo",
    }
    for config in describe_fit_configs():
        for text in (config.purpose, config.chosen_on):
            assert text.endswith(".")
            assert ". " not in text.replace("al. ", "")  # a single sentence
            assert "  " not in text


def test_the_command_prints_the_texts(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "600")
    assert main(["config", "list"]) == 0
    printed = capsys.readouterr().out
    for config in describe_fit_configs():
        line = next(line for line in printed.splitlines() if f" {config.name} " in line)
        assert config.purpose in line
        assert config.chosen_on in line
    assert all(group in printed for group in GROUPS)
