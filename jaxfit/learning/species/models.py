"""Models of other meshes: transfer of a rig, comparison, page of keypoints for annotators."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

from jaxfit.foundation.array_files import load_npz, npz_names
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.learning.species.species import absolute_bones, body_length, rest_points, rest_surface
from jaxfit.learning.species.surface import Closest, Similarity, closest_points, fit_similarity, search_samples
from jaxfit.model.bird import MAX_INFLUENCES, Bird, neutral_colours
from jaxfit.model.kinematics import Pose, fold_bird, joint_transforms, posed_vertices
from jaxfit.raster.zbuffer import zbuffer
from jaxfit.view.colours import PAPER
from jaxfit.view.mesh_views import (
    LIGHT,
    MARGIN_PX,
    TILE_PX,
    VIEWS,
    Surface,
    draw_parallel,
    error_colours,
    surface_views,
)
from jaxfit.view.report.rendering import rendered

SMOOTHING_STEPS = 8
"""Number of times that the skin weights of a vertex are averaged with those of its neighbours."""
NOTES = {"scan_R": "3 3", "scan_size": "", "scan_root": "3", "scan_body_pose": "bones 3"}
"""Notes of a model file that `jaxfit adapt scan` writes."""


class Placement(NamedTuple):
    """The pose and the place of a model in the frame of a mesh: x = size · R (u − J_0) + root, with u posed."""

    R: Float[np.ndarray, "3 3"]
    size: float
    root: Float[np.ndarray, "3"]
    body_pose: Float[np.ndarray, "bones 3"]

    def pose(self, bird: Bird) -> Pose:
        """Return the body pose, without rotation and translation, at scale 1."""
        return Pose(
            global_orient=np.zeros(3, np.float32),
            body_pose=np.asarray(self.body_pose, np.float32),
            transl=np.zeros(3, np.float32),
            scale=np.ones((), np.float32),
            bone_length=np.asarray(bird.bone_mean),
            betas=np.zeros(bird.num_shapes, np.float32),
        )


def read_placement(path: Path, bird: Bird) -> Placement | None:
    """Return the pose of the scan from which a model was adapted; None if the model file holds no such pose."""
    if not set(NOTES) <= npz_names(path):
        return None
    notes = load_npz(path, {**NOTES, "scan_body_pose": f"{bird.num_joints - 1} 3"})
    return Placement(notes["scan_R"], float(notes["scan_size"]), notes["scan_root"], notes["scan_body_pose"])


def rest_placement(bird: Bird) -> Placement:
    """Return the placement of a mesh that lies on the rest pose of a model, in the model's frame and size."""
    root = np.asarray(bird.joints, np.float64)[0]
    return Placement(np.eye(3), 1.0, root, np.zeros((bird.num_joints - 1, 3)))


def rig_mesh(
    vertices: Float[np.ndarray, "P 3"],
    faces: Int[np.ndarray, "Q 3"],
    bird: Bird,
    placement: Placement,
    name: str = "rigged",
) -> tuple[Bird, Float[np.ndarray, "P"]]:
    """Return a model with the surface of a mesh and the rig of a bird.

    Each vertex gets the skin weights and shape directions of the closest point of the posed bird; the skin weights are
    smoothed over the mesh. Each keypoint is the closest point of the mesh. The inverse of the skinning brings the mesh
    to the rest pose, so the model in the pose of `placement` is the mesh.

    Args:
        vertices: vertices of the mesh.
        faces: faces of the mesh.
        bird: the model whose rig is transferred.
        placement: pose and place of the bird in the frame of the mesh.
        name: name of the new model.

    Returns:
        The model, in the units and the frame of the bird, and the distance of each vertex from the bird (model units).
    """
    pose = placement.pose(bird)
    if not np.any(placement.body_pose):
        pose = replace(pose, bone_length=np.ones_like(pose.bone_length))  # the rest pose has the rest bones
    rig = fold_bird(bird)
    transforms = joint_transforms(rig, pose)
    posed = np.asarray(posed_vertices(rig, transforms, pose), np.float64)
    root = np.asarray(bird.joints, np.float64)[0]
    mesh = (vertices - placement.root) @ placement.R / placement.size + root
    own_faces = np.asarray(bird.faces)
    closest = closest_points(mesh, posed, own_faces, search_samples(posed, own_faces, 60_000))
    weights = _smoothed(_carried(np.asarray(bird.skin_weights), own_faces, closest), faces)
    basis = (
        np.stack([_carried(field, own_faces, closest) for field in np.asarray(bird.shape_basis)])
        if bird.num_shapes
        else np.zeros((0, len(mesh), 3))
    )
    blended = np.einsum("vj,jrc->vrc", weights, np.asarray(transforms, np.float64))
    rest = np.linalg.solve(blended[..., :3], (mesh - blended[..., 3])[..., None])[..., 0]
    keypoints = np.asarray(bird.keypoint_weights, np.float64) @ posed
    at = closest_points(keypoints, mesh, faces, search_samples(mesh, faces, 60_000))
    to_keypoints = np.zeros((len(keypoints), len(mesh)))
    for k, (face, share) in enumerate(zip(faces[at.face], at.barycentric, strict=True)):
        np.add.at(to_keypoints[k], face, share / share.sum())
    model = replace(
        bird,
        name=name,
        vertices=jnp.asarray(rest, jnp.float32),
        faces=jnp.asarray(faces, jnp.int32),
        skin_weights=jnp.asarray(weights, jnp.float32),
        keypoint_weights=jnp.asarray(to_keypoints, jnp.float32),
        shape_basis=jnp.asarray(basis, jnp.float32),
        vertex_colours=jnp.asarray(neutral_colours(len(mesh))),
    )
    return model, closest.distance


def _carried(values: np.ndarray, faces: Int[np.ndarray, "F 3"], closest: Closest) -> np.ndarray:
    """Return values of the vertices of a surface at its closest points."""
    return np.einsum("pk,pkc->pc", closest.barycentric, values[faces[closest.face]])


def _smoothed(weights: Float[np.ndarray, "P J"], faces: Int[np.ndarray, "Q 3"]) -> Float[np.ndarray, "P J"]:
    """Return skin weights averaged with those of the neighbours, with at most `MAX_INFLUENCES` joints per vertex."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links = sparse.coo_matrix((np.ones(len(sides)), sides.T), shape=(len(weights), len(weights))).tocsr()
    links = ((links + links.T) > 0).astype(float)
    degree = np.asarray(links.sum(axis=1))
    for _ in range(SMOOTHING_STEPS):
        weights = np.where(degree > 0, 0.5 * weights + 0.5 * (links @ weights) / np.maximum(degree, 1), weights)
    if weights.shape[1] > MAX_INFLUENCES:
        smallest = np.partition(weights, -MAX_INFLUENCES, axis=1)[:, [-MAX_INFLUENCES]]
        weights = np.where(weights >= smallest, weights, 0)
        extra = np.cumsum(weights > 0, axis=1) > MAX_INFLUENCES  # ties at the smallest weight
        weights = np.where(extra, 0, weights)
    return weights / weights.sum(axis=1, keepdims=True)


LARGEST_PERCENT = 5.0
"""The last colour of the picture."""
MIN_COMMON = 4
"""Fewest common keypoints, or joints, that align two models."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences between two models in their rest pose, after an alignment by rotation, size and shift."""

    first: Float[np.ndarray, "U 3"]
    """Vertices of the first model."""
    aligned: Float[np.ndarray, "V 3"]
    """Vertices of the second model in the frame and the size of the first model."""
    size: float
    """Size of the second model relative to the first: 1.1 means that the second model is 10 % larger."""
    bones: dict[str, float]
    """Common bone → length in the second model, relative to the first, after the alignment."""
    of_first: Float[np.ndarray, "U"]
    """Distance of each vertex of the first model from the second, as a share of the first model's length."""
    of_second: Float[np.ndarray, "V"]
    """Distance of each vertex of the second model from the first, as the same share."""


def compare_birds(first: Bird, second: Bird) -> Comparison:
    """Compare two models in their rest pose, with the mean bone lengths of their priors.

    Models with the same faces are aligned by their vertices, other models by the keypoints that both have.

    Raises:
        InputError: the models have different faces, and fewer than four common keypoints and joints.
    """
    a, b = rest_surface(first), rest_surface(second)
    faces_a, faces_b = np.asarray(first.faces), np.asarray(second.faces)
    if np.array_equal(faces_a, faces_b) and len(a) == len(b):
        to_first = fit_similarity(b, a)
    else:
        to_first = _by_names(first, second)
    aligned = to_first.apply(b)
    length = body_length(first)
    on_b = closest_points(a, aligned, faces_b, search_samples(aligned, faces_b, 40_000))
    on_a = closest_points(aligned, a, faces_a, search_samples(a, faces_a, 40_000))
    lengths = [dict(zip(bird.joint_names[1:], absolute_bones(bird), strict=True)) for bird in (first, second)]
    common = [name for name in lengths[0] if lengths[1].get(name) and lengths[0][name] > 0.01 * length]
    bones = {name: float(lengths[1][name] * to_first.scale / lengths[0][name]) for name in common}
    return Comparison(a, aligned, 1 / to_first.scale, bones, on_b.distance / length, on_a.distance / length)


def _by_names(first: Bird, second: Bird) -> Similarity:
    """Return the similarity from the second model to the first by common keypoints, or by common joints."""
    points = [rest_points(bird) for bird in (first, second)]
    for kind in ("keypoints", "joints"):
        place = [of_model[kind] for of_model in points]
        common = [name for name in place[0] if name in place[1]]
        if len(common) >= MIN_COMMON:
            to_first = [np.stack([places[name] for name in common]) for places in place]
            return fit_similarity(to_first[1], to_first[0])
    raise InputError(second.name, f"shares no four keypoints or joints with {first.name}", "compare models of birds")


def draw_comparison(path: str | Path, first: Bird, second: Bird, comparison: Comparison) -> None:
    """Write a picture of both models from six sides, each coloured by its distance from the other."""
    largest = LARGEST_PERCENT
    surfaces = [
        Surface(comparison.first, np.asarray(first.faces), error_colours(100 * comparison.of_first, largest)),
        Surface(comparison.aligned, np.asarray(second.faces), error_colours(100 * comparison.of_second, largest)),
    ]
    titles = [f"{first.name}: distance from {second.name}", f"{second.name}: distance from {first.name}"]
    lines = [
        f"mean distance of {name}: {100 * float(distance.mean()):.2f} % of length"
        for name, distance in ((first.name, comparison.of_first), (second.name, comparison.of_second))
    ]
    surface_views(path, [[surface] for surface in surfaces], titles, largest, lines)


HIDDEN = 0.02
"""A keypoint this far behind the visible surface is hidden in a view, as a share of the bird's length."""


class _View(NamedTuple):
    """A picture of a model from one side, and its keypoints there."""

    name: str
    width: int
    height: int
    png: str
    """Base64."""
    points: list[list[float]]
    visible: list[bool]


def write_keypoint_page(bird: Bird, path: str | Path) -> None:
    """Write an HTML page with the keypoints of a model, in one file without links to other files.

    Every keypoint has a number. A dashed ring means that the keypoint is hidden in this view.

    Raises:
        InputError: the file cannot be written.
    """
    vertices = np.asarray(bird.vertices, np.float64)
    middle = (vertices.min(0) + vertices.max(0)) / 2
    zoom = (TILE_PX - 2 * MARGIN_PX) / np.ptp(vertices, axis=0).max()
    views = [_view(bird, name, middle, zoom) for name in VIEWS]
    write_whole(path, rendered("keypoints.html", bird=bird, views=views).encode())


def _view(bird: Bird, name: str, middle: Float[np.ndarray, "3"], zoom: float) -> _View:
    right, down = (np.array(axis, float) for axis in VIEWS[name])
    axes = np.stack([right, down, np.cross(right, down)])
    vertices, faces = np.asarray(bird.vertices, np.float64), np.asarray(bird.faces)
    seen = (vertices - middle) @ axes.T * zoom
    height = round(float(np.ptp(seen[:, 1]))) + 2 * MARGIN_PX
    blank = np.full((height, TILE_PX, 3), PAPER, np.uint8)
    colours = np.clip(0.1 + 0.9 * np.asarray(bird.vertex_colours)[:, ::-1] ** 0.75, 0, 1)
    picture = draw_parallel(blank, seen, faces, colours, samples=3, light=LIGHT)
    _, png = cv2.imencode(".png", picture)
    shift = np.array([TILE_PX / 2, height / 2, 10 * TILE_PX])
    points = (np.asarray(bird.keypoints, np.float64) - middle) @ axes.T * zoom + shift
    depth = zbuffer((seen + shift).astype(np.float32), faces, TILE_PX, height).depth
    column = np.clip(points[:, 0].astype(int), 0, TILE_PX - 1)
    row = np.clip(points[:, 1].astype(int), 0, height - 1)
    length_px = float(np.ptp(vertices[:, 1])) * zoom
    visible = points[:, 2] < depth[row, column] + HIDDEN * length_px
    image = base64.b64encode(png.tobytes()).decode()
    return _View(name, TILE_PX, height, image, points[:, :2].tolist(), visible.tolist())
