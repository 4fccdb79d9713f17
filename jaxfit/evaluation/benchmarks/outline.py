"""Benchmark of the outline of silhouettes: how far they lie outside their mesh, as a whole and by part."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Int

from jaxfit.evaluation.benchmarks.raster import median_seconds
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CROP_PX, CropCamera, to_screen
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_vertices
from jaxfit.model.rotation import view_grid
from jaxfit.raster.silhouette import Backend, mask_loss, silhouette
from jaxfit.raster.silhouette_reference import EDGES, Blur
from jaxfit.raster.zbuffer import hard_mask
from jaxfit.simulation.species import random_pose

PARTS = {"bill": ("jaw",), "legs": ("knee", "ankle", "foot"), "wingtips": ("wrist",)}
"""Part → words in the names of its joints; the body is everything else."""
FINE = 16
"""The area of a mesh is counted on a grid that is this many times finer than a 256-pixel crop."""

Mesh = tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]


def true_outline(
    vertices_screen: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], size: int
) -> tuple[float, float]:
    """Return the area (px²) and the perimeter (px) of a mesh in an image of `size` pixels."""
    fine = vertices_screen * np.array([FINE, FINE, 1], np.float32)
    mask = hard_mask(fine.astype(np.float32), faces, FINE * size, FINE * size)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    # the staircase of the pixels is no part of the perimeter
    lengths = (cv2.arcLength(cv2.approxPolyDP(each, 2, True), True) for each in contours)
    return float(mask.sum()) / FINE**2, sum(lengths) / FINE


def outline_excess(
    vertices_screen: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    outline: tuple[float, float],
    size: int,
    blur: Blur,
    backend: Backend = "auto",
) -> float:
    """Return the mean distance by which a silhouette lies outside its mesh, in pixels.

    This is the area of the silhouette minus the area of the mesh, over the perimeter; `outline` holds area and
    perimeter (`true_outline`). The mesh must lie in the image.
    """
    area, perimeter = outline
    image = silhouette(jnp.asarray(vertices_screen), jnp.asarray(faces), size, blur=blur, backend=backend)
    return (float(image.sum()) - area) / perimeter


def posed_meshes(bird: Bird, count: int) -> list[Mesh]:
    """Return a bird in random poses and views, centred in a 256-pixel crop, with room for the filter."""
    rig, camera, faces = fold_bird(bird), CropCamera(), np.asarray(bird.faces, np.int32)
    views = view_grid(count, 1)
    meshes = []
    for n in range(count):
        pose = random_pose(bird, np.random.default_rng(n), spread=1.0)
        points = np.asarray(posed_vertices(rig, joint_transforms(rig, pose), pose)) @ views[n].T
        meshes.append((_centred(points, camera), faces))
    return meshes


def ball_mesh() -> Mesh:
    """Return a sphere, centred in a 256-pixel crop."""
    ball = trimesh.creation.icosphere(4)
    return _centred(np.asarray(ball.vertices), CropCamera()), np.asarray(ball.faces, np.int32)


def _centred(points: Float[np.ndarray, "V 3"], camera: CropCamera) -> Float[np.ndarray, "V 3"]:
    points = points - (points.min(0) + points.max(0)) / 2
    depth = camera.focal_px * np.abs(points[:, :2]).max() / (0.42 * CROP_PX)
    return np.asarray(to_screen(jnp.asarray(points + np.array([0, 0, depth])), camera), np.float32)


def faces_of_parts(bird: Bird) -> dict[str, Int[np.ndarray, "F 3"]]:
    """Return the faces of the whole bird and of its parts: a face belongs to the part of all its vertices."""
    main, faces = np.asarray(bird.skin_weights).argmax(axis=1), np.asarray(bird.faces, np.int32)
    part = np.full(len(main), "body", object)
    for name, words in PARTS.items():
        joints = [j for j, joint in enumerate(bird.joint_names) if any(word in joint for word in words)]
        part[np.isin(main, joints)] = name
    chosen = {name: faces[(part[faces] == name).all(axis=1)] for name in (*PARTS, "body")}
    return {"whole": faces} | {name: own for name, own in chosen.items() if len(own)}


def bench_outline(
    birds: Mapping[str, Bird],
    sizes: Sequence[int] = (128, 256, 512),
    blurs: Sequence[float] = (1.0, 0.75, 0.45),
    poses: int = 4,
    timed: bool = True,
) -> dict[str, Any]:
    """Measure by how many pixels silhouettes lie outside their mesh, for both kinds of edges.

    Args:
        birds: name → model. A sphere is measured, too.
        sizes: sides of the crops, pixels.
        blurs: blurs relative to the paper's.
        poses: number of random poses and views of each bird.
        timed: whether to measure the time of loss and gradient at 256 pixels and blur 1.

    Returns:
        name → `EDGE, blur B, SIZE px` → part → mean excess in pixels of the crop, over the poses; the part
        `whole, largest` is the largest absolute value of a pose. With `timed` also `ms_per_frame` → edge → median.
    """
    shapes = {
        name: [(mesh, faces_of_parts(bird)) for mesh in posed_meshes(bird, poses)] for name, bird in birds.items()
    }
    ball = ball_mesh()
    shapes["sphere"] = [(ball, {"whole": ball[1]})]
    result: dict[str, Any] = {}
    for name, meshes in shapes.items():
        excess: dict[str, dict[str, list[float]]] = {}
        for (vertices, _), parts in meshes:
            for part, faces in parts.items():
                area, perimeter = true_outline(vertices, faces, CROP_PX)
                for edge, blur, size in itertools.product(EDGES, blurs, sizes):
                    ratio = size / CROP_PX
                    placed = vertices * np.array([ratio, ratio, 1], np.float32)
                    scaled = area * ratio**2, perimeter * ratio
                    key = f"{edge}, blur {blur:g}, {size} px"
                    value = outline_excess(placed, faces, scaled, size, Blur.for_size(size, blur, edge))
                    excess.setdefault(key, {}).setdefault(part, []).append(value)
        result[name] = {
            key: {part: float(np.mean(values)) for part, values in parts.items()}
            | {"whole, largest": float(np.abs(parts["whole"]).max())}
            for key, parts in excess.items()
        }
        if timed:
            result[name]["ms_per_frame"] = _times([mesh for mesh, _ in meshes])
    return result


def _times(meshes: Sequence[Mesh], repeats: int = 7) -> dict[str, float]:
    """Return the median time of loss and gradient of a frame in milliseconds, for each edge."""
    vertices, faces = jnp.asarray(np.stack([mesh[0] for mesh in meshes])), jnp.asarray(meshes[0][1])
    target = silhouette(vertices[0], faces, CROP_PX) > 0.5
    times = {}
    for edge in EDGES:
        blur = Blur.for_size(CROP_PX, 1.0, edge)

        def loss(v, blur=blur):
            return mask_loss(v, faces, target, blur=blur)

        run = jax.jit(jax.vmap(jax.value_and_grad(loss)))
        times[edge] = 1e3 * median_seconds(lambda run=run: run(vertices), repeats) / len(meshes)
    return times
