"""A small bird, its poses and results, and oracles for posing and masks. Simulated motion is in `jaxfit.simulation`."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from jaxfit.data.solution import ERROR_BARS, Solution
from jaxfit.model.bird import Bird, neutral_colours, unlimited_joints
from jaxfit.model.camera import CropCamera, crop_to_image, project
from jaxfit.model.kinematics import Pose, fold_bird, window_keypoints, window_transforms, window_vertices

PARTS = {  # joint: parent, position, centre and half-axes of its ellipsoid (x side, y to the bill, z up)
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


TINY_PARTS = ("root", "head", "left_wing", "right_wing")
TINY_KEYPOINTS = (
    *("bill_tip", "nape", "breast", "tail_tip"),
    *("left_wingtip", "right_wingtip", "left_foot", "right_foot"),
)


def array(values, dtype=np.float32):
    """Return an array of JAX without an operation of JAX, each of which would be compiled."""
    return jax.device_put(np.asarray(values, dtype))


def _pairs(names):
    return tuple((i, names.index("right" + n[4:])) for i, n in enumerate(names) if n.startswith("left"))


def tiny_bird(shapes: int = 2) -> Bird:
    """The bird for tests of logic: 4 joints, 48 vertices, 8 keypoints. Its programs compile in half the time.

    `toy_bird` looks more like a bird: only tests whose accuracy needs a round outline should use it.
    """
    parts = {name: PARTS[name] for name in TINY_PARTS}
    parts["head"] = ("root", *parts["head"][1:])  # without a neck
    return _bird_of_ellipsoids("tiny", parts, {name: KEYPOINTS[name] for name in TINY_KEYPOINTS}, shapes, 0)


def toy_bird(shapes: int = 2, subdivisions: int = 2) -> Bird:
    """A bird of eight ellipsoids with a round outline. See `tiny_bird`."""
    return _bird_of_ellipsoids("toy", PARTS, KEYPOINTS, shapes, subdivisions)


def _bird_of_ellipsoids(name: str, parts: dict, points: dict, shapes: int, subdivisions: int) -> Bird:
    """A bird of ellipsoids, each moved by its own joint and a little by its parent's."""
    names = tuple(parts)
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices, faces, weights = [], [], []
    for j, (parent, _, centre, axes) in enumerate(parts.values()):
        faces.append(sphere.faces + j * len(sphere.vertices))
        vertices.append(sphere.vertices * axes + centre)
        w = np.zeros((len(sphere.vertices), len(names)))
        w[:, j] = 0.9 if parent else 1.0
        if parent:
            w[:, names.index(parent)] = 0.1
        weights.append(w)
    vertices = np.concatenate(vertices)
    nearest = [np.argmin(((vertices - np.array(p)) ** 2).sum(1)) for p in points.values()]
    bones = len(names) - 1
    # shape directions: a thicker and a longer bird
    basis = np.stack([vertices * [0.1, 0, 0.1], vertices * [0, 0.1, 0]])[:shapes]

    return Bird(
        vertices=array(vertices),
        faces=array(np.concatenate(faces), np.int32),
        joints=array([part[1] for part in parts.values()]),
        skin_weights=array(np.concatenate(weights)),
        keypoint_weights=array(np.eye(len(vertices))[nearest]),
        shape_basis=array(basis),
        shape_variance=array(np.ones(shapes)),
        pose_mean=array(np.zeros(3 * bones)),
        pose_covariance=array(0.1 * np.eye(3 * bones)),
        bone_mean=array(np.ones(bones)),
        bone_covariance=array(0.01 * np.eye(bones)),
        vertex_colours=array(neutral_colours(len(vertices))),
        joint_limits=array(unlimited_joints(bones)),
        parents=tuple(-1 if part[0] is None else names.index(part[0]) for part in parts.values()),
        joint_names=names,
        keypoint_names=tuple(points),
        joint_pairs=_pairs(names),
        keypoint_pairs=_pairs(tuple(points)),
        name=name,
    )


def exp_map(axis_angle):
    """Rotation matrices by scipy, independent of the library."""
    return Rotation.from_rotvec(axis_angle).as_matrix()


def skin_by_hand(bird: Bird, pose: Pose):
    """Pose one frame joint by joint with 4×4 matrices in double precision; vertices (V, 3) and joints (J, 3).

    Vertices and joint offsets are scaled before skinning, as in the code of avian-mesh.
    """
    angles = np.concatenate([np.asarray(pose.global_orient)[None], np.asarray(pose.body_pose)])
    scale, bones = float(np.reshape(pose.scale, -1)[0]), [1.0, *np.asarray(pose.bone_length, np.float64)]
    rest = np.asarray(bird.vertices, np.float64)
    for beta, direction in zip(np.asarray(pose.betas), np.asarray(bird.shape_basis, np.float64), strict=True):
        rest = rest + beta * direction
    joints = np.asarray(bird.joints, np.float64)
    chain, vertices, posed = [], np.zeros_like(rest), np.zeros_like(joints)
    for j, parent in enumerate(bird.parents):
        local = np.eye(4)
        local[:3, :3] = exp_map(np.asarray(angles[j], np.float64))
        local[:3, 3] = scale * bones[j] * (joints[j] - (joints[parent] if j else 0))
        chain.append(local if j == 0 else chain[parent] @ local)
        moved = scale * (rest - joints[j]) @ chain[j][:3, :3].T + chain[j][:3, 3]
        vertices += np.asarray(bird.skin_weights, np.float64)[:, [j]] * moved
        posed[j] = chain[j][:3, 3]
    transl = np.asarray(pose.transl, np.float64)
    return vertices + transl, posed + transl


PUBLISHED_CASES = [("avian_mesh", 1.0), ("avian_mesh", 1.3), ("aves", 1.0)]
"""Models and scales of `published_poses`."""


def published_poses(reference_dir: Path, model: str, scale: float) -> list[tuple[Pose, np.ndarray, np.ndarray]]:
    """Three poses, each with the vertices and keypoints that the code of the model's authors gives."""
    prefix = f"{model}/scale_{scale}/"
    with np.load(reference_dir / "reference" / "lbs.npz") as stored:
        case = {name.removeprefix(prefix): stored[name] for name in stored.files if name.startswith(prefix)}
    assert len(case["vertices"]) == 3
    poses = [
        Pose(
            global_orient=jnp.asarray(case["global_orient"][i]),
            body_pose=jnp.asarray(case["body_pose"][i].reshape(-1, 3)),
            transl=jnp.zeros(3),
            scale=jnp.float32(scale),
            bone_length=jnp.asarray(case["bone_length"][i]),
            betas=jnp.asarray(case["beta"][i]) if "beta" in case else jnp.zeros(0),
        )
        for i in range(3)
    ]
    return list(zip(poses, case["vertices"], case["keypoints"], strict=True))


def random_pose(bird: Bird, seed: int, spread: float = 0.5) -> Pose:
    """A pose of one frame in which every parameter differs from rest."""
    rng = np.random.default_rng(seed)
    bones = bird.num_joints - 1

    def some(*shape):
        return np.float32(spread * rng.normal(size=shape))

    return Pose(
        global_orient=array(2 * some(3)),
        body_pose=array(some(bones, 3)),
        transl=array(some(3) + np.float32([0, 0, 150.0])),
        scale=array(rng.uniform(0.7, 1.4)),
        bone_length=array(1 + np.float32(0.3) * some(bones)),
        betas=array(some(bird.num_shapes)),
    )


def pose_window(bird: Bird, pose: Pose):
    """Posed keypoints and vertices of a window, camera frame: (T, K, 3) and (T, V, 3)."""
    keypoints, vertices = _posed(fold_bird(bird), pose)
    return np.asarray(keypoints), np.asarray(vertices)


@jax.jit  # one program is compiled faster than a hundred operations
def _posed(rig, pose):
    A = window_transforms(rig, pose)
    return window_keypoints(rig, A, pose), window_vertices(rig, A, pose)


def solution_of(bird: Bird, poses: Sequence[Pose], crop=(0.0, 0.0, 256.0)) -> Solution:
    """A result with one track per window of poses, projected by the default camera in the given crops.

    `crop` is (x0, y0, size) for all frames, or an array (N, 1, 3) or (N, T, 3). All frames are valid, and the images
    have the size of the crop camera. Tests replace other fields as required.
    """
    N, T = len(poses), len(poses[0].global_orient)

    def every_frame(name: str, ndim: int) -> np.ndarray:
        values = [np.asarray(getattr(pose, name)) for pose in poses]
        return np.stack([np.broadcast_to(value, (T, *value.shape[value.ndim - ndim :])) for value in values])

    keypoints = np.stack([pose_window(bird, pose)[0] for pose in poses])
    crop, camera = np.broadcast_to(np.asarray(crop, float), (N, T, 3)), CropCamera()
    return Solution.from_arrays(
        track_id=np.arange(1, N + 1),
        frame_index=np.arange(T),
        valid=np.ones((N, T), bool),
        global_orient=every_frame("global_orient", 1),
        body_pose=every_frame("body_pose", 2),
        transl=every_frame("transl", 1),
        scale=every_frame("scale", 0),
        bone_length=every_frame("bone_length", 1),
        betas=every_frame("betas", 1),
        keypoints_cam=keypoints,
        keypoints_px=crop_to_image(np.asarray(project(keypoints, camera)), crop, camera.size_px),
        crop=crop,
        image_size_px=np.full((N, T, 2), camera.size_px),
        keypoint_names=bird.keypoint_names,
        joint_names=bird.joint_names,
        status=np.full(N, "ok"),
        loss={},
        focal_px=camera.focal_px,
        crop_px=camera.size_px,
    )


def filled_mask(vertices_px, faces, size: int) -> np.ndarray:
    """Hard mask of a mesh: pixels whose centre lies in any triangle. Independent of the raster core."""
    canvas = np.zeros((size, size), bool)
    for a, b, c in np.asarray(vertices_px, np.float64)[np.asarray(faces)]:
        low = np.clip(np.floor(np.min([a, b, c], axis=0)).astype(int), 0, size)
        high = np.clip(np.ceil(np.max([a, b, c], axis=0)).astype(int), 0, size)
        y, x = np.mgrid[low[1] : high[1], low[0] : high[0]] + 0.5
        sides = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
        inside = np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)
        canvas[low[1] : high[1], low[0] : high[0]] |= inside
    return canvas


def error_bars(solution, default=0.0, **values):
    """Return the arrays of error bars of a solution; values are broadcast to their shapes."""
    cells = solution.cells(error_bars=True)
    return {name: np.full(cells[name].shape, values.get(name, default), np.float32) for name in ERROR_BARS}
