"""`cameras calibrate`: rendered films of a checkerboard, and exact corners, against the cameras that filmed them."""

import numpy as np
import pytest
from support import checkerboards

from jaxfit.cameras.calibrate import (
    MAX_VIEWS,
    MIN_VIEWS,
    Board,
    BoardViews,
    Lens,
    _coverage,
    calibrate_cameras,
    calibrate_lens,
    find_boards,
    find_corners,
)
from jaxfit.cameras.camera import Camera
from jaxfit.cameras.files import read_camera_file
from jaxfit.cli.calibrate import _show_lenses, _show_pairs
from jaxfit.cli.main import main
from jaxfit.foundation.errors import InputError
from jaxfit.video.writer import VideoWriter

SIZE = (640, 480)
CORNERS_PX = [(x, y) for x in (0, SIZE[0]) for y in (0, SIZE[1])]
BOARD = Board(9, 6, 0.025)
LEFT = np.array([[560.0, 0, 329], [0, 556, 236], [0, 0, 1]]), np.array([-0.25, 0.08, 0.001, -0.0008, -0.01])
RIGHT = np.array([[600.0, 0, 312], [0, 603, 247], [0, 0, 1]]), np.array([-0.12, 0.05, -0.0006, 0.001, 0.0])
THIRD = np.array([[530.0, 0, 318], [0, 531, 243], [0, 0, 1]]), np.array([-0.2, 0.04, 0.0, 0.0, 0.0])
FISHEYES = (
    (np.array([[290.0, 0, 329], [0, 288, 236], [0, 0, 1]]), np.array([0.03, -0.01, 0.004, -0.001])),
    (np.array([[300.0, 0, 312], [0, 301, 247], [0, 0, 1]]), np.array([-0.02, 0.01, -0.003, 0.0005])),
)
WORLD = np.eye(3), np.zeros(3)
MOVED = checkerboards.rotation([0.05, -0.5, 0.1]), np.array([8.0, -0.5, 3.0])
"""Pose of the second camera: rotation and translation from the first camera, in squares."""
FARTHER = checkerboards.rotation([0.0, 0.4, 0.0]), np.array([-7.0, 0.3, 2.0])


def pixel_error_px(camera, matrix, distortion, radius_px=np.inf):
    """Return the errors of a lens in pixels, at a grid of pixels of the whole picture, or of its middle.

    The errors are those of the rays, times the focal length, after the rotation that fits best: the poses of the boards
    absorb a rotation of the camera, which looks like a shift of its principal point.
    """
    middle, step = checkerboards.SAMPLES // 2, 40 * checkerboards.SAMPLES
    v, u = np.mgrid[0 : SIZE[1] : 40, 0 : SIZE[0] : 40] + 0.5
    inside = np.hypot(u - SIZE[0] / 2, v - SIZE[1] / 2) < radius_px
    plane = checkerboards.rays(matrix, distortion, SIZE)[middle::step, middle::step][inside]
    truth = np.c_[plane, np.ones(len(plane))]
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    found = camera.rays_cam(np.stack([u[inside], v[inside]], axis=-1))
    U, _, V = np.linalg.svd(found.T @ truth)
    return matrix[0, 0] * np.linalg.norm(found @ (U @ V) - truth, axis=1)


def views(name, lens, pose, poses, board=BOARD[:2], noise_px=0.1, frames=None):
    """Return the exact corners of boards with noise, in the order in which a board is drawn."""
    rng = np.random.default_rng(sum(map(ord, name)))
    shown = np.stack(
        [
            checkerboards.project(checkerboards.corners(board, pose[0] @ R, pose[0] @ m + pose[1]), *lens)
            for R, m in poses
        ]
    )
    shown += rng.normal(0, noise_px, shown.shape)
    numbers = np.arange(len(poses)) if frames is None else np.array(frames)
    return BoardViews(name, f"{name}.mp4", SIZE, numbers, shown)


def check_pose(camera, pose, degrees=0.3, share=0.01):
    """Check the pose of a camera in the frame of the first camera, with a share of the baseline as tolerance."""
    R, transl = pose
    angle = np.degrees(np.arccos(np.clip((np.trace(camera.R_cam_world @ R.T) - 1) / 2, -1, 1)))
    assert angle < degrees
    error_m = np.linalg.norm(camera.transl_cam - transl * BOARD.square_m)
    assert error_m < share * np.linalg.norm(transl) * BOARD.square_m


def check_lens(camera, matrix, distortion, radius_px=np.inf):
    focal, centre = np.diag(camera.matrix)[:2], camera.matrix[:2, 2]
    np.testing.assert_allclose(focal, np.diag(matrix)[:2], rtol=0.01)
    np.testing.assert_allclose(centre, matrix[:2, 2], atol=3)
    assert pixel_error_px(camera, matrix, distortion, radius_px).max() < 0.5


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    """Two films of one board, with frames in which one camera sees the board near the edge of its picture."""
    folder = tmp_path_factory.mktemp("films")
    rng = np.random.default_rng(3)
    rig = [(*LEFT, *WORLD), (*RIGHT, *MOVED)]
    common = checkerboards.board_poses(rng, 10, BOARD[:2], rig, SIZE)
    for i, (name, (matrix, distortion, R_cam, transl)) in enumerate(zip(("left", "right"), rig, strict=True)):
        rays, lens = checkerboards.rays(matrix, distortion, SIZE), (matrix, distortion)
        alone = checkerboards.board_poses(rng, 150, BOARD[:2], [(*lens, *WORLD)], SIZE)
        shown = np.stack([checkerboards.project(checkerboards.corners(BOARD[:2], *pose), *lens) for pose in alone])
        ends = [np.linalg.norm(shown - end, axis=-1).min(axis=1).argmin() for end in CORNERS_PX]
        with VideoWriter(folder / f"{name}.mp4", SIZE, 25) as film:
            for R, m in common:
                film.write(checkerboards.picture(rays, lens, BOARD[:2], R_cam @ R, R_cam @ m + transl))
            for pose in [alone[end] for end in ends]:
                pictures = [
                    checkerboards.picture(rays, lens, BOARD[:2], *pose),
                    np.full((*SIZE[::-1], 3), 110, np.uint8),
                ]
                for picture in pictures[:: 1 - 2 * i]:
                    film.write(picture)
    return folder


def test_films_of_a_board_give_the_cameras(films, capsys):
    out = films / "cameras.toml"
    command = ["cameras", "calibrate", str(films / "left.mp4"), str(films / "right.mp4"), "--board", "9x6"]
    command += ["--square-mm", str(1000 * BOARD.square_m), "--out", str(out)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "left, right" in printed
    assert "share of the picture" in printed
    file = read_camera_file(out)
    assert (file.format, file.unit, file.unit_assumed) == ("anipose", "m", False)
    left, right = file.cameras
    assert (left.name, right.name, left.size_px) == ("left", "right", SIZE)
    for camera, lens in ((left, LEFT), (right, RIGHT)):
        check_lens(camera, *lens)
    np.testing.assert_array_equal(left.R_cam_world, np.eye(3))
    check_pose(right, MOVED)
    assert main(command) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_corners_have_pixel_centres_at_a_half():
    """A picture of 1440 pixels is searched at 1280 pixels, and refined in all its pixels."""
    factor = 2.25
    matrix = LEFT[0] * [[factor], [factor], [1]]
    rays = checkerboards.rays(matrix, LEFT[1], tuple(int(factor * side) for side in SIZE))
    R, middle = checkerboards.rotation([0.3, -0.4, 0.1]), np.array([1.5, -1.0, 14.0])
    found = find_corners(checkerboards.picture(rays, (matrix, LEFT[1]), BOARD[:2], R, middle), BOARD)
    truth = checkerboards.project(checkerboards.corners(BOARD[:2], R, middle), matrix, LEFT[1])
    errors = min((found - truth, found[::-1] - truth), key=lambda error: np.abs(error).max())
    assert np.abs(errors).max() < 0.2
    assert np.abs(errors.mean(axis=0)).max() < 0.03


@pytest.mark.parametrize("size", [(8, 6), (6, 6)])
def test_a_board_that_looks_the_same_after_a_turn_gives_the_pose(size):
    board = Board(*size, BOARD.square_m)
    rig = [(*LEFT, *WORLD), (*RIGHT, *MOVED)]
    poses = checkerboards.board_poses(np.random.default_rng(0), 40, size, rig, SIZE)
    left, right = views("left", LEFT, WORLD, poses, size), views("right", RIGHT, MOVED, poses, size)
    rng = np.random.default_rng(1)
    turned = np.stack([px[board.orders[rng.integers(len(board.orders))]] for px in right.corners_px])
    lenses, (pair,) = calibrate_cameras([left, right._replace(corners_px=turned)], board)
    check_pose(lenses[1].camera, MOVED)
    assert pair.views >= 38
    assert pair.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)


def test_fisheye_lenses():
    rig = [(*lens, *pose) for lens, pose in zip(FISHEYES, (WORLD, MOVED), strict=True)]
    poses = checkerboards.board_poses(np.random.default_rng(0), 14, BOARD[:2], rig, SIZE, depth=(6, 12))
    films = [
        views(name, *part, poses) for name, part in zip("ab", zip(FISHEYES, (WORLD, MOVED), strict=True), strict=True)
    ]
    lenses, (pair,) = calibrate_cameras(films, BOARD, fisheye=True)
    for lens, truth in zip(lenses, FISHEYES, strict=True):
        assert (lens.camera.lens, lens.focal_sd_px) == ("fisheye", None)
        check_lens(lens.camera, *truth, radius_px=200)  # few boards reach farther out
        assert lens.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    check_pose(lenses[1].camera, MOVED)
    assert pair.rms_px < 0.3


def test_cameras_are_connected_by_the_pairs_with_most_common_views():
    rng = np.random.default_rng(0)
    second, third = (*RIGHT, *MOVED), (*THIRD, *FARTHER)
    first_two = checkerboards.board_poses(rng, 20, BOARD[:2], [(*LEFT, *WORLD), second], SIZE)
    last_two = checkerboards.board_poses(rng, 20, BOARD[:2], [second, third], SIZE)
    films = [
        views("left", LEFT, WORLD, first_two),
        views("third", THIRD, FARTHER, last_two, frames=range(100, 120)),
        views("right", RIGHT, MOVED, first_two + last_two, frames=[*range(20), *range(100, 120)]),
    ]
    lenses, pairs = calibrate_cameras(films, BOARD)
    assert [(pair.first, pair.second) for pair in pairs] == [("left", "right"), ("right", "third")]
    assert [lens.camera.name for lens in lenses] == ["left", "third", "right"]
    check_pose(lenses[2].camera, MOVED)
    check_pose(lenses[1].camera, FARTHER)
    with pytest.raises(InputError, match=r"third\.mp4: has 0 views of the board at the same time"):
        calibrate_cameras(films[:2], BOARD)


def test_wrong_views_are_dropped():
    rig = [(*LEFT, *WORLD), (*RIGHT, *MOVED)]
    poses = checkerboards.board_poses(np.random.default_rng(0), 21, BOARD[:2], rig, SIZE)
    moved = [*poses[:7], poses[20], *poses[8:20]]  # the board moved between the pictures of the two cameras
    left, right = views("left", LEFT, WORLD, poses[:20]), views("right", RIGHT, MOVED, moved)
    left.corners_px[4] += np.random.default_rng(5).normal(0, 3, left.corners_px[4].shape)
    lenses, (pair,) = calibrate_cameras([left, right], BOARD)
    assert [lens.views for lens in lenses] == [19, 20]
    assert pair.views == 18
    assert lenses[0].rms_px < 0.2
    check_pose(lenses[1].camera, MOVED)
    for i, sd_px in enumerate(lenses[0].focal_sd_px):
        assert abs(lenses[0].camera.matrix[i, i] - LEFT[0][i, i]) < 4 * sd_px < 4


def test_equal_views_count_once():
    poses = checkerboards.board_poses(np.random.default_rng(0), MAX_VIEWS + 5, BOARD[:2], [(*LEFT, *WORLD)], SIZE)
    assert calibrate_lens(views("left", LEFT, WORLD, poses), BOARD).views <= MAX_VIEWS
    still = views("left", LEFT, WORLD, (MIN_VIEWS - 1) * poses[:1] + poses[: MIN_VIEWS - 1])
    with pytest.raises(InputError, match=rf"left\.mp4: has {MIN_VIEWS - 1} different views of the board"):
        calibrate_lens(still, BOARD)


def test_a_pair_needs_different_common_views():
    """A board that lies still where both cameras see it gives one view in common, however many frames show it."""
    rig = [(*LEFT, *WORLD), (*RIGHT, *MOVED)]
    poses = checkerboards.board_poses(np.random.default_rng(0), 21, BOARD[:2], rig, SIZE)
    still, alone = poses[:1] * 10, poses[1:11]
    left = views("left", LEFT, WORLD, still + alone, frames=range(20))
    right = views("right", RIGHT, MOVED, still + alone, frames=[*range(10), *range(30, 40)])
    with pytest.raises(InputError, match=r"right\.mp4: has \d different views of the board in common with left\.mp4"):
        calibrate_cameras([left, right], BOARD)


def test_wrong_views_leave_too_few():
    poses = checkerboards.board_poses(np.random.default_rng(0), MIN_VIEWS, BOARD[:2], [(*LEFT, *WORLD)], SIZE)
    wrong = views("left", LEFT, WORLD, poses)
    wrong.corners_px[4] += np.random.default_rng(5).normal(0, 8, wrong.corners_px[4].shape)
    with pytest.raises(InputError, match=rf"has {MIN_VIEWS - 1} views of the board that agree"):
        calibrate_lens(wrong, BOARD)


def test_a_lens_model_that_does_not_hold_in_the_whole_picture_is_named(capsys):
    camera = Camera("wide", LEFT[0], np.array([-0.9, 0.1, 0, 0, 0]), np.eye(3), np.zeros(3), SIZE)
    _show_lenses([Lens(camera, 20, 0.1, (1.0, 1.0), 0.3)])
    printed = " ".join(capsys.readouterr().out.split())
    assert "% of the picture: wide; try --fisheye" in printed
    assert "boards cover too little of the picture: wide" in printed


def test_coverage_is_the_share_within_the_corners():
    """Two boards that overlap by half, seen straight on; the corners of a board span 8 × 5 squares."""
    lens = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), np.zeros(5)
    poses = [(np.eye(3), np.array([x, 0.0, 20.0])) for x in (-2.0, 2.0)]
    shown = views("left", lens, WORLD, poses, noise_px=0).corners_px
    assert _coverage(shown, SIZE) == pytest.approx(12 * 5 * 30**2 / (640 * 480), rel=0.03)


def test_views_without_a_camera_are_an_error():
    poses = checkerboards.board_poses(np.random.default_rng(0), 10, BOARD[:2], [(*LEFT, *WORLD)], SIZE)
    flat = views("left", LEFT, WORLD, poses)
    flat.corners_px[..., 1] = 100.0  # on one line
    for fisheye in (False, True):
        with pytest.raises(InputError, match=r"left\.mp4: OpenCV finds no .*camera for \d+ views"):
            calibrate_lens(flat, BOARD, fisheye)


def test_films_that_did_not_start_together_have_a_large_error(capsys):
    rig = [(*LEFT, *WORLD), (*RIGHT, *MOVED)]
    poses = checkerboards.board_poses(np.random.default_rng(0), 21, BOARD[:2], rig, SIZE)
    films = [views("left", LEFT, WORLD, poses[1:]), views("right", RIGHT, MOVED, poses[:-1])]
    _show_pairs(*calibrate_cameras(films, BOARD))
    assert "large error: left, right; did the films start together?" in capsys.readouterr().out


def test_films_without_a_board_are_an_error():
    grey = np.full((120, 160, 3), 110, np.uint8)
    with pytest.raises(InputError, match=r"film\.mp4: shows no whole board of 9×6 inner corners in 2 frames .*--board"):
        find_boards("film", "film.mp4", [(0, grey), (5, grey)], BOARD)
    with pytest.raises(InputError, match=r"film\.mp4: its frame 5 is 160×60, but the frames before are 160×120"):
        find_boards("film", "film.mp4", [(0, grey), (5, grey[::2])], BOARD)


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["left.mp4"], ["--board", "9"], "--board: is 9 (give the inner corners as 9x6"),
        (["left.mp4"], ["--board", "2x6"], "--board: is 2x6"),
        (["left.mp4"], ["--square-mm", "0"], "--square-mm: is 0.0"),
        (["left.mp4"], ["--square-mm", "nan"], "--square-mm: is nan"),
        (["left.mp4", "left.mp4"], [], 'second camera with the name "left"'),
        (["missing.mp4"], [], "does not exist"),
    ],
)
def test_wrong_arguments_are_one_line(names, options, message, films, tmp_path, capsys):
    command = ["cameras", "calibrate", *(str(films / name) for name in names), "--board", "9x6", "--square-mm", "25"]
    assert main([*command, *options, "--out", str(tmp_path / "cameras.toml")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())
