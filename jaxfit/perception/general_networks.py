"""The general segmenters: a detector in three sizes and a saliency network, which the user downloads once."""

from __future__ import annotations

from pathlib import Path

from jaxfit.config.perception import GENERAL
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.published import PublishedFile, check_published, get_published, user_folder

FOLDER_VARIABLE = "JAXFIT_NETWORKS"
"""Environment variable that names the folder of the files."""
COMMAND = "jaxfit networks get general"
"""The command that downloads the files of the smallest size."""


def _detector(size: str, *sha256: str) -> PublishedFile:
    url = f"https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_{size}.onnx"
    return PublishedFile(f"yolox_{size}.onnx", url, sha256, COMMAND if size == "nano" else f"{COMMAND}-{size}")


DETECTORS = {
    GENERAL: _detector(
        "nano",
        "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
        # another export of this network, with PyTorch 2.1.1 (3,713,911 bytes); the docs' figures are from this file
        "d39bee73564e338080378b0ad567fbb40e818b55bbfaf971de82a0267ed16b8a",
    ),
    f"{GENERAL}-tiny": _detector("tiny", "427cc366d34e27ff7a03e2899b5e3671425c262ea2291f88bb942bc1cc70b0f7"),
    f"{GENERAL}-s": _detector("s", "c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063"),
}
"""Name of a general segmenter → its detector, from small to large: YOLOX, trained on COCO (Apache-2.0)."""
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


def general_files(name: str = GENERAL) -> list[Path]:
    """Return the files of the detector and of the saliency network of a general segmenter, without a check."""
    return [networks_folder() / network.file_name for network in (DETECTORS[name], SALIENCY)]


def installed_general() -> str | None:
    """Return the name of the largest general segmenter whose files exist; None without files."""
    names = [name for name in DETECTORS if all(path.exists() for path in general_files(name))]
    return names[-1] if names else None


def check_general_files(name: str = GENERAL) -> list[Path]:
    """Return the files of the detector and of the saliency network, after the check of both.

    Raises:
        InputError: a file is missing or cannot be read, or has another content than the published file.
    """
    files = general_files(name)
    for path, network in zip(files, (DETECTORS[name], SALIENCY), strict=True):
        check_published(path, network)
    return files


def get_general_files(name: str = GENERAL, source: Path | None = None, progress: ProgressTask = silent) -> list[Path]:
    """Download both files, and return their paths. Arguments and errors are those of `get_published`."""
    return get_published((DETECTORS[name], SALIENCY), networks_folder(), source, progress)
