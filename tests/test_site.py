"""The site of the documents: generated pages are complete, pages are short, measurements say their version."""

import argparse
import dataclasses
import importlib.util
import itertools
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import yaml

import jaxfit
from jaxfit.cli.parser import build_parser
from jaxfit.config.build import plain_config
from jaxfit.config.fit import describe_fit_configs
from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.objective.registry import known_terms

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = ROOT / "docs"
PAGES = sorted(DOCUMENTS.rglob("*.md"))
RESULTS = sorted((DOCUMENTS / "results").glob("*.md"))
MAX_LINES = 400
MEASURED = re.compile(r"^\*Measured with (\d+\.\d+\.\d+):\*")
HISTORY = re.compile("cannot be repeated|no longer shipped|by an earlier|with an earlier|an earlier program")
"""Words of a line of `MEASURED` whose tables show an earlier state on purpose."""
FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def site():
    """Return the module that writes the generated pages."""
    specification = importlib.util.spec_from_file_location("site_pages", ROOT / ".ci" / "site_pages.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def arguments(parser, path=("jaxfit",)):
    """Return command → its arguments, of a parser and of all parsers in it."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        return {" ".join(path): [action for action in parser.declared()._actions if action.dest != "help"]}
    return {
        name: actions
        for choice, command in inner[0].choices.items()
        for name, actions in arguments(command, (*path, choice)).items()
    }


def test_the_page_of_commands_has_every_command_and_argument(site):
    sections = dict(re.findall(r"^## (jaxfit .*?)\n(.*?)(?=^## |\Z)", site.commands(), re.DOTALL | re.MULTILINE))
    expected = arguments(build_parser())
    assert sections.keys() == expected.keys()
    assert len(expected) > 30
    for command, actions in expected.items():
        for action in actions:
            if action.help is not argparse.SUPPRESS:
                names = action.option_strings or [action.metavar or (action.choices or [action.dest])[0]]
                assert all(name.replace("|", "∣") in sections[command] for name in names), (command, names)
    assert "%(" not in site.commands()


def flat(plain, where=""):
    """Return the paths of all keys of plain values, without the names of terms."""
    if isinstance(plain, list):
        return {path for item in plain for path in flat(item, where + "[]")}
    if not isinstance(plain, dict) or re.search(r"terms$|override$|step_scale$|keypoint_offsets$", where):
        return {where} if where else set()
    return {path for key, item in plain.items() for path in {*flat(item, f"{where}.{key}".lstrip("."))}}


def test_the_page_of_keys_has_every_key(site):
    fit = re.search(r"## A fit\n(.*?)^## ", site.keys(), re.DOTALL | re.MULTILINE)[1]
    listed = re.findall(r"^\| `(.*?)` \|", fit, re.MULTILINE)
    keys = {re.sub(r"\[\](?!\.)", "", path) for path in flat(plain_config(jaxfit.load_config("paper")))}
    assert "stages[].solver" in keys
    assert "crop.size_px" in keys
    assert not keys - set(listed)
    keys = {key for key in flat(plain_config(load_reconstruct_config("reconstruct"))) if not key.startswith("fit.")}
    whole = site.keys().partition("## A reconstruction")[2]
    assert not [key for key in keys if "[]" not in key and f"| `{key}` |" not in whole]


def test_every_key_has_a_description(site):
    for kind, _ in site.CONFIGS.values():
        lacking = [path for path, _, _, text in site.config_keys(kind) if not text]
        assert not lacking
        assert dataclasses.is_dataclass(kind)


def test_the_page_of_configs_has_every_config(site):
    for config in describe_fit_configs():
        assert f"| {config.group} | `{config.name}` | {config.purpose[:20]}" in site.configs()


def test_the_page_of_python_has_every_public_name(site):
    named = set(re.findall(r"^::: \S+\.(\w+)$", site.api(), re.MULTILINE))
    assert named == set(jaxfit.__all__) - {"__version__"}


def test_messages_have_their_remedies(site):
    text = site.messages()
    assert "| needs two cameras | give the observations of at least two cameras |" in text
    assert "has an unknown layout: … | supported are …" in text
    raising = {
        path.relative_to(ROOT / "jaxfit").parts[0].removesuffix(".py")
        for path in (ROOT / "jaxfit").rglob("*.py")
        if "InputError(" in path.read_text(encoding="utf-8")
    }
    assert not raising - site.SUBJECTS.keys()


def test_every_term_has_a_section_an_equation_and_a_picture():
    text = (DOCUMENTS / "reference" / "terms.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^### (\w+)\n(.*?)(?=^#|\Z)", text, re.DOTALL | re.MULTILINE))
    assert sections.keys() == set(known_terms())
    for name, section in sections.items():
        assert f"../media/terms/{name}.svg" in section
        assert "```math" in section
        assert "Source: " in section
        assert (DOCUMENTS / "media" / "terms" / f"{name}.svg").exists()


def test_every_equation_converts(site):
    equations = [each for path in PAGES for each in re.findall(r"```math\n(.*?)```", path.read_text(), re.DOTALL)]
    assert len(equations) > 20
    for source in equations:
        html = site.equation(source, "math", "math", {}, None)
        assert html.count("<math") == 1
        assert "\\" not in html  # a command of LaTeX that was not understood


def navigation(entries):
    """Return the pages of a part of the navigation."""
    if isinstance(entries, str):
        return [entries]
    parts = entries.values() if isinstance(entries, dict) else entries
    return [page for part in parts for page in navigation(part)]


def test_the_navigation_has_every_page_once(site):
    listed = navigation(yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"])
    present = [path.relative_to(DOCUMENTS).as_posix() for path in PAGES]
    assert sorted(listed) == sorted([*present, *site.OUTSIDE.values()])


def test_every_term_has_a_drawing():
    assert {path.stem for path in (DOCUMENTS / "media" / "terms").glob("*.svg")} == set(known_terms())


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(DOCUMENTS).as_posix())
def test_pages_are_short(path, site):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MAX_LINES
    assert text.startswith("# ")
    assert set(site.MARKER.findall(text)) <= site.GENERATED.keys()


def test_links_out_of_the_documents_lead_to_pages_or_become_text(site):
    page = SimpleNamespace(file=SimpleNamespace(src_uri="guide/networks.md"), meta={})
    text = (
        "[card](../../jaxfit/perception/networks/README.md#training) [x.py](../../jaxfit/x.py) "
        "[trust](trust.md#flags) [other](https://example.org) ![murre](../media/murre.png)"
    )
    assert site.on_page_markdown(text, page, None, None) == (
        "[card](../reference/model_card.md#training) x.py "
        "[trust](trust.md#flags) [other](https://example.org) ![murre](../media/murre.png)"
    )
    page.file.src_uri = "reference/model_card.md"
    led = site.on_page_markdown("[pixels](../../../docs/results/simulated.md#from-pixels)", page, None, None)
    assert led == "[pixels](../results/simulated.md#from-pixels)"


def test_the_site_needs_no_network():
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "http" not in config
    plain = yaml.safe_load(config)
    assert plain["theme"]["font"] is False
    assert "offline" in plain["plugins"]
    assert all((DOCUMENTS / script).exists() for script in plain["extra"]["polyfills"])


class Measured(NamedTuple):
    """A table of a page of results."""

    heading: str
    first_row: str
    version: tuple[int, ...] | None
    """None without a line of `MEASURED`."""
    history: bool


def tables(text):
    """Return every table of a page of results."""
    heading, version, history = "", None, False
    lines = FENCE.sub("", text).splitlines()
    for i, line in enumerate(lines):
        if line.startswith("#"):
            level = len(line) - len(line.lstrip("#"))
            heading, version, history = line, version if level > 2 else None, history and level > 2
        elif match := MEASURED.match(line):
            version = tuple(map(int, match[1].split(".")))
            history = bool(HISTORY.search(" ".join(itertools.takewhile(str.strip, lines[i:]))))
        elif line.startswith("|") and lines[i + 1 : i + 2] and lines[i + 1].startswith("| --"):
            yield Measured(heading, line, version, history)


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_every_table_of_results_says_its_version_and_none_is_stale(path):
    present = tuple(map(int, own_version().split(".")))
    for table in tables(path.read_text(encoding="utf-8")):
        where = f"{path.name}, {table.heading}, {table.first_row}"
        assert table.version, f"{where}: add `*Measured with VERSION:* command`"
        assert table.version <= present, where
        is_recent = (table.version[0], table.version[1] + 1) >= present[:2]
        assert table.history or is_recent, f"{where}: measure again by its command, or say why it cannot be repeated"


def own_version():
    """Return the version of this checkout."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
