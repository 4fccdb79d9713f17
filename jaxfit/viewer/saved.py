"""A page to send: one HTML file, or a folder, that opens without jaxfit and without a network."""

from __future__ import annotations

import base64
import gzip
import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import check_new_file, check_replaceable, new_folder, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.viewer.film import film_times, is_played, write_copy
from jaxfit.viewer.page import saved_index
from jaxfit.viewer.shown import Shown, frames_of

LARGEST_FILE = 30_000_000
"""Bytes of a page in one file."""
WIDTHS = 1280, 960, 640, 480
"""Widths of the copy of the film that are tried until the page is small enough, pixels."""
CURVES = "confidence", "residual", "body_pitch", "speed", "wing_spread", "neighbour_distance"
"""Values over time that a saved page holds, where the result has them."""
INDEX = "index.html"


class Saved(NamedTuple):
    """A written page."""

    path: Path
    bytes: int
    left_out: tuple[str, ...]
    """What the page does not show, for people."""


def save_page(
    results: Sequence[Shown], video: Path | None, out: Path, overwrite: bool = False, progress: ProgressTask = silent
) -> Saved:
    """Write a page with everything that it shows.

    A name that ends in `.html` becomes one file of at most `LARGEST_FILE` bytes: the film is made smaller until it
    fits, and left out if it does not fit at all. Any other name becomes a folder, with the film as it is where browsers
    play its format.

    Args:
        results: what the page shows.
        video: the film; None shows the birds in 3D only.
        out: the file or the folder.
        overwrite: replace an earlier page.
        progress: reports parts.

    Raises:
        InputError: the poses alone are too large for one file, the film cannot be read, or the page cannot be written.
    """
    if out.suffix.lower() == ".html":
        check_new_file(out, overwrite)
        return _save_file(results, video, out, progress)
    check_replaceable(out, overwrite, INDEX)
    return _save_folder(results, video, out, overwrite, progress)


def _save_file(results: Sequence[Shown], video: Path | None, out: Path, progress: ProgressTask) -> Saved:
    curves, left_out = _curves(results[0])
    entries = [_element(path, content) for path, content in _arrays(results, curves, progress)]
    free = LARGEST_FILE - sum(map(len, entries)) - len(saved_index(""))
    free -= 2 * len(json.dumps(_facts(results, curves, None, [])))
    if free < 0:
        problem = f"would have {(LARGEST_FILE - free) / 1e6:.0f} MB without a film, more than {LARGEST_FILE / 1e6:.0f}"
        raise InputError(out, problem, "give --frames A:B, or a folder in place of a file")
    copy = None
    if video is not None:
        film, copy, without = _film_that_fits(results, video, free, progress)
        entries += film
        left_out += without
    facts = json.dumps(_facts(results, curves, copy, left_out)).encode()
    content = saved_index("\n".join([_element("facts", facts), *entries])).encode()
    write_whole(out, content)
    return Saved(out, len(content), tuple(left_out))


def _film_that_fits(
    results: Sequence[Shown], video: Path, free: int, progress: ProgressTask
) -> tuple[list[str], dict[str, Any] | None, list[str]]:
    """Return the largest copy of a film that has at most `free` bytes as an element, its facts, and what it lacks."""
    full = results[0].size_px[0]
    with tempfile.TemporaryDirectory() as folder:
        for width in (min(full, WIDTHS[0]), *(each for each in WIDTHS[1:] if each < full)):
            film = Path(folder) / f"{width}.mp4"
            times = write_copy(video, frames_of(results), film, width, progress)
            if film.stat().st_size * 4 / 3 < free:
                text = base64.b64encode(film.read_bytes()).decode()
                element = f'<script type="text/plain" data-path="film" data-type="video/mp4">{text}</script>'
                lacks = [f"the film in its full size: it is {width} pixels wide here"] if width < full else []
                return [element], {"source": "film", "times_s": times.tolist(), "pictures": False}, lacks
    return [], None, [f"the film, with which the page would have more than {LARGEST_FILE / 1e6:.0f} MB"]


def _save_folder(
    results: Sequence[Shown], video: Path | None, out: Path, overwrite: bool, progress: ProgressTask
) -> Saved:
    curves, left_out = _curves(results[0])
    with new_folder(out, overwrite, marker=INDEX) as part:
        (part / "data").mkdir()
        for path, content in _arrays(results, curves, progress):
            call = f"jaxfitSaved({json.dumps(path)}, {json.dumps(_packed(content))})\n"
            write_whole(part / "data" / f"{path.replace('/', '-')}.js", call.encode())
        copy = None
        if video is not None:
            name, frames = f"film{video.suffix.lower()}", frames_of(results)
            times = film_times(video, frames) if is_played(video) else [None]
            if None not in times:
                shutil.copyfile(video, part / name)
            else:
                name = "film.mp4"
                times = write_copy(video, frames, part / name, results[0].size_px[0], progress).tolist()
            copy = {"source": name, "times_s": times, "pictures": False}
        facts = _element("facts", json.dumps(_facts(results, curves, copy, left_out)).encode())
        write_whole(part / INDEX, saved_index(facts).encode())
    size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
    return Saved(out / INDEX, size, tuple(left_out))


def _curves(result: Shown) -> tuple[dict[str, bytes], list[str]]:
    """Return the curves that a page holds, and what it leaves out, for people."""
    names = [each["name"] for each in result.kinds_of_values]
    curves, left_out = {}, ["corrections and the reasons of flags, which need `jaxfit view`"]
    for name in CURVES:
        if name in names:
            try:
                curves[name] = result.values(name)
            except InputError as error:
                left_out.append(f"the curve of {error}")
    left_out.append(f"{sum(name not in CURVES for name in names)} further curves, which `jaxfit view` shows")
    return curves, left_out


def _facts(
    results: Sequence[Shown], curves: Mapping[str, bytes], film: dict[str, Any] | None, left_out: Sequence[str]
) -> dict[str, Any]:
    facts = [each.facts() for each in results]
    for each in facts:
        each["values"] = [value for value in each["values"] if value["name"] in curves]
    notes = [f"This saved page leaves out: {'; '.join(left_out)}."] if left_out else []
    return {"results": facts, "film": film, "corrections": None, "notes": notes}


def _arrays(
    results: Sequence[Shown], curves: Mapping[str, bytes], progress: ProgressTask
) -> Iterator[tuple[str, bytes]]:
    """Yield path and content of all arrays that the page reads. It shows the curves of the first result only."""
    yield from ((f"results/0/values/{name}", content) for name, content in curves.items())
    with progress("Saving the page", sum(each.parts for each in results)) as report_progress:
        for number, result in enumerate(results):
            yield f"results/{number}/rig", result.rig()
            yield f"results/{number}/flags", result.flags()
            for part in range(result.parts):
                yield f"results/{number}/poses/{part}", result.part(part)
                yield f"results/{number}/outlines/{part}", result.outlines(part)
                report_progress(1, f"part {part + 1}")


def _packed(content: bytes) -> str:
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


def _element(path: str, content: bytes) -> str:
    return f'<script type="text/plain" data-path="{path}">{_packed(content)}</script>'
