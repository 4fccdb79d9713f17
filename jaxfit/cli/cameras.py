"""`cameras show`."""

from __future__ import annotations

import argparse
from itertools import combinations

import numpy as np

from jaxfit.cameras.camera import Camera
from jaxfit.cameras.files import read_camera_file
from jaxfit.cli.tables import counted, right_aligned, show
from jaxfit.foundation.files import check_new_file


def show_cameras(options: argparse.Namespace) -> None:
    """Print a table of the cameras, and draw a plan of them."""
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
