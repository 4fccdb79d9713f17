"""The documents: links lead to files, commands parse, configs and Python examples are valid, the README is short."""

import argparse
import ast
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import jaxfit
from jaxfit.cli.main import main
from jaxfit.objective import registry

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
MODEL_CARD = ROOT / "jaxfit" / "perception" / "networks" / "README.md"
DOCUMENTS = [README, MODEL_CARD, *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
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


@documents
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


def test_the_example_of_a_curvature_is_exact(monkeypatch):
    """E(θ + d) = E(θ) + g·d + ½ d·H·d, because the term of the example is quadratic."""
    text = (ROOT / "docs" / "terms.md").read_text(encoding="utf-8")
    (example,) = [block for _, block in BLOCK.findall(text) if "Curvature(" in block]
    names = {"__name__": "curvature_example"}
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))
    exec(example, names)
    frames, bones = 3, 5
    body_pose, change = np.random.default_rng(0).normal(size=(2, frames, bones, 3)).astype(np.float32)

    def window(body_pose):
        return SimpleNamespace(pose=SimpleNamespace(body_pose=body_pose), present=np.array([True, False, True]))

    def energy(body_pose):
        return names["small_angles"](window(body_pose))

    rows = np.pad(change.reshape(frames, -1), ((0, 0), (3, 4)))
    H = names["_curvature"](window(body_pose))
    quadratic = energy(body_pose) + np.sum(jax.grad(energy)(body_pose) * change) + 0.5 * np.sum(rows * H.product(rows))
    assert H.diagonal.shape == rows.shape == (frames, 3 * (bones + 1) + 4)
    assert np.isclose(energy(body_pose + change), quadratic, rtol=1e-5)
    np.testing.assert_array_equal(H.product(np.ones_like(rows)), H.diagonal)


def test_configs_are_valid(tmp_path):
    text = (ROOT / "docs" / "configs.md").read_text(encoding="utf-8")
    configs = [block for language, block in BLOCK.findall(text) if language == "yaml" and block.startswith("base:")]
    assert configs
    for config in configs:
        (tmp_path / "mine.yaml").write_text(config, encoding="utf-8")
        load = jaxfit.load_reconstruct_config if config.startswith("base: reconstruct") else jaxfit.load_config
        load(tmp_path / "mine.yaml")


def test_every_command_stands_in_the_readme(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    known = re.findall(r"^    (\w+) ", capsys.readouterr().out, re.MULTILINE)
    assert len(known) > 5
    text = README.read_text(encoding="utf-8")
    assert not [name for name in known if f"jaxfit {name}" not in text]


def test_the_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 150
