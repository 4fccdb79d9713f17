"""Calibration of cameras from films of a checkerboard, by OpenCV.

Pixel centres are at i + 0.5 throughout, so OpenCV returns principal points in this convention. The side of a square is
the unit of length until the poses of the cameras are complete.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.formats.values import WHOLE_PIXELS
from jaxfit.foundation.errors import InputError

MIN_VIEWS = 8
"""Fewest different views of the board for the calibration of a camera."""
MAX_VIEWS = 60
"""Most views of the board that a calibration uses; more views take longer and change little."""
MIN_COMMON_VIEWS = 3
"""Fewest frames in which two cameras see the board, for their relative pose."""

_SEARCH_SIDE_PX = 1280
"""Longest side of the picture in which the board is searched; the corners are refined in the whole picture."""
_SEARCH = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
_REFINEMENT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
_WINDOW_SQUARES = 0.4
"""Half the side of the window that refines a corner, in squares; a larger window would contain other corners."""
_DIFFERENT = 0.01
"""Least RMS distance of the corners of two views that count as different, as a fraction of the picture's diagonal."""
_OUTLIER = 3.0
"""A view is dropped if its error is larger than the median error times this factor."""
_COVERAGE_SIDE_PX = 256
_FISHEYE: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
"""Holds the flags of fisheye calibrations: OpenCV 4 and OpenCV 5 differ."""


class Board(NamedTuple):
    """A checkerboard."""

    columns: int
    """Inner corners of a row: one less than the squares of a row."""
    rows: int
    """Inner corners of a column."""
    square_m: float
    """Side of a square, metres."""

    @property
    def corners(self) -> Float[np.ndarray, "N 3"]:
        """The inner corners in the frame of the board, row by row, in squares."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float64)

    @property
    def orders(self) -> list[Int[np.ndarray, "N"]]:
        """The orders in which OpenCV may list the corners.

        The colours of the squares determine the order if one of columns and rows is odd and the other is even. Other
        boards look the same after a half turn, or after a quarter turn.
        """
        grid = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        turns = [0] if (self.columns + self.rows) % 2 else [0, 2] if self.columns != self.rows else [0, 1, 2, 3]
        return [np.rot90(grid, turn).ravel() for turn in turns]


class BoardViews(NamedTuple):
    """The views of a board in the film of a camera."""

    name: str
    """Name of the camera."""
    source: object
    """The film, for messages."""
    size_px: tuple[int, int]
    """Width and height of the pictures."""
    frames: Int[np.ndarray, "F"]
    """Numbers of the frames that show the board, in ascending order."""
    corners_px: Float[np.ndarray, "F N 2"]
    """Corners of the board, in the order of `Board.corners`."""


class Lens(NamedTuple):
    """A calibrated camera, and how good its calibration is."""

    camera: Camera
    views: int
    """Number of views that the calibration uses."""
    rms_px: float
    """RMS distance of the corners from the projected corners."""
    focal_sd_px: tuple[float, float] | None
    """Standard deviations of the horizontal and the vertical focal length; None for a fisheye lens."""
    coverage: float
    """Share of the picture that the boards of the views cover."""


class Pair(NamedTuple):
    """Two cameras whose relative pose was estimated."""

    first: str
    second: str
    views: int
    """Number of common views that the relative pose uses."""
    rms_px: float
    """RMS distance of the corners from the projected corners in both cameras."""


def find_boards(name: str, source: object, frames: Iterable[tuple[int, np.ndarray]], board: Board) -> BoardViews:
    """Search for a board in the frames of a film.

    Args:
        name: name of the camera.
        source: the film, for messages.
        frames: number and picture of each frame, in ascending order; pictures of shape (H, W, 3) in blue, green, red.
        board: the board.

    Raises:
        InputError: no frame shows the board, or two frames have different sizes.
    """
    numbers, found, searched = [], [], 0
    size_px: tuple[int, int] | None = None
    for number, picture in frames:
        size = picture.shape[1], picture.shape[0]
        size_px = size_px or size
        if size != size_px:
            problem = f"its frame {number} is {size[0]}×{size[1]}, but the frames before are {size_px[0]}×{size_px[1]}"
            raise InputError(source, problem, "all frames of a camera must have one size")
        searched += 1
        corners_px = find_corners(picture, board)
        if corners_px is not None:
            numbers.append(number)
            found.append(corners_px)
    if size_px is None or not found:
        problem = f"shows no whole board of {board.columns}×{board.rows} inner corners in {searched} frames"
        raise InputError(source, problem, "check --board: count inner corners, not squares")
    return BoardViews(name, source, size_px, np.array(numbers), np.stack(found))


def find_corners(picture: UInt8[np.ndarray, "H W 3"], board: Board) -> Float[np.ndarray, "N 2"] | None:
    """Return the pixels of the inner corners of a board; None if the picture does not show the whole board."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    small = grey
    if max(grey.shape) > _SEARCH_SIDE_PX:
        factor = _SEARCH_SIDE_PX / max(grey.shape)
        small = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    found, corners = cv2.findChessboardCornersSB(small, (board.columns, board.rows), flags=_SEARCH)
    if not found:
        return None
    ratio = np.array(grey.shape[::-1]) / small.shape[::-1]
    corners_px = (np.reshape(corners, (-1, 2)) + WHOLE_PIXELS) * ratio
    grid = corners_px.reshape(board.rows, board.columns, 2)
    square_px = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    window = max(2, int(_WINDOW_SQUARES * square_px))
    start = np.ascontiguousarray(corners_px[:, None] - WHOLE_PIXELS, np.float32)
    refined = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), _REFINEMENT)
    return refined[:, 0].astype(np.float64) + WHOLE_PIXELS


def calibrate_lens(views: BoardViews, board: Board, fisheye: bool = False) -> Lens:
    """Calibrate one camera by `cv2.calibrateCameraExtended` or `cv2.fisheye.calibrate`.

    The `MAX_VIEWS` views that differ most are used. Views with an error above three times the median are
    dropped, and the camera is calibrated again.

    Args:
        views: the views of the board.
        board: the board.
        fisheye: whether the lens is a fisheye with four coefficients, instead of one with k1, k2, p1, p2, k3.

    Returns:
        The lens. The camera is the world.

    Raises:
        InputError: there are fewer than `MIN_VIEWS` different views, or OpenCV finds no camera for the views.

    Source: Zhang 2000, *A flexible new technique for camera calibration*.
    """
    corners_px = views.corners_px[_different(_shapes(views))]
    if len(corners_px) < MIN_VIEWS:
        problem = f"has {len(corners_px)} different views of the board, fewer than {MIN_VIEWS}"
        raise InputError(
            views.source, problem, "film the board in many places of the picture, tilted in all directions"
        )
    camera, error_px, sd_px = _solve(views, corners_px, board, fisheye)
    agrees = error_px <= _OUTLIER * np.median(error_px)
    if agrees.sum() < MIN_VIEWS:
        problem = f"has {agrees.sum()} views of the board that agree, fewer than {MIN_VIEWS}"
        raise InputError(views.source, problem, "film more places, and move the board slowly")
    if agrees.sum() < len(agrees):
        corners_px = corners_px[agrees]
        camera, error_px, sd_px = _solve(views, corners_px, board, fisheye)
    rms_px = float(np.sqrt(np.mean(error_px**2)))
    return Lens(camera, len(corners_px), rms_px, sd_px, _coverage(corners_px, views.size_px))


def _solve(
    views: BoardViews, corners_px: Float[np.ndarray, "V N 2"], board: Board, fisheye: bool
) -> tuple[Camera, Float[np.ndarray, "V"], tuple[float, float] | None]:
    """Return the camera, the RMS error of each view, and the standard deviations of the focal lengths."""
    points, pixels = _as_lists(corners_px, board)
    sd: Any = None
    try:
        if fisheye:
            flags = _FISHEYE.CALIB_RECOMPUTE_EXTRINSIC | _FISHEYE.CALIB_FIX_SKEW
            start = np.eye(3), np.zeros((4, 1))
            _, K, D, turns, places = cv2.fisheye.calibrate(points, pixels, views.size_px, *start, flags=flags)
        else:
            nothing: Any = None
            found = cv2.calibrateCameraExtended(points, pixels, views.size_px, nothing, nothing)
            _, K, D, turns, places, sd, _, _ = found
        coefficients, lens = (4, "fisheye") if fisheye else (5, "perspective")
        distortion = np.ravel(D)[:coefficients]
        camera = Camera(views.name, K, distortion, np.eye(3), np.zeros(3), views.size_px, lens)
    except (cv2.error, ValueError) as error:
        problem = f"OpenCV finds no {'fisheye ' * fisheye}camera for {len(corners_px)} views of the board"
        raise InputError(views.source, problem, "film the board in more places, tilted in all directions") from error
    poses = [(cv2.Rodrigues(turn)[0], np.ravel(place)) for turn, place in zip(turns, places, strict=True)]
    shown_px = np.stack([camera.project(board.corners @ R.T + t) for R, t in poses])
    return camera, _rms(shown_px - corners_px), None if sd is None else (float(sd[0, 0]), float(sd[1, 0]))


def calibrate_cameras(
    films: Sequence[BoardViews], board: Board, fisheye: bool = False
) -> tuple[list[Lens], list[Pair]]:
    """Calibrate cameras whose films started together, with poses in one world: the first camera.

    Relative poses are those of the pairs with the most common views that connect all cameras.

    Returns:
        The cameras in the order of the films, and the pairs.

    Raises:
        InputError: as `calibrate_lens`; or a camera has fewer than `MIN_COMMON_VIEWS` views in common with the
            others.
    """
    lenses = [calibrate_lens(film, board, fisheye) for film in films]
    pairs, placed = [], [0]
    while len(placed) < len(films):
        left = [i for i in range(len(films)) if i not in placed]
        a, b = max(((a, b) for a in placed for b in left), key=lambda ab: _common(films[ab[0]], films[ab[1]]).shape[1])
        count = _common(films[a], films[b]).shape[1]
        if count < MIN_COMMON_VIEWS:
            problem = f"has {count} views of the board at the same time as another camera, fewer than "
            remedy = "show the board to two cameras at a time; the films must start together"
            raise InputError(films[b].source, f"{problem}{MIN_COMMON_VIEWS}", remedy)
        first, second = lenses[a].camera, lenses[b].camera
        try:
            R, t, pair = _relative_pose((films[a], films[b]), (first, second), board)
        except cv2.error as error:
            problem = f"OpenCV finds no pose of this camera for its {count} views in common with {films[a].source}"
            raise InputError(films[b].source, problem, "show the board to both cameras in more places") from error
        transl_cam = R @ first.transl_cam + t * board.square_m
        lenses[b] = lenses[b]._replace(camera=replace(second, R_cam_world=R @ first.R_cam_world, transl_cam=transl_cam))
        pairs.append(pair)
        placed.append(b)
    return lenses, pairs


def _relative_pose(
    films: tuple[BoardViews, BoardViews], cameras: tuple[Camera, Camera], board: Board
) -> tuple[np.ndarray, np.ndarray, Pair]:
    """Return the rotation and translation (squares) from the first camera to the second, with their quality.

    The second camera is its own world.
    """
    at = _common(*films)
    at = at[:, _different(np.concatenate([_shapes(film)[i] for film, i in zip(films, at, strict=True)], axis=1))]
    first_px, second_px = (film.corners_px[i] for film, i in zip(films, at, strict=True))
    first_px, second_px = _consistent(first_px, second_px, cameras, board)
    if len(first_px) < MIN_COMMON_VIEWS:
        problem = f"has {len(first_px)} different views of the board in common with {films[0].source} that agree"
        remedy = f"move the board while both cameras see it: {MIN_COMMON_VIEWS} different views are necessary"
        raise InputError(films[1].source, problem, remedy)
    points, pixels = _as_lists(first_px, board)
    lenses = [part for camera in cameras for part in (camera.matrix.copy(), camera.distortion.copy())]
    arguments: Any = points, pixels, _as_lists(second_px, board)[1], *lenses, cameras[0].size_px
    if cameras[0].lens == "fisheye":
        found = cv2.fisheye.stereoCalibrate(*arguments, flags=_FISHEYE.CALIB_FIX_INTRINSIC)
    else:
        found = cv2.stereoCalibrate(*arguments, flags=cv2.CALIB_FIX_INTRINSIC)
    rms_px, R, t = found[0], found[5], found[6]
    return R, np.ravel(t), Pair(films[0].name, films[1].name, len(first_px), float(rms_px))


def _consistent(
    first_px: Float[np.ndarray, "V N 2"],
    second_px: Float[np.ndarray, "V N 2"],
    cameras: tuple[Camera, Camera],
    board: Board,
) -> tuple[Float[np.ndarray, "W N 2"], Float[np.ndarray, "W N 2"]]:
    """Return the views that agree on one relative pose, with the corners of both cameras in one order.

    Each view, and each order of its corners in the second camera, proposes a relative pose. The best proposal has the
    smallest median error over all views, if each view takes its best order. The second camera is its own world.
    """
    first, second = cameras
    ordered_px = np.stack([second_px[:, order] for order in board.orders])
    poses = [_board_pose(first, px, board) for px in first_px]
    points_first = np.stack([board.corners @ R.T + t for R, t in poses])
    best_px = np.full(len(first_px), np.inf)
    best_order = np.zeros(len(first_px), int)
    for v, (R_first, t_first) in enumerate(poses):
        for px in ordered_px[:, v]:
            R_second, t_second = _board_pose(second, px, board)
            R = R_second @ R_first.T
            shown_px = second.project((points_first - t_first) @ R.T + t_second)
            error_px = _rms(shown_px - ordered_px)
            if np.median(error_px.min(axis=0)) < np.median(best_px):
                best_px, best_order = error_px.min(axis=0), error_px.argmin(axis=0)
    agrees = best_px <= _OUTLIER * np.median(best_px)
    return first_px[agrees], ordered_px[best_order, np.arange(len(first_px))][agrees]


def _board_pose(camera: Camera, corners_px: Float[np.ndarray, "N 2"], board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation and translation (squares) from the board to the camera."""
    solve = cv2.fisheye.solvePnP if camera.lens == "fisheye" else cv2.solvePnP
    _, turn, place = solve(board.corners[:, None], corners_px[:, None], camera.matrix, camera.distortion)
    return cv2.Rodrigues(turn)[0], np.ravel(place)


def _common(first: BoardViews, second: BoardViews) -> Int[np.ndarray, "2 C"]:
    """Return the places of the frames in which both cameras see the board."""
    return np.stack(np.intersect1d(first.frames, second.frames, return_indices=True)[1:])


def _shapes(views: BoardViews) -> Float[np.ndarray, "F N*2"]:
    """Return one vector for each view; their distance is the RMS distance of the corners, in picture diagonals."""
    scale = np.hypot(*views.size_px) * np.sqrt(views.corners_px.shape[1])
    return views.corners_px.reshape(len(views.frames), -1) / scale


def _different(shapes: Float[np.ndarray, "F D"]) -> list[int]:
    """Return the places of at most `MAX_VIEWS` views, each as far as possible from the others."""
    chosen, distance = [0], np.full(len(shapes), np.inf)
    while len(chosen) < MAX_VIEWS:
        distance = np.minimum(distance, np.linalg.norm(shapes - shapes[chosen[-1]], axis=1))
        farthest = int(distance.argmax())
        if distance[farthest] < _DIFFERENT:
            break
        chosen.append(farthest)
    return sorted(chosen)


def _rms(difference_px: Float[np.ndarray, "*B N 2"]) -> Float[np.ndarray, "*B"]:
    """Return the RMS distance of the corners; infinite for corners behind the camera."""
    return np.nan_to_num(np.sqrt((difference_px**2).sum(axis=-1).mean(axis=-1)), nan=np.inf)


def _as_lists(corners_px: Float[np.ndarray, "V N 2"], board: Board) -> tuple[Any, Any]:
    """Return the corners of the board and their pixels, as OpenCV takes them: one array for each view."""
    points = board.corners[None].astype(np.float32)
    return [points] * len(corners_px), list(corners_px[:, None].astype(np.float32))


def _coverage(corners_px: Float[np.ndarray, "V N 2"], size_px: tuple[int, int]) -> float:
    """Return the share of the picture that lies within the corners of a board."""
    factor = _COVERAGE_SIDE_PX / max(size_px)
    width, height = (max(1, round(factor * side)) for side in size_px)
    covered = np.zeros((height, width), np.uint8)
    for corners in corners_px:
        cv2.fillConvexPoly(covered, cv2.convexHull((factor * corners).astype(np.int32)), 1)
    return float(covered.mean())
