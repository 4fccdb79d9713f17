"""`cameras calibrate`: cameras from films of a checkerboard."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxfit.cli.tables import right_aligned, show
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.files import check_new_file
from jaxfit.foundation.progress import ReportProgress, terminal

if TYPE_CHECKING:
    import numpy as np

    from jaxfit.cameras.calibrate import Board, BoardViews, Lens, Pair
    from jaxfit.cameras.camera import Camera

_MAX_FRAMES = 200
"""Most frames of a film in which the board is searched."""
_BOARD_CORNERS = range(3, 101)
_LITTLE_COVERAGE = 0.5
_LARGE_FOCAL_SD = 0.01
"""Standard deviation of a focal length that needs more views, as a fraction of the focal length."""
_LARGE_PAIR_ERROR = 3.0
"""RMS error of a pair that is too large, as a multiple of that of its cameras."""


def calibrate_films(options: argparse.Namespace) -> None:
    """Calibrate cameras from films of a checkerboard, print how good they are, and write them."""
    from jaxfit.cameras.calibrate import calibrate_cameras
    from jaxfit.cameras.files import write_cameras

    check_new_file(options.out, options.overwrite)
    board = _board(options)
    films = _find_boards(options.films, board)
    lenses, pairs = calibrate_cameras(films, board, options.fisheye)
    write_cameras([lens.camera for lens in lenses], options.out)
    _show_lenses(lenses)
    if pairs:
        _show_pairs(lenses, pairs)
    show(f"→ {options.out}")


def _board(options: argparse.Namespace) -> Board:
    from jaxfit.cameras.calibrate import Board

    sides = re.fullmatch(r"(\d{1,3})[xX×](\d{1,3})", options.board)
    columns, rows = map(int, sides.groups()) if sides else (0, 0)
    if columns not in _BOARD_CORNERS or rows not in _BOARD_CORNERS:
        remedy = f"give the inner corners as 9x6, each {_BOARD_CORNERS[0]} to {_BOARD_CORNERS[-1]}"
        raise InputError("--board", f"is {options.board}", remedy)
    if not 0 < options.square_mm < math.inf:
        raise InputError("--square-mm", f"is {options.square_mm}", "give the side of a square, above 0")
    return Board(columns, rows, options.square_mm / 1000)


def _find_boards(films: Sequence[Path], board: Board) -> list[BoardViews]:
    """Search for the board in every film, in the same frames of all films."""
    from jaxfit.cameras.calibrate import find_boards

    names = [film.resolve().name if film.is_dir() else film.stem for film in films]
    for i, name in enumerate(names):
        if name in names[:i]:
            problem = f'would be a second camera with the name "{name}", after {films[names.index(name)]}'
            raise InputError(films[i], problem, "give each film its own name")
    counts = [_frame_count(film) for film in films]
    step = math.ceil(max(counts) / _MAX_FRAMES)
    found = []
    for name, film, count in zip(names, films, counts, strict=True):
        with terminal(f"search for the board: {name}", math.ceil(count / step)) as report_progress:
            found.append(find_boards(name, film, _pictures(film, step, report_progress), board))
    return found


def _frame_count(film: Path) -> int:
    from jaxfit.video.reader import probe_video

    count = probe_video(film).frames
    if count is None:  # some containers do not store it
        with terminal(f"count the frames: {film.name}", None) as report_progress:
            count = sum(1 for _ in _pictures(film, 1, report_progress))
    return count


def _pictures(film: Path, step: int, report_progress: ReportProgress) -> Iterator[tuple[int, np.ndarray]]:
    from jaxfit.video.reader import read_frames

    for frame in read_frames(film, step=step):
        yield frame.index, frame.picture
        report_progress(1, "")


def _show_lenses(lenses: Sequence[Lens]) -> None:
    table = right_aligned("camera", "views", "RMS px", "focal x px", "focal y px", "view °")
    for lens in lenses:
        camera = lens.camera
        sds = ["" if lens.focal_sd_px is None else f" ± {sd:.1f}" for sd in lens.focal_sd_px or (0, 0)]
        focal = [f"{camera.matrix[i, i]:.1f}{sds[i]}" for i in range(2)]
        angles = "×".join(f"{angle:.0f}" for angle in camera.field_of_view_deg or ())
        table.add_row(camera.name, str(lens.views), f"{lens.rms_px:.2f}", *focal, angles)
    table.title = f"{counted(len(lenses), 'camera')}; ±: standard deviation; view: width × height"
    show(table)
    shares = ", ".join(f"{lens.camera.name} {100 * lens.coverage:.0f} %" for lens in lenses)
    show(f"share of the picture that the boards cover: {shares}")
    for lens in lenses:
        lost = _share_without_rays(lens.camera)
        if lost > 0:
            remedy = "try --fisheye, or film the board near the edges"
            show(f"no lens model in {100 * lost:.0f} % of the picture: {lens.camera.name}; {remedy}")
        if lens.coverage < _LITTLE_COVERAGE:
            remedy = "film the board also near the edges and corners of the picture"
            show(f"boards cover too little of the picture: {lens.camera.name}; {remedy}")
        focal_px = lens.camera.matrix[0, 0]
        if lens.focal_sd_px is not None and lens.focal_sd_px[0] > _LARGE_FOCAL_SD * focal_px:
            show(f"uncertain focal length: {lens.camera.name}; film the board tilted by 30 to 45°, in all directions")


def _share_without_rays(camera: Camera) -> float:
    """Return the share of the picture where the distortion of the lens has no inverse."""
    import numpy as np

    width, height = camera.size_px or (1, 1)
    grid = np.stack(np.meshgrid(np.linspace(0, width, 33), np.linspace(0, height, 25)), axis=-1)
    return 1 - float(np.isfinite(camera.undistort(grid)).all(-1).mean())


def _show_pairs(lenses: Sequence[Lens], pairs: Sequence[Pair]) -> None:
    rms_px = {lens.camera.name: lens.rms_px for lens in lenses}
    table = right_aligned("pair", "common views", "RMS px")
    for pair in pairs:
        table.add_row(f"{pair.first}, {pair.second}", str(pair.views), f"{pair.rms_px:.2f}")
    table.title = f"relative poses; the world is {lenses[0].camera.name}"
    show(table)
    for pair in pairs:
        if pair.rms_px > _LARGE_PAIR_ERROR * max(rms_px[pair.first], rms_px[pair.second]):
            show(f"large error: {pair.first}, {pair.second}; did the films start together? move the board slowly")
