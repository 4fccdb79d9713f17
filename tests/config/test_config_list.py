"""docs/guide/configs.md lists the configs of fits as their files describe them, and so does `jaxfit config list`.

`python tests/config/test_config_list.py` rewrites the table of the document.
"""

from pathlib import Path

from jaxfit.cli.main import main
from jaxfit.config.fit import GROUPS, describe_fit_configs, shipped_fit_configs
from jaxfit.config.yaml_file import shipped_comment

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "guide" / "configs.md"
START = "<!-- the table below is written from the first comments of configs/*.yaml -->\n"
END = "<!-- end of the table -->\n"


def table():
    """Return the table of the document."""
    lines = ["| | config | for | chosen on |", "| --- | --- | --- | --- |"]
    lines += [f"| {c.group} | `{c.name}` | {c.purpose} | {c.chosen_on} |" for c in describe_fit_configs()]
    return "\n".join(lines) + "\n"


def document():
    """Return the parts of the document before, in and after the table."""
    before, _, rest = DOCUMENT.read_text(encoding="utf-8").partition(START)
    own, _, after = rest.partition(END)
    return before, own, after


def test_the_document_lists_the_configs():
    assert document()[1] == table(), "run this file as a script"


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


if __name__ == "__main__":
    before, _, after = document()
    DOCUMENT.write_text(before + START + table() + END + after, encoding="utf-8")
