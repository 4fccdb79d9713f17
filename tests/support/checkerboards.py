"""Pictures of a checkerboard that a known camera films: ray casting, independent of OpenCV's projection."""

import numpy as np
from scipy.interpolate import RectBivariateSpline

SAMPLES = 3
"""Rays of a pixel in each direction."""


def distorted(plane, distortion):
    """Return points of the plane z = 1 after the distortion k1, k2, p1, p2, k3, or k1 to k4 of a fisheye lens."""
    x, y = plane[..., 0], plane[..., 1]
    if len(distortion) == 4:
        r = np.hypot(x, y)
        theta = np.arctan(r)
        bent = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(distortion)))
        return plane * (bent / np.maximum(r, 1e-12))[..., None]
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def project(points_cam, matrix, distortion):
    """Project points of the camera frame to pixels, with pixel centres at i + 0.5."""
    return distorted(points_cam[..., :2] / points_cam[..., 2:], distortion) @ matrix[:2, :2].T + matrix[:2, 2]


def rays(matrix, distortion, size_px):
    """Return the points of the plane z = 1 that the samples of every pixel show: fixed-point iteration, and splines."""
    ends = [np.linspace(0, side, 65) for side in size_px]
    target = (np.stack(np.meshgrid(*ends), axis=-1) - matrix[:2, 2]) / [matrix[0, 0], matrix[1, 1]]
    plane = target.copy()
    for _ in range(60):
        plane += target - distorted(plane, distortion)
    u, v = (np.arange(side * SAMPLES) / SAMPLES + 0.5 / SAMPLES for side in size_px)
    return np.stack([RectBivariateSpline(ends[1], ends[0], plane[..., i])(v, u) for i in range(2)], axis=-1)


def board_poses(rng, count, board, cameras, size_px, depth=(12, 22)):
    """Return random poses of a board in the world: all cameras see them, and the tilt is 45 degrees or less.

    Args:
        rng: generator of random numbers.
        count: number of poses.
        board: inner corners of a row and of a column.
        cameras: of each camera matrix, distortion, and rotation and translation from the world, which is the first
            camera.
        size_px: width and height of all pictures.
        depth: range of the depth of the board's middle, squares.

    Returns:
        Rotation from the board to the world, and the place of the board's middle, of each pose.
    """
    poses = []
    while len(poses) < count:
        axis = rng.normal(size=3) * [1, 1, 0.5]
        R = rotation(axis / np.linalg.norm(axis) * np.radians(rng.uniform(5, 45)))
        z = rng.uniform(*depth)
        middle = np.array([*rng.uniform(-0.5, 0.5, 2) * z, z])
        seen = []
        for matrix, distortion, R_cam, transl in cameras:
            outline = corners((board[0] + 2, board[1] + 2), R_cam @ R, R_cam @ middle + transl)
            shown = project(outline, matrix, distortion)
            seen.append((outline[:, 2] > 1).all() and (shown > 1).all() and (shown < np.array(size_px) - 1).all())
        if all(seen):
            poses.append((R, middle))
    return poses


def rotation(vector):
    """Return the rotation matrix of an axis-angle vector, by Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    x, y, z = np.asarray(vector) / max(angle, 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def corners(board, R, middle):
    """Return the inner corners of a board with COLSxROWS inner corners and squares of side 1, in the camera frame."""
    columns, rows = board
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) @ R.T + middle


def picture(plane, lens, board, R, middle):
    """Return the picture of a board with a white margin before grey, blue–green–red.

    Args:
        plane: `rays` of the lens.
        lens: matrix and distortion.
        board: inner corners of a row and of a column.
        R: rotation from the board to the camera.
        middle: middle of the board in the camera frame.
    """
    columns, rows = board
    height, width = (side // SAMPLES for side in plane.shape[:2])
    outline = project(corners((columns + 4, rows + 4), R, middle), *lens)
    (left, top), (right, bottom) = (
        np.clip(end, 0, [width, height]).astype(int) for end in (outline.min(0), outline.max(0))
    )
    plane = plane[top * SAMPLES : bottom * SAMPLES, left * SAMPLES : right * SAMPLES]
    normal = R[:, 2]
    depth = (normal @ middle) / (plane @ normal[:2] + normal[2])
    x, y = ((plane @ axis[:2] + axis[2]) * depth - axis @ middle for axis in (R[:, 0], R[:, 1]))
    # squares of the board count from 0 at its upper left
    column, row = np.floor(x + (columns + 1) / 2), np.floor(y + (rows + 1) / 2)
    on_board = (column >= 0) & (column <= columns) & (row >= 0) & (row <= rows)
    on_margin = (column >= -1) & (column <= columns + 1) & (row >= -1) & (row <= rows + 1)
    grey = np.where(on_board, np.where((column + row) % 2 == 0, 30.0, 225.0), np.where(on_margin, 225.0, 110.0))
    full = np.full((height, width, 3), 110, np.uint8)
    grey = grey.reshape(bottom - top, SAMPLES, right - left, SAMPLES).mean(axis=(1, 3))
    full[top:bottom, left:right] = grey.round().astype(np.uint8)[..., None]
    return full
