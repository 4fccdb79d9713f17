"""The documents: links lead to files, commands parse and are complete, examples are valid, the README is short."""

import argparse
import ast
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import jaxfit
from jaxfit.cli.main import main
from jaxfit.cli.parser import COMMANDS
from jaxfit.objective import registry
from jaxfit.objective.residuals import residual_sum
from jaxfit.perception.trust import FootageSignals, Trust, judge

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
MODEL_CARD = ROOT / "jaxfit" / "perception" / "networks" / "README.md"
DOCUMENTS = [*sorted(ROOT.glob("*.md")), MODEL_CARD, *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
EVERYWHERE = [*DOCUMENTS, *sorted((ROOT / ".github").rglob("*.md"))]
documents = pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.relative_to(ROOT).as_posix())


class Parsed(BaseException):
    """The parser accepted a command."""


def anchors(path):
    """Return the anchors of a Markdown file's headings, as GitHub makes them."""
    text = BLOCK.sub("", path.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def commands(text):
    """Return the `jaxfit` commands of a document: lines of code blocks, and code in sentences that has options."""
    lines = [line for _, block in BLOCK.findall(text) for line in block.splitlines()]
    lines += re.findall(r"`(jaxfit [^`]* --[^`]+)`", BLOCK.sub("", text).replace("\n", " "))
    found = [re.fullmatch(r"(?:\w+=\S+ )?(jaxfit .+)", line) for line in lines]
    return [shlex.split(match[1], comments=True)[1:] for match in found if match]


@pytest.mark.parametrize("path", EVERYWHERE, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings(path):
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8"))
    broken = []
    for link in links:
        file, _, anchor = link.partition("#")
        target = (path.parent / file).resolve() if file else path
        if "://" not in link and (not target.exists() or (anchor and anchor not in anchors(target))):
            broken.append(link)
    assert not broken


@documents
def test_commands_parse(path, monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(*arguments, **options):
        parse(*arguments, **options)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
    for arguments in commands(path.read_text(encoding="utf-8")):
        with pytest.raises(Parsed):  # SystemExit where the parser rejects the command
            main(arguments)


@documents
def test_python_examples_import_what_exists(path):
    """Every import of a Python example succeeds, and `jaxfit` has every name that an example takes from it."""
    for language, block in BLOCK.findall(path.read_text(encoding="utf-8")):
        for node in ast.walk(ast.parse(block if language == "python" else "")):
            if isinstance(node, ast.Import | ast.ImportFrom):
                exec(ast.unparse(node), {})
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "jaxfit":
                assert hasattr(jaxfit, node.attr), f"jaxfit.{node.attr}"


def test_the_example_of_residuals_is_a_term(monkeypatch):
    text = (ROOT / "docs" / "developers" / "term.md").read_text(encoding="utf-8")
    (example,) = [block for _, block in BLOCK.findall(text) if "Residuals(" in block]
    names = {"__name__": "residuals_example"}
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))
    exec(example, names)
    body_pose = np.random.default_rng(0).normal(size=(3, 5, 3)).astype(np.float32)
    window = SimpleNamespace(
        pose=SimpleNamespace(body_pose=body_pose),
        present=np.array([True, False, True]),
        joint_indices=lambda name: (2,),
    )
    expected = abs(body_pose[0, 1, 0]) + abs(body_pose[2, 1, 0])
    assert residual_sum(names["level_head"](window)) == pytest.approx(expected)


def test_the_table_of_a_new_film_has_the_words_that_are_printed():
    """docs/your_film.md: what to do after each judgement of a film."""
    text = (ROOT / "docs" / "your_film.md").read_text(encoding="utf-8")
    rows = re.search(r"^\| the line says .*?\n\n", text, re.DOTALL | re.MULTILINE)[0].splitlines()[2:]
    bad = FootageSignals(0, 2, 0, 1, 1, 0, 1, 0, 9, 9)
    judgements = [judge(bad), Trust("high", (), bad), Trust("high", (), bad._replace(frame_distance=None))]
    printed = " ".join(each.sentence() for each in judgements)
    words = [word for row in rows if row for word in re.findall("`(.*?)`", row.split("|")[1])]
    assert len(words) == 8
    assert not [word for word in words if word not in printed]


def test_configs_are_valid(tmp_path):
    text = (ROOT / "docs" / "guide" / "configs.md").read_text(encoding="utf-8")
    configs = [block for language, block in BLOCK.findall(text) if language == "yaml" and block.startswith("base:")]
    assert configs
    for config in configs:
        (tmp_path / "mine.yaml").write_text(config, encoding="utf-8")
        load = jaxfit.load_reconstruct_config if config.startswith("base: reconstruct") else jaxfit.load_config
        load(tmp_path / "mine.yaml")


def test_every_command_stands_in_a_document():
    text = "".join(path.read_text(encoding="utf-8") for path in DOCUMENTS)
    assert not [name for group in COMMANDS.values() for name in group if f"jaxfit {name}" not in text]


def test_the_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 100
