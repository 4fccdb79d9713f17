"""`on_ledge`: the birds of a fit in a world whose plane z = 0 is the ledge that they stand on.

A fit of one camera knows the direction of every bird, its orientation and its size in the picture, but not its
distance. The ledge gives the distance: a bird that stands has its feet on the ledge. World: z up, metres.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxfit.cameras.camera import Camera
from jaxfit.config.fit import FitConfig
from jaxfit.data.projection import InImage, in_image
from jaxfit.data.solution import Solution
from jaxfit.data.world import largest_image_px, whole_picture, world_arrays
from jaxfit.fitting.contacts import SLOW, feet_cam, find_contacts, interval_of, speed_lengths
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird


def ledge_config(config: FitConfig) -> FitConfig:
    """Return a config whose silhouettes do not bias the size of the birds, and with it their distances."""
    return replace(config, edge="unbiased", unknown_pixels=True)


def on_ledge(
    solution: Solution, bird: Bird, camera: Camera, lens: Camera | None = None, known_sizes: bool = False
) -> Solution:
    """Return the poses of one camera in a world whose plane z = 0 is the ledge.

    A bird that moves along the viewing ray, and grows with its distance, looks the same. So the plane moves every bird
    along its ray: with a foot on the plane where it stands, with its own size where it flies, and between them in
    proportion to the probability that it stands (`fitting.contacts`).

    Args:
        solution: poses in crops, or in the whole picture of `camera`.
        bird: the model, with its unit of length.
        camera: the camera without distortion, in the world of the ledge.
        lens: the same camera as it films; None: `camera`.
        known_sizes: whether several cameras know the places and sizes of the birds, which stay as they are.

    Returns:
        Poses in the frame of the camera, whose crop is the whole picture, with the arrays `data.solution.WORLD` and
        `contact`. The size of a bird is its true size.
    """
    s, unit_m, interval_s = solution, metres(bird), interval_of(solution)
    lens = lens or camera
    placed = in_image(s, bird, float(camera.matrix[0, 0]), tuple(camera.matrix[:2, 2]))
    up, height = camera.R_cam_world[:, 2], float(camera.position_world[2]) / unit_m
    low = np.array([_lowest(s, bird, placed, up, n) for n in range(len(s.track_id))]).reshape(s.valid.shape)
    with np.errstate(all="ignore"):
        log_size = np.where(low < 0, np.log(height / -low), np.inf)
    log_size = np.where(s.valid, log_size, np.nan)
    speed = speed_lengths(s, bird, interval_s)
    known = log_size[np.isfinite(log_size) & (np.nan_to_num(speed) < SLOW)]
    contacts = find_contacts(log_size, speed, interval_s, float(np.median(known)) if known.size else 0.0)
    p, standing = np.nan_to_num(contacts.probability), np.where(np.isfinite(log_size), log_size, 0)
    k = np.ones_like(p) if known_sizes else np.exp(p * standing + (1 - p) * contacts.log_size[:, None])
    return _in_world(s, bird, placed, k, camera, lens, contacts.probability, unit_m)


def _in_world(
    solution: Solution,
    bird: Bird,
    placed: InImage,
    factor: Float[np.ndarray, "N T"],
    camera: Camera,
    lens: Camera,
    contact: Float[np.ndarray, "N T"],
    unit_m: float,
) -> Solution:
    """Return the solution in the frame of the whole picture, with all birds moved along their rays by a factor."""
    s, joint = solution, np.asarray(bird.joints[0], np.float64)
    scale, root = factor * placed.size, factor[..., None] * placed.root
    growth = scale / s.scale
    points = factor[..., None, None] * placed.points(s.keypoints_cam.astype(np.float64), s.scale.astype(np.float64))
    world = world_arrays(camera, unit_m, placed.orientation, root, points)
    turned = {}
    for name in ("keypoints_cam_cov", "keypoints_centred_cov"):
        if (covariance := getattr(s, name)) is not None:
            turn = placed.turn[:, :, None] * growth[..., None, None, None]
            turned[name] = (turn @ covariance @ turn.swapaxes(-1, -2)).astype(np.float32)
    for name in ("transl_sd", "scale_sd"):
        if (deviation := getattr(s, name)) is not None:
            turned[name] = (deviation * growth.reshape(*growth.shape, *(1,) * (deviation.ndim - 2))).astype(np.float32)
    return replace(
        s,
        **turned,
        **world,
        **whole_picture(lens, s.valid, largest_image_px(s)),
        global_orient=placed.orientation.astype(np.float32),
        transl=(root - scale[..., None] * joint).astype(np.float32),
        scale=scale.astype(np.float32),
        keypoints_cam=points.astype(np.float32),
        keypoints_px=np.nan_to_num(lens.project(world["keypoints_world_m"])).astype(np.float32),
        contact=contact.astype(np.float32),
    )


def _lowest(solution: Solution, bird: Bird, placed: InImage, up: np.ndarray, n: int) -> Float[np.ndarray, "T"]:
    """Return the height of the lower foot of a track relative to the camera, model units, before it is moved."""
    one = InImage(placed.focal_px, *(values[n : n + 1] for values in placed[1:]))
    return (one.points(feet_cam(solution, bird, n), solution.scale[n : n + 1]) @ up).min(axis=-1)[0]


def metres(bird: Bird) -> float:
    """Return the length of a model unit in metres.

    Raises:
        InputError: the model has none.
    """
    if bird.metres_per_unit is None:
        remedy = "import the model again with `metres_per_unit`, or use a model of your species (docs/guide/species.md)"
        raise InputError(f"model {bird.name}", "has no unit of length, which a world in metres needs", remedy)
    return bird.metres_per_unit
