"""Files that their publishers distribute: the folder of the user's copies, the download, and the check of a copy."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.reading import open_file

_SECONDS = 30
"""Longest time without an answer of the publisher."""


class PublishedFile(NamedTuple):
    """A file that its publisher distributes."""

    file_name: str
    url: str
    """Address at the publisher."""
    sha256: tuple[str, ...]
    """The accepted hashes; the first is that of the file of the publisher."""
    command: str
    """The command that downloads the file."""


def user_folder(kind: str, variable: str) -> Path:
    """Return the folder of the user's files of a kind: that of an environment variable, or `jaxfit/KIND` of the user's
    data."""
    named = os.environ.get(variable)
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "jaxfit" / kind


def check_published(path: Path, published: PublishedFile) -> None:
    """Check that a file has the content of the published file.

    Raises:
        InputError: the file is missing, cannot be read, or has another content.
    """
    if not path.exists():
        raise InputError(path, f"does not exist; {published.url} has it", f"run `{published.command}`")
    with open_file(path, "a published file") as file:
        digest = hashlib.file_digest(cast(Any, file), "sha256").hexdigest()
    if digest not in published.sha256:
        problem = "is not the published file: its SHA-256 differs"
        raise InputError(path, problem, f"remove the file and run `{published.command}`")


def get_published(
    files: Sequence[PublishedFile], folder: Path, source: Path | None = None, progress: ProgressTask = silent
) -> list[Path]:
    """Download published files into a folder. Files that are there with the right content stay.

    Args:
        files: the files.
        folder: the folder; it is made if it is missing.
        source: a folder with copies of the files, for a machine without a network; None downloads the files.
        progress: opens a progress task over the bytes of each file.

    Returns:
        The paths of the files.

    Raises:
        InputError: a file cannot be downloaded, or has another content than the published file. The same call
            continues: complete files stay, and so does the part of a file whose download broke off.
    """
    paths = [folder / published.file_name for published in files]
    for path, published in zip(paths, files, strict=True):
        if path.is_file():
            check_published(path, published)
        elif source is None:
            _download(published, path, progress)
        else:
            check_published(source / published.file_name, published)
            write_whole(path, (source / published.file_name).read_bytes())
    return paths


def _download(published: PublishedFile, path: Path, progress: ProgressTask) -> None:
    import pooch  # imported here because few commands download
    import requests

    pooch.get_logger().setLevel("WARNING")
    part = path.with_name(f"{path.name}.part")
    with progress(f"download of {path.name}", None) as report_progress:

        def download(fname: str, action: Any, pooch: Any, *, check_only: bool | None = None) -> None:
            """Write the bytes of the address `fname` that are missing in the file `action`, with the names of pooch; an
            interrupted download leaves `part`."""
            done = part.stat().st_size if part.exists() else 0
            headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={done}-"} if done else {})
            with requests.get(fname, headers=headers, stream=True, timeout=_SECONDS) as response:
                if response.status_code == requests.codes.requested_range_not_satisfiable:
                    part.unlink()
                response.raise_for_status()
                continues = response.status_code == requests.codes.partial_content
                done = done if continues else 0
                report_progress(done, f"{done / 1e6:.1f} MB")
                with part.open("ab" if continues else "wb") as file:
                    for block in response.iter_content(1 << 16):
                        done += file.write(block)
                        report_progress(len(block), f"{done / 1e6:.1f} MB")
            part.replace(action)

        try:
            pooch.retrieve(published.url, f"sha256:{published.sha256[0]}", path.name, path.parent, downloader=download)
        except ValueError as error:
            problem = "gave another file than the published one: its SHA-256 differs"
            remedy = f"try `{published.command}` later, or give a folder with the right file by --from"
            raise InputError(published.url, problem, remedy) from error
        except OSError as error:  # also those of requests
            broken = isinstance(error, requests.exceptions.ChunkedEncodingError)
            reason = "the connection broke off" if broken else "no connection"
            if isinstance(error, requests.exceptions.HTTPError) and error.response is not None:
                reason = f"the server answers {error.response.status_code} {error.response.reason}"
            remedy = f"check the network and run `{published.command}` again"
            remedy += ", which continues" if part.exists() else ""
            remedy += ", or give a folder with the file by --from"
            raise InputError(published.url, f"cannot be downloaded: {reason}", remedy) from error
