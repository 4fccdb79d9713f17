"""Which notebooks and pages the gate may leave out: `make release` runs all of them, and stores their hashes.

The tests of a notebook, or of the first hour, run where the code of the file differs from the code of the last release
check, and always with `JAXFIT_RELEASE=1`. As a program: store the hashes of the present files.
"""

import hashlib
import json
import os
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RECORD = Path(__file__).with_suffix(".json")
FILES = [*sorted((ROOT / "notebooks").glob("*.ipynb")), ROOT / "docs" / "first_hour.md"]
REASON = "unchanged since the last release check"


def code_hash(path):
    """Return the SHA-256 hash of the code in a notebook or in a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    else:
        code = re.findall(r"^```.*?^```", text, re.DOTALL | re.MULTILINE)
    return hashlib.sha256("\0".join(code).encode()).hexdigest()


def is_unchanged(path):
    """Return whether the gate may leave out a file."""
    stored = json.loads(RECORD.read_text(encoding="utf-8"))
    return not os.environ.get("JAXFIT_RELEASE") and stored.get(path.name) == code_hash(path)


if __name__ == "__main__":
    RECORD.write_text(json.dumps({path.name: code_hash(path) for path in FILES}, indent=2) + "\n", encoding="utf-8")
