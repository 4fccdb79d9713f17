"""What several tests need: a small bird, simulated windows of it, and observations made from them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from jaxfit.camera import Camera, project
from jaxfit.model.bird import Bird
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_keypoints, posed_vertices
from jaxfit.model.pose import Pose
from jaxfit.objective.scene import FRAME_AXES
from jaxfit.observations import Observations, encode_mask

PARTS = {  # joint: parent, joint position, centre and half-axes of its ellipsoid (x side, y to the bill, z up)
    "root": (None, (0, 0, 0), (0, 0, 0), (2.0, 4.0, 1.8)),
    "neck": ("root", (0, 3, 1), (0, 4.5, 1.8), (1.0, 2.0, 1.0)),
    "head": ("neck", (0, 6, 2.5), (0, 7.2, 2.8), (0.9, 1.8, 0.9)),
    "tail": ("root", (0, -3.5, 0), (0, -5.5, 0), (0.9, 2.4, 0.4)),
    "left_wing": ("root", (1.8, 1.5, 0.8), (2.3, -1.0, 0.6), (0.5, 3.5, 1.2)),
    "right_wing": ("root", (-1.8, 1.5, 0.8), (-2.3, -1.0, 0.6), (0.5, 3.5, 1.2)),
    "left_leg": ("root", (0.8, -0.5, -1.4), (0.9, 0.0, -2.8), (0.3, 0.6, 1.5)),
    "right_leg": ("root", (-0.8, -0.5, -1.4), (-0.9, 0.0, -2.8), (0.3, 0.6, 1.5)),
}
KEYPOINTS = {
    "bill_tip": (0, 9, 2.8),
    "left_eye": (0.9, 7.5, 3.2),
    "right_eye": (-0.9, 7.5, 3.2),
    "crown": (0, 6.8, 3.7),
    "nape": (0, 4.2, 2.8),
    "back": (0, 0, 1.8),
    "breast": (0, 3.0, -1.2),
    "tail_tip": (0, -7.9, 0),
    "left_wingtip": (2.4, -4.5, 0.5),
    "right_wingtip": (-2.4, -4.5, 0.5),
    "left_foot": (0.9, 0.4, -4.3),
    "right_foot": (-0.9, 0.4, -4.3),
}


def _pairs(names):
    return tuple((i, names.index("right" + n[4:])) for i, n in enumerate(names) if n.startswith("left"))


def toy_bird(shapes: int = 2) -> Bird:
    """A bird of eight ellipsoids, each moved by its own joint and a little by its parent's."""
    names = tuple(PARTS)
    sphere = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces, weights = [], [], []
    for j, (parent, _, centre, axes) in enumerate(PARTS.values()):
        faces.append(sphere.faces + j * len(sphere.vertices))
        vertices.append(sphere.vertices * axes + centre)
        w = np.zeros((len(sphere.vertices), len(names)))
        w[:, j] = 0.9 if parent else 1.0
        if parent:
            w[:, names.index(parent)] = 0.1
        weights.append(w)
    vertices = np.concatenate(vertices)
    nearest = [np.argmin(((vertices - np.array(p)) ** 2).sum(1)) for p in KEYPOINTS.values()]
    bones = len(names) - 1
    # shape directions: a thicker and a longer bird
    basis = np.stack([vertices * [0.1, 0, 0.1], vertices * [0, 0.1, 0]])[:shapes]
    f32 = jnp.float32
    return Bird(
        vertices=jnp.asarray(vertices, f32),
        faces=jnp.asarray(np.concatenate(faces), jnp.int32),
        joints=jnp.asarray([part[1] for part in PARTS.values()], f32),
        skin_weights=jnp.asarray(np.concatenate(weights), f32),
        keypoint_weights=jnp.asarray(np.eye(len(vertices))[nearest], f32),
        shape_basis=jnp.asarray(basis, f32),
        shape_variance=jnp.ones(shapes),
        pose_mean=jnp.zeros(3 * bones),
        pose_covariance=0.1 * jnp.eye(3 * bones),
        bone_mean=jnp.ones(bones),
        bone_covariance=0.01 * jnp.eye(bones),
        parents=tuple(-1 if part[0] is None else names.index(part[0]) for part in PARTS.values()),
        joint_names=names,
        keypoint_names=tuple(KEYPOINTS),
        joint_pairs=_pairs(names),
        keypoint_pairs=_pairs(tuple(KEYPOINTS)),
        name="toy",
    )


def smooth_noise(rng, frames: int, size: tuple[int, ...], step: int = 20) -> np.ndarray:
    """Smooth random curves of unit spread: cosine-blended knots every `step` frames."""
    knots = rng.normal(size=(frames // step + 2, *size))
    at = np.arange(frames) / step
    low, part = at.astype(int), (1 - np.cos(np.pi * (at % 1))) / 2
    part = part.reshape(-1, *[1] * len(size))
    return (1 - part) * knots[low] + part * knots[low + 1]


def smooth_window(bird: Bird, frames: int, seed: int, depth: float = 200.0, bend: float = 0.7) -> Pose:
    """True poses of a bird seen from above that turns, leans and bends smoothly within its prior."""
    rng = np.random.default_rng(seed)
    from_above = np.array([np.pi, 0, 0])  # z up turned towards the camera
    heading = rng.uniform(-np.pi, np.pi) + 0.6 * smooth_noise(rng, frames, ())
    lean = 0.25 * smooth_noise(rng, frames, (3,))
    cholesky = np.linalg.cholesky(np.asarray(bird.pose_covariance, np.float64))
    body = np.asarray(bird.pose_mean) + bend * smooth_noise(rng, frames, (len(cholesky),)) @ cholesky.T
    R = rotation_z(heading) @ exp_map(lean) @ exp_map(from_above)
    place = rng.normal(size=2) + np.cumsum(0.05 * smooth_noise(rng, frames, (2,)), axis=0)
    from jaxfit.model.rotation import matrix_to_axis_angle, unwrap_axis_angle

    return Pose(
        global_orient=unwrap_axis_angle(matrix_to_axis_angle(jnp.asarray(R, jnp.float32))),
        body_pose=jnp.asarray(body.reshape(frames, -1, 3), jnp.float32),
        transl=jnp.asarray(np.column_stack([place, np.full(frames, depth)]), jnp.float32),
        scale=jnp.full(1, rng.uniform(0.9, 1.1), jnp.float32),
        bone_length=bird.bone_mean,
        betas=jnp.zeros(bird.num_shapes),
    )


def rotation_z(angle):
    """Rotation matrices about z, by hand."""
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.stack(
        [np.stack([c, -s, zero], -1), np.stack([s, c, zero], -1), np.stack([zero, zero, zero + 1], -1)], -2
    )


def exp_map(axis_angle):
    """Rotation matrices by scipy: independent of the library's own."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(axis_angle).as_matrix()


def pose_window(bird: Bird, pose: Pose):
    """Posed keypoints and vertices of a window, camera frame: (T, K, 3) and (T, V, 3)."""
    rig = fold_bird(bird)
    frames = pose.global_orient.shape[0]
    pose = dataclasses.replace(pose, scale=jnp.broadcast_to(pose.scale, (frames,)))
    A = jax.vmap(joint_transforms, (None, FRAME_AXES))(rig, pose)
    keypoints = jax.vmap(posed_keypoints, (None, 0, FRAME_AXES))(rig, A, pose)
    vertices = jax.vmap(posed_vertices, (None, 0, FRAME_AXES))(rig, A, pose)
    return np.asarray(keypoints), np.asarray(vertices)


def filled_mask(vertices_px, faces, size: int) -> np.ndarray:
    """Hard mask by filling every projected triangle (OpenCV): independent of the raster core."""
    import cv2

    canvas = np.zeros((size, size), np.uint8)
    corners = np.round((vertices_px[np.asarray(faces)] - 0.5) * 256).astype(np.int32)
    for triangle in corners:
        cv2.fillConvexPoly(canvas, triangle, 1, shift=8)
    return canvas.astype(bool)


def observe(
    bird: Bird,
    poses: list[Pose],
    noise_px: float = 0.0,
    outliers: float = 0.0,
    masks: bool = True,
    seed: int = 0,
    camera: Camera = Camera(),
) -> Observations:
    """Observations of several birds, each in 256-pixel images of its own; noise and outliers are seeded."""
    rng = np.random.default_rng(seed)
    birds, frames, size = len(poses), poses[0].global_orient.shape[0], camera.size_px
    keypoints_px, boxes, rle = [], [], {}
    for n, pose in enumerate(poses):
        keypoints, vertices = pose_window(bird, pose)
        points = np.asarray(project(keypoints, camera))
        points = points + rng.normal(scale=noise_px, size=points.shape) if noise_px else points
        if outliers:
            wrong = rng.random(points.shape[:2]) < outliers
            points = np.where(wrong[..., None], rng.uniform(0, size, points.shape), points)
        keypoints_px.append(points)
        outline = np.asarray(project(vertices, camera))
        low, high = outline.min(1), outline.max(1)
        boxes.append(np.concatenate([low, high - low], axis=-1))
        if masks:
            for t in range(frames):
                rle[n, t] = encode_mask(filled_mask(outline[t], bird.faces, size))
    return Observations(
        track_id=np.arange(birds),
        frame_index=np.arange(frames),
        present=np.ones((birds, frames), bool),
        keypoints_px=np.asarray(keypoints_px, np.float32),
        confidence=np.ones((birds, frames, bird.num_keypoints), np.float32),
        box_px=np.asarray(boxes, np.float32),
        image_size_px=np.full((frames, 2), size),
        file_name=np.array([f"{t:06d}.png" for t in range(frames)]),
        keypoint_names=bird.keypoint_names,
        masks=rle,
    )
