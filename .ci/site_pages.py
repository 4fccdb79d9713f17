"""Pages of the site that come from the code, and the hooks of mkdocs that write them.

A document in docs/ holds a line such as `<!-- generated: commands -->`. `make docs` puts the text of the function of
that name in its place. A plain view of the repository shows the document without it.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import posixpath
import re
import shutil
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File
from pymdownx.slugs import slugify

from jaxfit.behaviour.rules import BehaviourConfig
from jaxfit.cli.arguments import Parser
from jaxfit.cli.parser import COMMANDS
from jaxfit.config.build import field_help
from jaxfit.config.fit import FitConfig, describe_fit_configs
from jaxfit.config.reconstruct import ReconstructConfig
from jaxfit.evaluation.ablation.grid import GridConfig

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "jaxfit"
OUTSIDE = {
    "jaxfit/perception/networks/README.md": "reference/model_card.md",
    "CHANGELOG.md": "developers/changelog.md",
}
"""Documents outside docs/ that are pages of the site, too."""
MARKER = re.compile(r"^<!-- generated: (\w+) -->$", re.MULTILINE)
NAMED = re.compile(r"docs/([\w/]+)\.md(#[\w-]+)?")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
CONFIGS = {
    "A fit": (FitConfig, "fit"),
    "A reconstruction": (ReconstructConfig, "reconstruct"),
    "Rules of behaviours": (BehaviourConfig, "behaviour"),
    "A grid of an ablation": (GridConfig, "ablate"),
}
SUBJECTS = {
    "cli": "Commands and their arguments",
    "config": "Configs",
    "data": "Keypoints, masks and results",
    "video": "Videos and pictures",
    "perception": "Networks and tracking",
    "cameras": "Cameras",
    "model": "Bird models",
    "objective": "Terms",
    "fitting": "Fits",
    "behaviour": "Behaviour",
    "evaluation": "Evaluation and ablations",
    "review": "Labels and corrections",
    "learning": "Training, species and priors",
    "export": "Exports",
    "view": "Overlays and reports",
    "viewer": "The viewer",
    "simulation": "Simulation",
    "foundation": "Files in general",
    "pipeline": "Reconstruction",
}
"""Package → heading of its messages."""
BOOSTS = {
    "index.md": 2,
    "guide": 2,
    "reference/metrics.md": 3,
    "reference/api.md": 0.5,
    "results": 0.5,
    "developers": 0.3,
}
"""Page or folder → factor on its rank in the search: instructions come before measurements."""


def _cell(text: object) -> str:
    """Return a text as a cell of a table. Code between backticks stays as it is, except for the bars."""
    parts = " ".join(str(text).split()).replace("|", "\\|").split("`")
    parts[::2] = [re.sub(r"([*_<\[])", r"\\\1", part) for part in parts[::2]]
    parts[::2] = [NAMED.sub(r"[\1](../\1.md\2)", part) for part in parts[::2]]
    return "`".join(parts)


def commands() -> str:
    """Return a section for every command, with all its arguments."""
    lines = []
    for name, command in (item for group in COMMANDS.values() for item in group.items()):
        parser = Parser(prog=f"jaxfit {name}")
        command.declare(parser)
        formatter = parser._get_formatter()
        lines += [f"## jaxfit {name}", "", command.text, "", "| argument | meaning |", "| --- | --- |"]
        for action in parser._actions:
            if action.help is argparse.SUPPRESS or action.dest == "help":
                continue
            value = formatter._format_args(action, formatter._get_default_metavar_for_optional(action))
            names = ", ".join(action.option_strings) or formatter._metavar_formatter(action, action.dest)(1)[0]
            shown = f"{names} {value}" if action.option_strings and value else names
            text = formatter._expand_help(action) if action.help else ""
            needed = " (required)" if action.required and action.option_strings else ""
            lines.append(f"| `{shown.replace('|', '∣')}` | {_cell(text)}{needed} |")
        lines.append("")
    return "\n".join(lines)


def _type_text(hint: Any) -> str:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is types.NoneType:
        return "null"
    if origin is typing.Literal:
        return ", ".join(f"`{value}`" for value in arguments)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(map(_type_text, arguments))
    if origin is tuple:
        inner = _type_text(arguments[0])
        return f"list of {inner}{'s' if inner in ('mapping', 'number') else ''}"
    if origin is Mapping:
        return f"mapping to {_type_text(arguments[1])}"
    if dataclasses.is_dataclass(hint):
        return "mapping"
    names = {str: "text", int: "whole number", float: "number", bool: "true or false", Any: "any value"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))


def _parts(hint: Any) -> Iterator[tuple[str, Any]]:
    """Return the config dataclasses in a type, each with what stands between the key and the keys of the dataclass."""
    origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        yield ".", hint
    between = {tuple: "[]", Mapping: ".NAME"}.get(origin, "")
    arguments = [argument for argument in typing.get_args(hint) if argument is not ...]
    for argument in arguments if origin is not typing.Literal else []:
        yield from ((between + rest, kind) for rest, kind in _parts(argument))


def config_keys(kind: Any, where: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Return path, type, default and description of every key of a config dataclass."""
    hints, texts = typing.get_type_hints(kind), field_help(kind)
    for field in dataclasses.fields(kind):
        if field.default_factory is not dataclasses.MISSING:
            default: Any = field.default_factory()
        else:
            default = field.default
        inner = list(_parts(hints[field.name]))
        path = where + field.name
        if not inner or texts.get(field.name):
            plain = default is dataclasses.MISSING or dataclasses.is_dataclass(default)
            shown = "" if plain else _default_text(default)
            yield path, _type_text(hints[field.name]), shown, texts.get(field.name, "")
        for between, part in inner:
            if part is not FitConfig:  # its keys have a table of their own
                yield from config_keys(part, path + between)


def _default_text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return f"`{ {None: 'null', True: 'true', False: 'false'}[value] }`"
    if isinstance(value, Mapping | tuple):
        return f"`[{', '.join(map(str, value))}]`" if isinstance(value, tuple) else "`{}`"
    return f"`{value}`"


def keys() -> str:
    """Return a table of the keys of every kind of config."""
    lines = []
    for title, (kind, option) in CONFIGS.items():
        lines += [f"## {title}", "", f"For `jaxfit {option}`." if option != "behaviour" else "For `jaxfit describe`."]
        lines += ["", "| key | value | default | meaning |", "| --- | --- | --- | --- |"]
        rows = config_keys(kind)
        lines += [f"| `{path}` | {_cell(kind)} | {default} | {_cell(text)} |" for path, kind, default, text in rows]
        lines.append("")
    return "\n".join(lines)


def public_names() -> dict[str, str]:
    """Return public name of the package → its module, from `jaxfit/__init__.pyi`."""
    body = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8")).body
    imports = [node for node in body if isinstance(node, ast.ImportFrom)]
    return {alias.name: f"jaxfit.{node.module}" for node in imports for alias in node.names}


def api() -> str:
    """Return a section for every public name, which mkdocstrings fills from the docstrings."""
    lines, names = [], {name: module for name, module in public_names().items() if name != "__version__"}
    for title, chosen in (("Functions", str.islower), ("Classes", lambda name: not name.islower())):
        lines += [f"## {title}", ""]
        lines += [f"::: {module}.{name}\n" for name, module in sorted(names.items()) if chosen(name)]
    return "\n".join(lines)


def _text_of(node: ast.expr | None, known: Mapping[str, ast.expr]) -> str:
    """Return a text as the source composes it; `…` stands for what depends on the input."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
    if isinstance(node, ast.Name) and node.id in known:
        return _text_of(known[node.id], {name: value for name, value in known.items() if name != node.id})
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text_of(node.left, known) + _text_of(node.right, known)
    if isinstance(node, ast.IfExp):
        return f"{_text_of(node.body, known)} / {_text_of(node.orelse, known)}"
    return "…" if node is not None else ""


def _assigned(body: ast.AST) -> dict[str, ast.expr]:
    known: dict[str, ast.expr] = {}
    for node in ast.walk(body):
        if not isinstance(node, ast.Assign) or len(node.targets) != 1:
            continue
        target, value = node.targets[0], node.value
        if isinstance(target, ast.Name):
            known.setdefault(target.id, value)
        elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for name, part in zip(target.elts, value.elts, strict=False):
                if isinstance(name, ast.Name):
                    known.setdefault(name.id, part)
    return known


def error_messages(path: Path) -> Iterator[tuple[str, str]]:
    """Return problem and remedy of every error that a module may raise for its input."""
    module = ast.parse(path.read_text(encoding="utf-8"))
    constants = _assigned(ast.Module([node for node in module.body if isinstance(node, ast.Assign)], []))
    for function in (node for node in ast.walk(module) if isinstance(node, ast.FunctionDef)):
        known = constants | _assigned(function)
        for node in ast.walk(function):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("InputError", "ConfigKeyError"):
                problem, remedy = ([*node.args[1:3], None, None])[:2]
                yield _text_of(problem, known), _text_of(remedy, known)


def messages() -> str:
    """Return the errors of every package, with their remedies; without the errors whose text is not in the source."""
    lines = []
    for package, title in SUBJECTS.items():
        folder = PACKAGE / package
        files = sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
        rows = dict.fromkeys(row for path in files for row in error_messages(path))
        rows = [(problem, remedy) for problem, remedy in rows if len(re.findall("[a-z]{2,}", problem)) > 2]
        lines += [f"## {title}", "", "| message | remedy |", "| --- | --- |"]
        lines += [
            f"| {_cell(problem)} | {_cell(remedy if re.search(r'[a-z]{3}', remedy) else '')} |"
            for problem, remedy in rows
        ]
        lines.append("")
    return "\n".join(lines)


def configs() -> str:
    """Return the table of the configs of fits, as `jaxfit config list` prints them."""
    lines = ["| | config | for | chosen on |", "| --- | --- | --- | --- |"]
    lines += [f"| {c.group} | `{c.name}` | {_cell(c.purpose)} | {_cell(c.chosen_on)} |" for c in describe_fit_configs()]
    return "\n".join(lines) + "\n"


GENERATED = {"commands": commands, "keys": keys, "api": api, "messages": messages, "configs": configs}


def equation(source: str, language: str, css_class: str, options: Any, markdown: Any, **others: Any) -> str:
    """Return an equation in LaTeX as MathML, which browsers draw without scripts or fonts of their own."""
    return f'<div class="equation">{convert(source.strip(), display="block")}</div>'


def on_config(config: Any) -> Any:
    """Let blocks of `math` become equations, and headings get the anchors of a Git host."""
    fence = {"name": "math", "class": "math", "format": equation}
    config.mdx_configs["pymdownx.superfences"] = {"custom_fences": [fence]}
    config.mdx_configs["toc"]["slugify"] = slugify(case="lower")
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the documents outside docs/ to the site."""
    for source, page in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Write the generated parts of a page, and lead its links to pages of the site.

    A link to a file that is no page, such as a module, becomes its text.
    """
    uri = page.file.src_uri
    page.meta["search"] = {"boost": BOOSTS.get(uri, BOOSTS.get(posixpath.dirname(uri), 1))}
    sources = {page: source for source, page in OUTSIDE.items()}
    folder = posixpath.dirname(sources.get(uri, f"docs/{uri}"))

    def lead(match: re.Match[str]) -> str:
        image, text, link = match.groups()
        file, hash_sign, anchor = link.partition("#")
        if not file or "://" in link:
            return match[0]
        target = posixpath.normpath(posixpath.join(folder, file))
        target = f"docs/{OUTSIDE[target]}" if target in OUTSIDE else target
        if not target.startswith("docs/"):
            return text
        return f"{image}[{text}]({posixpath.relpath(target, posixpath.dirname('docs/' + uri))}{hash_sign}{anchor})"

    markdown = MARKER.sub(lambda match: GENERATED[match[1]](), markdown)
    return LINK.sub(lead, markdown)


def on_post_build(config: Any) -> None:
    """Remove what a reader of the site does not need: source maps, and the search in other languages."""
    scripts = Path(config.site_dir) / "assets" / "javascripts"
    for path in (Path(config.site_dir) / "assets").rglob("*.map"):
        path.unlink()
    shutil.rmtree(scripts / "lunr")
