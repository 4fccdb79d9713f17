"""The general segmenter: two published networks that the user downloads once."""

from __future__ import annotations

from pathlib import Path

from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.published import PublishedFile, check_published, get_published, user_folder

FOLDER_VARIABLE = "JAXFIT_NETWORKS"
"""Environment variable that names the folder of the files."""
COMMAND = "jaxfit networks get general"
"""The command that downloads the files."""
DETECTOR = PublishedFile(
    "yolox_nano.onnx",
    "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_nano.onnx",
    (
        "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
        # another export of this network, with PyTorch 2.1.1 (3,713,911 bytes); the docs' figures are from this file
        "d39bee73564e338080378b0ad567fbb40e818b55bbfaf971de82a0267ed16b8a",
    ),
    COMMAND,
)
"""YOLOX-nano, trained on COCO (Apache-2.0): boxes of the class bird."""
SALIENCY = PublishedFile(
    "u2netp.onnx",
    "https://github.com/danielgatis/rembg/releases/download/v0.0.0/u2netp.onnx",
    ("309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8",),
    COMMAND,
)
"""U²-Net-p (Apache-2.0), in the export of the project rembg: the salient object in each box."""


def networks_folder() -> Path:
    """Return the folder of the files: `JAXFIT_NETWORKS`, or the folder `jaxfit/networks` of the user's data."""
    return user_folder("networks", FOLDER_VARIABLE)


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
        check_published(path, network)
    return files


def get_general_files(source: Path | None = None, progress: ProgressTask = silent) -> list[Path]:
    """Download both files, and return their paths. Arguments and errors are those of `get_published`."""
    return get_published((DETECTOR, SALIENCY), networks_folder(), source, progress)
