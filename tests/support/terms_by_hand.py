"""Small windows for the tests of the objective, and an oracle: every term by its equation in NumPy."""

import dataclasses
import functools
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.fft import dct
from scipy.spatial.transform import Rotation
from scipy.special import huber

from jaxfit.model.camera import CropCamera
from jaxfit.model.kinematics import fold_bird
from jaxfit.model.rotation import axis_angle_to_matrix
from jaxfit.objective.objective import evaluate_terms
from jaxfit.objective.posed_window import PosedWindow, Raster, Targets, priors_of
from jaxfit.objective.registry import find_term, find_terms, known_terms
from jaxfit.objective.residuals import residual_sum
from jaxfit.raster.silhouette_reference import Blur
from support.birds import random_pose, skin_by_hand, tiny_bird

T, SIZE = 3, 32
FRAME_S = 1 / 30
TERMS = tuple(known_terms())
CAMERA = CropCamera(focal_px=240.0, centre_px=SIZE / 2, size_px=SIZE)
RASTER = Raster(Blur.for_size(SIZE), SIZE)


def correlated_bird():
    """The tiny bird with priors that are not diagonal, so that the tests detect a transposed whitening matrix."""
    bird, rng = tiny_bird(), np.random.default_rng(5)
    a, b = rng.normal(size=(9, 9)), rng.normal(size=(3, 3))
    return dataclasses.replace(
        bird,
        pose_mean=jnp.asarray(0.2 * rng.normal(size=9), jnp.float32),
        pose_covariance=jnp.asarray(0.05 * a @ a.T + 0.05 * np.eye(9), jnp.float32),
        bone_mean=jnp.asarray(1 + 0.1 * rng.normal(size=3), jnp.float32),
        bone_covariance=jnp.asarray(0.01 * b @ b.T + 0.01 * np.eye(3), jnp.float32),
        shape_variance=jnp.array([0.5, 2.0]),
        joint_limits=jnp.asarray(np.sort(rng.normal(size=(3, 3, 2)) * 0.1), jnp.float32),
    )


BIRD = correlated_bird()
RIG, PRIORS = fold_bird(BIRD), priors_of(BIRD)


def window_pose(seed=0, spread=0.2):
    """A window of T frames with different poses."""
    frames = [jax.tree.map(np.asarray, random_pose(BIRD, seed + t, spread)) for t in range(T)]
    stacked = jax.tree.map(lambda *x: np.stack(x), *frames)
    transl = np.float32(0.2) * (stacked.transl - np.float32([0, 0, 150])) + np.float32([0, 0, 160])
    first = frames[0]
    pose = dataclasses.replace(stacked, transl=transl, bone_length=first.bone_length, betas=first.betas)
    return jax.device_put(pose)


def random_targets(seed=0):
    """Random targets of T frames, all with keypoints and mask."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((T, SIZE, SIZE), np.uint8)
    mask[:, 8:22, 6:25] = 1
    targets = Targets(
        keypoints_px=np.float32(rng.uniform(0, SIZE, (T, BIRD.num_keypoints, 2))),
        confidence=np.float32(rng.uniform(0.1, 1, (T, BIRD.num_keypoints))),
        mask=mask,
        has_mask=np.ones(T, bool),
        present=np.ones(T, bool),
        corner_px=np.float32(rng.uniform(0, 5, (T, 2))),
        frame_s=np.array(FRAME_S, np.float32),
    )
    return jax.device_put(targets)


def without_frame(targets, t):
    """The same targets with frame `t` missing, as in the targets of a fit."""
    targets = jax.tree.map(np.array, targets)
    targets.confidence[t], targets.has_mask[t], targets.present[t] = 0, False, False
    return targets


def posed_window(pose, targets, anchor=None, shared=()):
    return PosedWindow(pose, pose if anchor is None else anchor, targets, RIG, PRIORS, CAMERA, RASTER, shared)


def random_motion(frames, seed=0, missing=(), spread=1.0, bones=4):
    """Random global orientation (T, 3) and body pose (T, bones, 3), radians; False for the missing frames (T,)."""
    rng = np.random.default_rng(seed)
    present = np.ones(frames, bool)
    present[list(missing)] = False
    return spread * rng.normal(size=(frames, 3)), spread * rng.normal(size=(frames, bones, 3)), present


@functools.partial(jax.jit, static_argnums=0)
def _term_value(term, orient, body, present, frame_s, settings):
    window = SimpleNamespace(
        pose=SimpleNamespace(global_orient=orient, body_pose=body),
        R_camera_root=axis_angle_to_matrix(orient),
        R_parent_child=axis_angle_to_matrix(body),
        present=present,
        frame_s=frame_s,
    )
    return residual_sum(term(window, **settings))


def term_value(term, orient, body, present, frame_s=FRAME_S, **settings):
    """A temporal term of a motion, in a window that has only rotations."""
    orient, body = (x if isinstance(x, jax.Array) else np.float32(x) for x in (orient, body))
    return _term_value(term, orient, body, present, np.float32(frame_s), settings)


def all_settings():
    return {name: {"weight": 1.0, **find_term(name).settings} for name in TERMS}


@jax.jit
def every_term(pose, anchor, targets, settings):
    return evaluate_terms(posed_window(pose, targets, anchor), find_terms(settings), settings)


@jax.jit
def every_gradient(pose, anchor, targets, settings):
    """Value and derivative with respect to the pose of each term, in one program."""

    def terms(pose):
        values = evaluate_terms(posed_window(pose, targets, anchor), find_terms(settings), settings)
        return jnp.stack([values[name] for name in TERMS])

    value, pullback = jax.vjp(terms, pose)
    gradients = jax.vmap(lambda row: pullback(row)[0])(jnp.eye(len(TERMS)))
    return {name: (value[i], jax.tree.map(lambda g, i=i: g[i], gradients)) for i, name in enumerate(TERMS)}


def frame(pose, t):
    return dataclasses.replace(
        pose,
        global_orient=pose.global_orient[t],
        body_pose=pose.body_pose[t],
        transl=pose.transl[t],
        scale=pose.scale[t],
    )


def pixels(points):
    points = np.asarray(points, np.float64)
    return CAMERA.focal_px * points[..., :2] / points[..., 2:] + CAMERA.centre_px


@functools.cache
def soft_silhouettes(seed):
    """SoftRas in double precision, face by face: 1 − Π (1 − sigmoid(−d/s)) within the blur radius."""
    pose, images = window_pose(seed), []
    at = np.arange(SIZE) + 0.5
    p = np.stack(np.meshgrid(at, at), -1).reshape(-1, 2)
    for t in range(T):
        passed = np.ones(len(p))
        for corners in pixels(skin_by_hand(BIRD, frame(pose, t))[0])[np.asarray(BIRD.faces)]:
            squared, sides = [], []
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                along = np.clip((p - a) @ (b - a) / max((b - a) @ (b - a), 1e-20), 0, 1)
                squared.append(((p - a - along[:, None] * (b - a)) ** 2).sum(-1))
                sides.append((b - a)[0] * (p - a)[:, 1] - (b - a)[1] * (p - a)[:, 0])
            distance, sides = np.min(squared, 0), np.array(sides)
            inside = (sides >= 0).all(0) | (sides <= 0).all(0)
            near = inside | (distance < RASTER.blur.radius**2)
            signed = np.where(inside, -distance, distance)
            passed *= np.where(near, 1 - 1 / (1 + np.exp(np.minimum(signed / RASTER.blur.sigma, 700))), 1)
        images.append((1 - passed).reshape(SIZE, SIZE))
    return np.array(images)


def mahalanobis(x, mean, covariance):
    offset = np.asarray(x, np.float64).reshape(-1) - np.asarray(mean, np.float64)
    return offset @ np.linalg.solve(np.asarray(covariance, np.float64), offset)


def angles_between(one, other):
    """Angles between the global orientations and between the joint rotations of two frames, by scipy."""
    a, b = (np.concatenate([np.asarray(p.global_orient)[None], np.asarray(p.body_pose)]) for p in (one, other))
    return (Rotation.from_rotvec(a.astype(float)).inv() * Rotation.from_rotvec(b.astype(float))).magnitude()


def student_t(squared, dof, size):
    """Negative log-density of `size` residuals of scale 1, without the value at 0."""
    return (dof + size) / 2 * np.log1p(np.asarray(squared) / dof)


def accelerations(rotvec):
    """Changes of the rotation between consecutive frames, (T − 2, …, 3) radians per frame², by scipy."""
    R = [Rotation.from_rotvec(np.reshape(frame, (-1, 3)).astype(float)) for frame in rotvec]
    steps = [(a.inv() * b).as_rotvec() for a, b in itertools.pairwise(R)]
    return np.diff(steps, axis=0).reshape(-1, *np.shape(rotvec)[1:])


def motion_by_hand(orient, body, present, frame_s=FRAME_S, sd_rad_s2=6.25, dof=1.0):
    """The term `motion_likelihood` by its equation."""
    total = 0.0
    for theta in (orient, body):
        for i in range(len(theta) - 2):
            if all(present[i : i + 3]):
                a = accelerations(theta[i : i + 3]) / frame_s**2
                total += student_t((a**2).sum(-1) / sd_rad_s2**2, dof, 3).sum()
    return total


def oracle(name, pose, anchor, targets, seed):
    """A term by its equation, frame by frame in double precision."""
    total = 0.0
    for t in range(T):
        if name == "keypoints":
            points = np.asarray(BIRD.keypoint_weights) @ skin_by_hand(BIRD, frame(pose, t))[0]
            e2 = (pixels(points) - np.asarray(targets.keypoints_px[t])) ** 2
            total += (np.asarray(targets.confidence[t])[:, None] * (50**2 * e2 / (50**2 + e2))).sum()
        elif name == "keypoint_likelihood":
            points = np.asarray(BIRD.keypoint_weights) @ skin_by_hand(BIRD, frame(pose, t))[0]
            c = np.asarray(targets.confidence[t], np.float64)
            s = np.exp(c * np.log(1.2) + (1 - c) * np.log(6))
            e2 = ((pixels(points) - np.asarray(targets.keypoints_px[t])) ** 2).sum(-1)
            total += student_t(e2 / s**2, 4, 2)[c > 0].sum()
        elif name in ("mask", "mask_smooth_l1"):
            e = np.abs(soft_silhouettes(seed)[t] - np.asarray(targets.mask[t]))
            total += e.sum() if name == "mask" else (0.5 * e**2).sum()
        elif name == "pose_prior":
            total += mahalanobis(pose.body_pose[t], BIRD.pose_mean, BIRD.pose_covariance)
        elif name == "stage_anchor":
            total += np.abs(np.asarray(pose.body_pose[t] - anchor.body_pose[t])).sum()
    betas = np.asarray(pose.betas, np.float64)
    if name == "bone_prior":
        total = mahalanobis(pose.bone_length, BIRD.bone_mean, BIRD.bone_covariance)
    elif name == "size_prior":
        log_sizes = np.log(np.broadcast_to(np.asarray(pose.scale, np.float64), T))[np.asarray(targets.present)]
        total = ((log_sizes / 0.05) ** 2).mean()
    elif name == "shape_prior":
        total = (betas**2 / np.asarray(BIRD.shape_variance)).sum()
    elif name == "shape_norm":
        total = np.sqrt((betas**2).sum())
    elif name == "stage_anchor":
        total += np.abs(np.asarray(pose.bone_length - anchor.bone_length)).sum()
    elif name == "joint_limits":
        low, high = np.moveaxis(np.asarray(BIRD.joint_limits, np.float64), -1, 0)
        for theta in np.asarray(pose.body_pose, np.float64):
            total += (np.where(theta < low, low - theta, 0) ** 2 + np.where(theta > high, theta - high, 0) ** 2).sum()
    elif name in ("geodesic_velocity", "huber_velocity"):
        for i in range(T - 1):
            turned, *bent = angles_between(frame(pose, i), frame(pose, i + 1))
            if name == "geodesic_velocity":
                total += 10 * turned + np.sqrt(np.square(bent).sum())
            else:
                total += 10 * huber(0.1, turned) + huber(0.1, bent).sum()
    elif name == "place_likelihood":
        place = pixels(np.asarray(pose.transl, np.float64)) + np.asarray(targets.corner_px, np.float64)
        for i in range(T - 2):
            if all(targets.present[i : i + 3]):
                a = (place[i] - 2 * place[i + 1] + place[i + 2]) / FRAME_S**2
                total += student_t((a**2).sum() / 300**2, 1, 2)
    elif name == "motion_likelihood":
        total += motion_by_hand(pose.global_orient, pose.body_pose, targets.present)
    elif name == "low_pass":
        for theta in (pose.global_orient, pose.body_pose.reshape(T, -1)):
            for k, coefficients in enumerate(dct(np.asarray(theta, np.float64), axis=0, norm="ortho")[1:], start=1):
                total += (coefficients**2).sum() / (1 + (0.15 / (k / (2 * T))) ** 8)
    elif name == "feet_on_ground":
        feet = [BIRD.keypoint_names.index(foot) for foot in ("left_foot", "right_foot")]
        posed = [np.asarray(BIRD.keypoint_weights) @ skin_by_hand(BIRD, frame(pose, t))[0] for t in range(T)]
        # pixels in the crop of the first frame, then back-projection to the depth of the feet
        corner = np.asarray(targets.corner_px, np.float64) - CAMERA.centre_px
        feet_px = [pixels(posed[t][feet]) + corner[t] - np.asarray(targets.corner_px[0]) for t in range(T)]
        feet_cam = [np.c_[feet_px[t] * posed[t][feet, 2:] / CAMERA.focal_px, posed[t][feet, 2]] for t in range(T)]
        for i in range(T - 1):
            d2 = ((feet_cam[i + 1] - feet_cam[i]) ** 2).sum(-1)
            total += (0.25 * d2 / (0.25 + d2)).sum()
    elif name in ("velocity", "acceleration"):
        order = 1 if name == "velocity" else 2
        for theta, beta in ((pose.global_orient, 10), (pose.body_pose.reshape(T, -1), 1)):
            total += beta * np.linalg.norm(np.diff(np.asarray(theta, np.float64), order, axis=0), axis=1).sum()
    return total
