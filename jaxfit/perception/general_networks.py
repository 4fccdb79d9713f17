"""The general segmenter: two published networks that the user downloads once, and the check of the two files."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any, NamedTuple, cast

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import open_file

FOLDER_VARIABLE = "JAXFIT_NETWORKS"
"""Environment variable that names the folder of the files."""


class PublishedNetwork(NamedTuple):
    """A network that its publisher distributes as one file."""

    file_name: str
    url: str
    """Address of the file at its publisher."""
    sha256: tuple[str, ...]
    """The accepted hashes; the first is that of the file of the publisher."""


DETECTOR = PublishedNetwork(
    "yolox_nano.onnx",
    "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_nano.onnx",
    (
        "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
        # another export of this network, with PyTorch 2.1.1 (3,713,911 bytes); the docs' figures are from this file
        "d39bee73564e338080378b0ad567fbb40e818b55bbfaf971de82a0267ed16b8a",
    ),
)
"""YOLOX-nano, trained on COCO (Apache-2.0): boxes of the class bird."""
SALIENCY = PublishedNetwork(
    "u2netp.onnx",
    "https://github.com/danielgatis/rembg/releases/download/v0.0.0/u2netp.onnx",
    ("309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8",),
)
"""U²-Net-p (Apache-2.0), in the export of the project rembg: the salient object in each box."""


def networks_folder() -> Path:
    """Return the folder of the files: `JAXFIT_NETWORKS`, or the folder `jaxfit/networks` of the user's data."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "jaxfit" / "networks"


def general_files() -> list[Path]:
    """Return the files of the detector and of the saliency network, without a check."""
    return [networks_folder() / network.file_name for network in (DETECTOR, SALIENCY)]


def check_general_files() -> list[Path]:
    """Return the files of the detector and of the saliency network, after the check of both.

    Raises:
        InputError: a file is missing or cannot be read, or has another content than the published file.
    """
    files = general_files()
    for path, network in zip(files, (DETECTOR, SALIENCY), strict=True):
        if not path.exists():
            raise InputError(path, "does not exist; `general` needs the file", f"download {network.url} to this path")
        with open_file(path, "an ONNX file") as file:
            digest = hashlib.file_digest(cast(Any, file), "sha256").hexdigest()
        if digest not in network.sha256:
            problem = "is not the published file: its SHA-256 differs"
            raise InputError(path, problem, f"remove the file and download {network.url} to this path")
    return files
