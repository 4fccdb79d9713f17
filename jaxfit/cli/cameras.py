"""`cameras show`, `cameras check`, and the observations of several cameras."""

from __future__ import annotations

import argparse
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxfit.cli.observations import observations_for
from jaxfit.cli.tables import right_aligned, show
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.files import check_new_file
from jaxfit.foundation.progress import terminal
from jaxfit.model.files import find_bird

if TYPE_CHECKING:
    from jaxfit.cameras.camera import Camera
    from jaxfit.data.observations import Observations
    from jaxfit.data.view_matching import BirdMatches
    from jaxfit.data.views import Views
    from jaxfit.model.bird import Bird


def show_cameras(options: argparse.Namespace) -> None:
    """Print a table of the cameras, and draw a plan of them."""
    from jaxfit.cameras.files import read_camera_file
    from jaxfit.view.camera_plan import camera_plan
    from jaxfit.view.drawing import write_png

    if options.out is not None:
        check_new_file(options.out, options.overwrite)
    file = read_camera_file(options.cameras, options.unit)
    table = right_aligned("camera", "size px", "focal", "view °", "lens", "x, y, z m", "down")
    for camera in file.cameras:
        table.add_row(*_cells(camera))
    source = "assumed, as usual for this program: check the distances" if file.unit_assumed else "stated"
    unit = f"; unit of the file: {file.unit} ({source})" if file.unit else ""
    table.title = f"{counted(len(file.cameras), 'camera')} of {file.format}{unit}"
    table.caption = "focal: px; view: width × height; lens: coefficients; down: viewing axis below the x, y plane, °"
    show(table)
    if len(file.cameras) > 1:
        a, b = min(combinations(file.cameras, 2), key=_distance_m)
        show(f"nearest cameras: {a.name} and {b.name}, {_distance_m((a, b)):.2f} m")
    if options.out is not None:
        write_png(options.out, camera_plan(file.cameras))
        show(f"→ {options.out}")


class ReadViews(NamedTuple):
    """The observations of several cameras."""

    views: Views
    tracks: tuple[Observations, ...]
    """The tracks of the cameras before they were matched."""
    matches: BirdMatches
    offset_frames: list[float] | None
    """The offsets that were given, see `on_common_frames`."""
    step_frames: list[float]
    """Frames of each camera between two frames of the first, see `own_steps`."""


def read_views(options: argparse.Namespace, bird: Bird) -> ReadViews:
    """Read the cameras and observations of a command, and match the birds of the cameras.

    Args:
        options: `observations`, `cameras`, `unit`, `offsets`, `match` and the options of observations.
        bird: the model.

    Raises:
        InputError: unusable files, or cameras and observations that do not belong together.
    """
    from jaxfit.cameras.files import read_camera_file
    from jaxfit.data.view_matching import BirdMatches, match_birds, matches_of_file
    from jaxfit.data.views import Views, assign_cameras, birds_in_rows, on_common_frames, own_steps, straightened

    file = read_camera_file(options.cameras, options.unit)
    own = [
        observations_for(path, bird.keypoint_names, options, quiet=i > 0)[0]
        for i, path in enumerate(options.observations)
    ]
    lenses = assign_cameras(file.cameras, own, options.observations)
    pairs = [straightened(camera, each, terminal) for camera, each in zip(lenses, own, strict=True)]
    cameras = tuple(camera for camera, _ in pairs)
    offsets, steps = _offsets(options.offsets, len(pairs)), own_steps([each for _, each in pairs])
    tracks = on_common_frames([each for _, each in pairs], offsets)
    if options.match is not None:
        matches = matches_of_file(options.match, lenses, tracks)
    elif len(tracks) == 1:
        numbers = np.arange(tracks[0].num_tracks)
        alone = np.where(tracks[0].present, numbers[:, None], -1)
        matches = BirdMatches((alone,), len(numbers), np.full(len(numbers), np.nan), np.zeros(len(numbers)))
    else:
        matches = match_birds(cameras, tracks)
    ids = tracks[0].track_id.tolist() if len(tracks) == 1 and options.match is None else range(1, matches.birds + 1)
    rows = tuple(birds_in_rows(each, of, list(ids)) for each, of in zip(tracks, matches.bird, strict=True))
    return ReadViews(Views(cameras, lenses, rows), tracks, matches, offsets, steps)


def _offsets(text: str | None, count: int) -> list[float] | None:
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError("--offsets", f"is {text}", f"give {count} numbers with commas, one for each camera, in frames")
    if numbers[0]:
        problem = f"is {text}, but the frames of a result are those of the first camera"
        raise InputError("--offsets", problem, "begin with 0, and give the frame of each other camera at its frame 0")
    return numbers


def show_matches(read: ReadViews) -> None:
    """Print which tracks are one bird."""
    table = right_aligned("bird", *(camera.name for camera in read.views.lenses), "error", "undecided")
    for b in range(read.matches.birds):
        cells = []
        for own, tracks in zip(read.matches.bird, read.tracks, strict=True):
            ids = tracks.track_id[(own == b).any(axis=1)].tolist()
            cells.append(", ".join(map(str, ids)) or "–")
        error, undecided = read.matches.error[b], read.matches.undecided[b]
        error_text = "" if np.isnan(error) else f"{100 * error:.1f} %"
        table.add_row(str(b + 1), *cells, error_text, f"{100 * undecided:.0f} %" if undecided else "")
    table.title = "tracks of each camera that show one bird; error: of the keypoints, relative to the bird's box"
    show(table)
    doubtful = [str(b + 1) for b in range(read.matches.birds) if read.matches.undecided[b] > 0]
    if doubtful:
        show(f"uncertain in some frames: bird {', '.join(doubtful)}; look, and decide by --match if necessary")


def check_calibration(options: argparse.Namespace) -> None:
    """Check cameras against the keypoints that they show."""
    from jaxfit.data.view_check import check_cameras

    if len(options.observations) < 2:
        raise InputError("cameras check", "needs two cameras", "give the observations of at least two cameras")
    read = read_views(options, find_bird(options.model))
    result = check_cameras(read.views, read.tracks, read.matches, read.offset_frames, read.step_frames)
    show_matches(read)
    table = right_aligned("camera", "error px", "% of box", "agree %")
    for name, (error_px, relative, agree) in result.by_camera.items():
        table.add_row(name, f"{error_px:.2f}", f"{100 * relative:.1f}", f"{100 * agree:.0f}")
    table.title = "median error of detected keypoints from triangulated keypoints"
    show(table)
    table = right_aligned("keypoint", "error px", "agree %")
    for name, (error_px, agree) in result.by_keypoint.items():
        table.add_row(name, f"{error_px:.2f}", f"{100 * agree:.0f}")
    show(table)
    for finding in result.findings:
        show(f"wrong: {finding}")
    if not result.findings:
        show("the cameras agree: no wrong order, no offset in time and no moved camera was found")


def _distance_m(pair: tuple[Camera, Camera]) -> float:
    return float(np.linalg.norm(pair[0].position_world - pair[1].position_world))


def _cells(camera: Camera) -> list[str]:
    size, angles = camera.size_px, camera.field_of_view_deg
    coefficients = int(np.count_nonzero(camera.distortion))
    lens = "fisheye" if camera.lens == "fisheye" else f"{coefficients} coeff." if coefficients else "straight"
    focal_px = sorted({f"{camera.matrix[0, 0]:.0f}", f"{camera.matrix[1, 1]:.0f}"})
    return [
        camera.name,
        "unknown" if size is None else f"{size[0]}×{size[1]}",
        ", ".join(focal_px),
        "unknown" if angles is None else f"{angles[0]:.0f}×{angles[1]:.0f}",
        lens,
        ", ".join(f"{x:.2f}" for x in camera.position_world),
        f"{np.degrees(np.arcsin(np.clip(-camera.R_cam_world[2, 2], -1, 1))):.0f}",
    ]
