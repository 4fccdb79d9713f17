"""Random members of the shape space of a model, with scans and photographs: known truth for adaptation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxfit.data.masks import box_of_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CropCamera, project, to_screen
from jaxfit.model.kinematics import Pose, fold_bird, joint_transforms, posed_vertices
from jaxfit.model.rotation import view_grid
from jaxfit.raster.zbuffer import hard_mask, zbuffer
from jaxfit.simulation.individuals import draw_normal


def random_species(bird: Bird, seed: int, bone_sd: float = 0.05) -> Bird:
    """Return a random species: shape from the shape space, bone lengths from the prior and with other proportions.

    Every bone, or pair of left and right bones, is longer by a random factor with the standard deviation `bone_sd`.
    The mean shape and the mean bone lengths of the result are those of the species.
    """
    random = np.random.default_rng(seed)
    betas = random.standard_normal(bird.num_shapes) * np.sqrt(np.asarray(bird.shape_variance))
    bones = draw_normal(random, bird.bone_mean, bird.bone_covariance)
    factor = np.exp(bone_sd * random.standard_normal(len(bones)))
    for left, right in bird.bone_pairs:
        bones[[left, right]] = bones[[left, right]].mean()
        factor[right] = factor[left]
    bones = np.clip(bones, 0.5, 1.8) * factor
    shift = np.tensordot(betas, np.asarray(bird.shape_basis), axes=1)
    return replace(
        bird,
        name=f"species-{seed}",
        vertices=jnp.asarray(np.asarray(bird.vertices) + shift, jnp.float32),
        bone_mean=jnp.asarray(bones, jnp.float32),
    )


def random_pose(bird: Bird, random: np.random.Generator, spread: float = 0.7) -> Pose:
    """Return a pose from the prior of a model, with its deviations times `spread`, and the mean bones and shape."""
    body = draw_normal(random, bird.pose_mean, bird.pose_covariance, spread)
    return Pose(
        global_orient=np.zeros(3, np.float32),
        body_pose=body.reshape(-1, 3).astype(np.float32),
        transl=np.zeros(3, np.float32),
        scale=np.ones((), np.float32),
        bone_length=np.asarray(bird.bone_mean, np.float32),
        betas=np.zeros(bird.num_shapes, np.float32),
    )


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan with known truth."""

    vertices: Float[np.ndarray, "P 3"]
    faces: Int[np.ndarray, "Q 3"]
    keypoints: dict[str, np.ndarray]
    """Name → (3,) position, in the frame of the scan."""
    true_vertices: Float[np.ndarray, "V 3"]
    """The whole posed surface without noise, in the frame of the scan; the faces are those of the model."""
    pose: Pose
    """The true pose; its scale is the scale of the scan."""


def simulate_scan(
    bird: Bird, seed: int, noise: float = 0.01, missing: float = 1 / 3, keypoints: int = 12, scale: float = 1.0
) -> SimulatedScan:
    """Pose a bird at random and scan its surface.

    The mesh is divided to other vertices, only faces that are visible from outside remain, a side of a random direction
    is missing, and every vertex has noise. The rounding of the processor affects the number of vertices, so the noise
    of the surface is drawn last: pose and keypoints are the same on every processor.

    Args:
        bird: the model.
        seed: random seed.
        noise: standard deviation of each coordinate, as a share of the length of the rest pose.
        missing: share of the surface without faces.
        keypoints: number of annotated keypoints, with half of the noise.
        scale: unit of the scan, relative to model units.
    """
    random = np.random.default_rng(seed)
    pose = random_pose(bird, random)
    rig = fold_bird(bird)
    whole = np.asarray(posed_vertices(rig, joint_transforms(rig, pose), pose), np.float64)
    length, faces = np.ptp(np.asarray(bird.vertices)[:, 1]), np.asarray(bird.faces)
    marked = np.asarray(bird.keypoint_weights, np.float64) @ whole
    turn = view_grid(50, 7)[random.integers(350)]
    shift = random.standard_normal(3) * length
    direction = view_grid(200, 1)[random.integers(200), 2]
    chosen = random.permutation(bird.num_keypoints)[:keypoints]
    annotated = marked[chosen] + random.standard_normal((len(chosen), 3)) * noise / 2 * length

    def to_scan(points):
        return scale * (points @ turn.T + shift)

    fine, triangles = trimesh.remesh.subdivide_to_size(whole, faces, max_edge=length / 30)[:2]
    triangles = triangles[_seen(fine, triangles)]
    corners = fine[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    side = corners.mean(1) @ direction
    order = np.argsort(side)
    keep = np.ones(len(triangles), bool)
    keep[order[np.cumsum(area[order]) < missing * area.sum()]] = False
    mesh = trimesh.Trimesh(fine, triangles[keep], process=False)
    mesh.vertices = mesh.vertices * (60 / length)
    mesh.merge_vertices(digits_vertex=0)  # cells of 1/60 of the length, so that the vertices are not those of the model
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    points = np.asarray(mesh.vertices) * (length / 60)
    points = points + random.standard_normal(points.shape) * noise * length
    return SimulatedScan(
        to_scan(points),
        np.asarray(mesh.faces),
        {bird.keypoint_names[k]: to_scan(point) for k, point in zip(chosen, annotated, strict=True)},
        to_scan(whole),
        replace(pose, scale=np.float32(scale)),
    )


def simulate_photographs(
    bird: Bird, count: int, seed: int, tilt_deg: float = 20.0, noise_px: float = 2.0, seen: float = 0.8
) -> Observations:
    """Photograph individuals of a species from the side: keypoints and masks in pictures of 256 pixels.

    Every photograph shows another individual, whose bones differ by 2 % from the mean of the species, and whose shape
    differs by 0.2 standard deviations of the shape space.

    Args:
        bird: the species.
        count: number of photographs.
        seed: random seed.
        tilt_deg: standard deviation of the camera's direction from the side, for each axis.
        noise_px: standard deviation of the keypoints.
        seen: share of the keypoints that are annotated.
    """
    random = np.random.default_rng(seed)
    camera, rig, faces = CropCamera(), fold_bird(bird), np.asarray(bird.faces)
    length = float(np.ptp(np.asarray(bird.vertices)[:, 1]))
    keypoints = np.zeros((count, 1, bird.num_keypoints, 2), np.float32)
    confidence = (random.random((count, 1, bird.num_keypoints)) < seen).astype(np.float32)
    masks, boxes = {}, np.zeros((count, 1, 4), np.float32)
    for n in range(count):
        pose = random_pose(bird, random)
        tilt = Rotation.from_rotvec(np.deg2rad(tilt_deg) * random.standard_normal(3))
        # the bird looks to the left or to the right of the picture: +y along ∓x, +z upwards (−y)
        side = np.array(
            [[0, -1, 0], [0, 0, -1], [1, 0, 0]] if random.random() < 0.5 else [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]
        )
        turn = Rotation.from_matrix((tilt * Rotation.from_matrix(side)).as_matrix()).as_rotvec()
        bones = pose.bone_length * (1 + 0.02 * random.standard_normal(len(pose.bone_length)))
        betas = 0.2 * np.sqrt(np.asarray(bird.shape_variance)) * random.standard_normal(bird.num_shapes)
        depth = camera.focal_px * length / (180 + 20 * random.standard_normal())
        pose = replace(pose, global_orient=turn.astype(np.float32), bone_length=bones.astype(np.float32))
        pose = replace(pose, betas=betas.astype(np.float32))
        points = np.asarray(posed_vertices(rig, joint_transforms(rig, pose), pose))
        points = points - (points.min(0) + points.max(0)) / 2 + [0, 0, depth]
        true_px = np.asarray(project(np.asarray(bird.keypoint_weights) @ points, camera))
        keypoints[n, 0] = true_px + noise_px * random.standard_normal(true_px.shape)
        mask = hard_mask(np.asarray(to_screen(points, camera), np.float32), faces, 256, 256)
        masks[n, 0] = encode_mask(mask)
        boxes[n, 0] = box_of_mask(mask) or (0, 0, 1, 1)
    return Observations(
        track_id=np.arange(count) + 1,
        frame_index=np.zeros(1, np.int64),
        present=np.ones((count, 1), bool),
        keypoints_px=keypoints,
        confidence=confidence,
        box_px=boxes,
        image_size_px=np.full((1, 2), 256),
        file_name=np.array(["photograph"]),
        keypoint_names=bird.keypoint_names,
        masks=masks,
        own_images={(n, 0): (f"photograph_{n:03d}.png", 256, 256) for n in range(count)},
    )


def _seen(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> np.ndarray:
    """Return whether each face is visible from any of 40 directions."""
    centred = vertices - vertices.mean(0)
    zoom = 500 / np.linalg.norm(centred, axis=1).max()
    seen = np.zeros(len(faces), bool)
    for R in view_grid(40, 1):
        face = zbuffer((centred @ R.T * zoom + [512, 512, 1024]).astype(np.float32), faces, 1024, 1024).face
        seen[np.unique(face[face >= 0])] = True
    return seen
