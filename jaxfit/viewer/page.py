"""The files of the page, its import map and its security policy."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path

from jaxfit.view.report.rendering import STYLE

ASSETS = Path(__file__).parent / "assets"
OWN = ("data", "film", "ledge", "timeline", "corrections", "main")
"""Own modules of the page."""
LIBRARY = {"three": "three.module.min.js", "orbit-controls": "OrbitControls.js"}
"""Modules of three.js, by the names that own modules import."""
CORE = "three.core.min.js"
"""The part of three.js that its module imports by a relative address."""
FILES = {f"{name}.js": ASSETS / f"{name}.js" for name in OWN}
FILES |= {name: ASSETS / "three" / name for name in (*LIBRARY.values(), CORE, "LICENSE")}
FILES["style.css"] = STYLE
_IMPORT_MAP = '<script type="importmap">{}</script>'
_STYLE = '<link rel="stylesheet" href="page/style.css">'
_MAIN = '<script type="module" src="page/main.js"></script>'


def _own_modules() -> list[str]:
    return [name for name in OWN if name != "main"]


def _import_map() -> str:
    addresses = {f"viewer/{name}": f"./page/{name}.js" for name in _own_modules()}
    addresses |= {name: f"./page/{file}" for name, file in LIBRARY.items()}
    return json.dumps({"imports": addresses})


def index() -> str:
    """Return the page as the server sends it."""
    return _html().replace(_IMPORT_MAP, _IMPORT_MAP.replace("{}", _import_map()))


def policy() -> str:
    """Return the Content-Security-Policy of the page: nothing comes from elsewhere."""
    digest = base64.b64encode(hashlib.sha256(_import_map().encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data: blob:; media-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )


def saved_index(content: str) -> str:
    """Return the page as one file that opens from disk: modules and style are inside.

    Browsers load no module beside a page on disk, so the import map holds the modules as `data:` addresses.

    Args:
        content: elements with the data of the page.
    """
    library = {name: FILES[file].read_text(encoding="utf-8") for name, file in LIBRARY.items()}
    library["three"] = library["three"].replace(f'"./{CORE}"', '"three-core"')
    library["three-core"] = FILES[CORE].read_text(encoding="utf-8")
    own = {f"viewer/{name}": FILES[f"{name}.js"].read_text(encoding="utf-8") for name in _own_modules()}
    imports = json.dumps({"imports": {name: _address(text) for name, text in (library | own).items()}})
    license_text = FILES["LICENSE"].read_text(encoding="utf-8")
    style = f"<style>\n{FILES['style.css'].read_text(encoding='utf-8')}</style>"
    main = f'<script type="module">\n{FILES["main.js"].read_text(encoding="utf-8")}</script>'
    head = (
        f'<meta name="saved" content="jaxfit">\n<!-- This page contains three.js.\n{license_text}-->\n'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'unsafe-inline' data: "
        "file:; style-src 'unsafe-inline'; img-src data: blob:; media-src blob: file: data:\">\n"
    )
    page = _html().replace(_STYLE, head + style).replace(_IMPORT_MAP, _IMPORT_MAP.replace("{}", imports))
    return page.replace(_MAIN, "").replace("</body>", f"{content}\n{main}\n</body>")


def _html() -> str:
    text = (ASSETS / "index.html").read_text(encoding="utf-8")
    missing = [part for part in (_IMPORT_MAP, _STYLE, _MAIN) if part not in text]
    if missing:
        raise ValueError(f"index.html lacks {missing[0]}")
    return text


def _address(text: str) -> str:
    return "data:text/javascript;base64," + base64.b64encode(text.encode()).decode()
