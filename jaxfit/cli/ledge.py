"""`ledge`, and `fit --ledge`: the birds of a result on the ledge that they stand on."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxfit.cli.tables import right_aligned, show
from jaxfit.foundation.errors import InputError, counted

if TYPE_CHECKING:
    from jaxfit.cameras.camera import Camera
    from jaxfit.data.solution import Solution
    from jaxfit.data.views import Views
    from jaxfit.fitting.ledge_plane import Distances
    from jaxfit.model.bird import Bird

WORLD, BIRDS = "world", "birds"


class OnLedge(NamedTuple):
    """A result on its ledge."""

    solution: Solution
    cameras: tuple[Camera, ...]
    """The cameras as they film, in the world of the ledge."""
    facts: dict[str, Any]
    """Entry of `summary.json`."""


def check_ledge_options(options: argparse.Namespace, bird: Bird) -> None:
    """Raise InputError if the options of a ledge do not belong together; before the long work."""
    plane, focal_px, cameras = options.ledge, options.focal_px, options.cameras
    if focal_px is not None and not 0 < focal_px < np.inf:
        raise InputError("--focal-px", f"is {focal_px}", "give the focal length in image pixels, above 0")
    if focal_px is not None and (cameras is not None or plane is None):
        problem = "is given with --cameras" if cameras is not None else "is given without --ledge"
        raise InputError("--focal-px", problem, "leave out one of them" if cameras is not None else "add --ledge")
    if cameras is None and options.unit is not None:
        raise InputError("--unit", "is given without --cameras", "give the calibrated camera by --cameras")
    if plane == WORLD and cameras is None:
        raise InputError(
            "plane of the ledge", "is that of a world without --cameras", "give the calibrated camera by --cameras"
        )
    if plane not in (None, WORLD, BIRDS) and not Path(plane).is_file():
        problem = f"is {plane}, which is no file"
        raise InputError("plane of the ledge", problem, "give birds, world, or a table of measured distances")
    if plane is None:
        return
    from jaxfit.fitting.ledge import metres
    from jaxfit.fitting.ledge_plane import read_distances

    if len(getattr(options, "observations", [])) < 2:  # several cameras measure the size of a bird
        metres(bird)
    if plane not in (WORLD, BIRDS):
        read_distances(Path(plane))


def place(options: argparse.Namespace, solution: Solution, bird: Bird, views: Views | None, source: object) -> OnLedge:
    """Return a result on its ledge.

    Args:
        options: `ledge` and `focal_px`.
        solution: the poses, of one camera or of several.
        bird: the model.
        views: the calibrated cameras; None without.
        source: name of the result in error messages.
    """
    from jaxfit.cameras.camera import Camera
    from jaxfit.data.world import largest_image_px
    from jaxfit.fitting.ledge import on_ledge
    from jaxfit.fitting.ledge_plane import estimate_ledge, plane_of, read_distances

    count = 0 if views is None else len(views.cameras)
    several = count > 1
    camera: Camera | None = None
    if views is not None:
        # poses of several views are in the pixels of the first lens
        camera = views.lenses[0].pinhole() if several else views.cameras[0]
    elif options.focal_px is not None:
        width, height = largest_image_px(solution)
        matrix = np.array([[options.focal_px, 0, width / 2], [0, options.focal_px, height / 2], [0, 0, 1]])
        camera = Camera("camera", matrix, np.zeros(0), np.eye(3), np.zeros(3), (width, height))
    if options.ledge == WORLD and camera is not None:
        found = plane_of(camera, source)
    else:
        distances = None if options.ledge == BIRDS else read_distances(Path(options.ledge))
        if distances is not None and views is not None and camera is not None:
            distances = _undistorted(distances, views.lenses[0], camera, options.ledge)
        found = estimate_ledge(solution, bird, camera, distances, source)
    new, lenses = found.camera, [found.camera]
    if views is not None and camera is not None:
        R = new.R_cam_world.T @ camera.R_cam_world
        transl = new.R_cam_world.T @ (camera.transl_cam - new.transl_cam)
        lenses = [lens.moved(R, transl) for lens in views.lenses]
    placed = on_ledge(solution, bird, new, lenses[0], known_sizes=several)
    given = "given" if camera is not None else "estimated"
    return OnLedge(placed, tuple(lenses), {"plane": str(options.ledge), "focal_length": given} | found.facts)


def _undistorted(distances: Distances, lens: Camera, camera: Camera, source: object) -> Distances:
    """Return distances measured in the picture of a lens, in the pixels of the same camera without distortion."""
    if not lens.inside(distances.points_px).all():
        raise InputError(source, "has a point outside the picture", "give positions in image pixels")
    points_px = lens.undistort(distances.points_px) + camera.matrix[:2, 2] - lens.matrix[:2, 2]
    if not np.isfinite(points_px).all():
        raise InputError(source, "has a point that the lens model does not hold for", "measure nearer to the middle")
    return distances._replace(points_px=points_px)


def place_if_wanted(
    options: argparse.Namespace, solution: Solution, bird: Bird, views: Views | None, source: object
) -> tuple[OnLedge | None, InputError | None]:
    """Return a result on its ledge if the options ask for it, or why not, so that a fit is not lost."""
    if options.ledge is None:
        return None, None
    try:
        return place(options, solution, bird, views, source), None
    except InputError as error:
        problem = f"{error.problem}; the result was written without a ledge"
        return None, InputError(error.source, problem, error.remedy)


def show_ledge(facts: dict[str, Any]) -> None:
    """Print where the camera is above the ledge."""

    def measured(name: str, sd: str, digits: int) -> str:
        spread = f" ± {facts[sd]:,.{digits}f}" if facts.get(sd) else ""
        return f"{facts[name]:,.{digits}f}{spread}"

    focal = measured("focal_px", "focal_sd_px", 0)
    show(
        f"camera {measured('height_m', 'height_sd_m', 2)} m above the ledge, looks "
        f"{measured('below_horizontal_deg', 'tilt_sd_deg', 1)}° below the horizontal; "
        f"focal length {focal} px ({facts['focal_length']})"
    )
    if "birds" in facts:
        size = measured("size", "size_sd", 3)
        show(f"from {counted(facts['birds'], 'bird')} on it; mean size {size} relative to the model; ± is one sd")


def show_world(solution: Solution) -> None:
    """Print the table of a fit in the world."""
    on_ledge = solution.contact is not None
    table = right_aligned(
        "bird", "frames", *(["on ledge"] if on_ledge else []), "size", "x, y, z m", "moved m", "status"
    )
    for n, track in enumerate(solution.track_id.tolist()):
        valid = solution.valid[n]
        if not valid.any():
            table.add_row(str(track), "0", *([""] if on_ledge else []), "", "", "", str(solution.status[n]))
            continue
        assert solution.world is not None
        places = solution.world.transl_world_m[n, valid]
        moved_m = np.linalg.norm(places.max(axis=0) - places.min(axis=0))
        where = ", ".join(f"{x:.2f}" for x in np.median(places, axis=0))
        size = f"{np.median(solution.poses.scale[n, valid]):.3f}"
        standing = [] if solution.contact is None else [f"{100 * np.mean(solution.contact[n, valid] > 0.5):.0f} %"]
        status = str(solution.status[n])
        table.add_row(str(track), str(int(valid.sum())), *standing, size, where, f"{moved_m:.2f}", status)
    table.title = "size: relative to the model; x, y, z: median place of the root joint; moved: extent of its places"
    show(table)


def ledge(options: argparse.Namespace) -> None:
    """Place the birds of a result on the ledge that they stand on, and write a new result."""
    from jaxfit.cameras.files import write_cameras
    from jaxfit.config.reconstruct import ReconstructConfig
    from jaxfit.data.result_folder import CAMERAS, LEARNT, OBSERVATIONS, POSES, read_summary
    from jaxfit.data.solution import load_solution, write_solution
    from jaxfit.foundation.files import check_replaceable, new_folder
    from jaxfit.review.correct import read_config

    check_replaceable(options.out, options.overwrite, POSES)
    if options.out.resolve() == options.result.resolve():
        raise InputError(options.out, "is the result itself, which stays as it is", "choose another --out")
    solution, bird = load_solution(options.result)
    check_ledge_options(options, bird)
    if solution.world is not None:
        remedy = "fit its observations again with --ledge, and with the same --cameras if there were any"
        raise InputError(options.result, "is in a world already", remedy)
    summary = read_summary(options.result)
    if summary.get("photographs"):
        raise InputError(options.result, "holds photographs, which show no common ledge", "give the result of a video")
    if not solution.valid.any():
        raise InputError(options.result, "holds no valid pose", "see the status of each track")
    config, config_text = read_config(options.result)
    views = _one_camera(options, solution)
    done = place(options, solution, bird, views, options.result)
    summary["ledge"] = done.facts
    with new_folder(options.out, options.overwrite, marker=POSES) as part:
        for name in (OBSERVATIONS, LEARNT):
            if (options.result / name).is_file():
                shutil.copyfile(options.result / name, part / name)
        write_solution(done.solution, bird, config_text, summary, part)
        write_cameras(done.cameras, part / CAMERAS)
    show_ledge(done.facts)
    edge = config.fit.edge if isinstance(config, ReconstructConfig) else config.edge
    if edge != "unbiased" and options.ledge == BIRDS:
        show("the config of this result makes birds 5 to 8 % too small in the picture, and distances too large:")
        show("fit again with --ledge, which uses `edge: unbiased`, or give measured distances")
    show_world(done.solution)
    show(f"{counted(len(solution.track_id), 'bird')} on the ledge → {options.out}")


def _one_camera(options: argparse.Namespace, solution: Solution) -> Views | None:
    from jaxfit.cameras.files import read_camera_file
    from jaxfit.data.views import Views
    from jaxfit.data.world import largest_image_px

    if options.cameras is None:
        return None
    cameras: Sequence[Camera] = read_camera_file(options.cameras, options.unit).cameras
    if len(cameras) != 1:
        problem = f"has {counted(len(cameras), 'camera')}"
        raise InputError(options.cameras, problem, "give a file with the camera of this result alone")
    (camera,) = cameras
    if not camera.is_pinhole:
        problem = f"gives camera {camera.name} a distorted lens, but the result was fitted without a lens"
        raise InputError(options.cameras, problem, "fit the observations again with --cameras and --ledge")
    size = largest_image_px(solution)
    if camera.size_px not in (None, size):
        own, other = (f"{w}×{h}" for w, h in (camera.size_px or size, size))
        problem = f"has images of {own}, but the result has {other}"
        raise InputError(options.cameras, problem, "calibrate with the size of the video")
    camera = replace(camera, size_px=size)
    return Views((camera,), (camera,), ())
