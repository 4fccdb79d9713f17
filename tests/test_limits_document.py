"""docs/reference/limits.md lists all limits of `jaxfit.foundation.limits`; this file, run as a script, rewrites it."""

import ast
import re
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE, DOCUMENT = ROOT / "jaxfit" / "foundation" / "limits.py", ROOT / "docs" / "reference" / "limits.md"
START = "<!-- the tables below are written from jaxfit/foundation/limits.py -->\n"


def tables():
    """Return a table for every part of jaxfit/foundation/limits.py: name, value and description of each limit."""
    text = SOURCE.read_text(encoding="utf-8")
    headings = {text[: match.start()].count("\n"): match[1] for match in re.finditer(r"# --- (.*)", text)}
    body = ast.parse(text).body
    lines = []
    for assignment, docstring in pairwise(body):
        if not isinstance(assignment, ast.Assign):
            continue
        for line in sorted(line for line in headings if line < assignment.lineno):
            heading = headings.pop(line)
            lines += ["", f"## {heading[0].upper()}{heading[1:]}", "", "| limit | value | |", "|---|---:|---|"]
        name = assignment.targets[0].id
        description = " ".join(ast.literal_eval(docstring.value).split())
        lines.append(f"| `{name}` | {_shown(eval(ast.unparse(assignment.value), {}))} | {description} |")
    return "\n".join(lines) + "\n"


def _shown(value):
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:g}" if isinstance(value, float) else str(value)


def test_the_document_lists_the_limits():
    assert DOCUMENT.read_text(encoding="utf-8").partition(START)[2] == tables(), "run this file as a script"


if __name__ == "__main__":
    DOCUMENT.write_text(DOCUMENT.read_text(encoding="utf-8").partition(START)[0] + START + tables(), encoding="utf-8")
