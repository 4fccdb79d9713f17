"""The worlds of `worlds.py`: observations of birds, and the truth about these birds.

1. `murres`: murres on a ledge with simulated detections (`jaxfit.simulation.noise`).
2. `murre_pixels`: murres from pixels. The built-in networks detect and track the birds in simulated footage.
3. `aves_windows`: windows of the AVES model. Masks are exact at the centres of pixels; keypoints have Gaussian errors
   and outliers.
4. `species`: pictures of random species from all sides, for a fit with the mean model. An annotator's keypoints lie
   beside those of the model.
5. `cub`: photographs of five species (CUB-200-2011), without 3D truth.
6. `avian_windows`: windows of the avian-mesh model with 12 keypoints. Keypoints have heavy-tailed errors that differ
   between keypoints and are correlated in time, and some keypoints are missing.
7. `aves_individuals`: windows of the AVES model whose birds have bones and shapes from the priors of AVES. Errors of
   the keypoints are correlated in time and larger in fast motion, 5 % are outliers of 30 px, and masks are 0.44 px too
   large.

8. `other_models`: windows as in world 7 whose birds have another model than the fit. The part names the true model and
   the model of the fit: AVES and avian-mesh, avian-mesh and AVES, and a random species (from the shape space of AVES)
   and the murre. Both models have only their common keypoints: nine (bill tip, eyes, nape, wingtips, feet, tail tip),
   and for the murre the 18 of AVES. Even where they share a name, the keypoints lie at different places of the bodies.

9. `murre_views`: murres that two, three or four of four calibrated cameras see, with simulated detections, and in the
   last part four cameras with exact keypoints and masks. The cameras tell the size of a bird and its place.

Birds are individuals: in worlds 1, 2, 3, 6 and 9 their bones differ by 5 % from those of the model, in world 3 also
their shapes, and in worlds 1 and 9 the keypoints of the detector lie beside those of the model. With `equal`, all birds
of these worlds have the body of the model, in the same motion. World 4 draws species, world 5 is real, and worlds 7 and
8 are without this choice.

In worlds 3, 4, 6, 7 and 8, every bird has an image of its own, so that no bird hides another bird.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Array, Float
from reference_data import reference_folder
from scipy.spatial.transform import Rotation
from speed import NOISE_PX, OUTLIERS

from jaxfit.config.reconstruct import load_reconstruct_config
from jaxfit.data.formats import FOOTAGE
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.masks import box_of_mask, decode_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution
from jaxfit.data.view_matching import match_birds
from jaxfit.data.views import Views, birds_in_rows
from jaxfit.fitting.initial_poses import InitialPoses, load_initial_poses
from jaxfit.foundation.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CropCamera, project, to_screen
from jaxfit.model.files import load_murre
from jaxfit.model.kinematics import (
    Pose,
    Rig,
    fold_bird,
    joint_transforms,
    posed_keypoints,
    posed_vertices,
    window_transforms,
    window_vertices,
)
from jaxfit.model.published import import_model
from jaxfit.perception.track import track_video
from jaxfit.raster.zbuffer import hard_mask
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.individuals import draw_bones, draw_bones_of_prior, draw_offsets, draw_shape
from jaxfit.simulation.noise import autoregressive, detect
from jaxfit.simulation.rig import stage_rig
from jaxfit.simulation.scene import simulate, stage_scene
from jaxfit.simulation.species import random_pose, random_species

CAMERA = CropCamera()
"""The camera of world 4."""
WIDE = CropCamera(focal_px=CAMERA.focal_px, centre_px=256.0, size_px=512)
"""The camera of the worlds 3 and 6. In an image of 256 pixels, the border would cut off bill or tail of most birds."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Observations of some birds, and the truth about these birds."""

    bird: Bird
    """The model of the fit."""
    observations: Observations
    """The input of the fit."""
    exact: Observations
    """True keypoints and whole masks; annotations in world 5."""
    poses: Solution | None
    """True poses, in the camera of the image; None without 3D truth."""
    part: str = ""
    """Part of the world that is also reported alone."""
    initial_poses: InitialPoses | None = None
    """Initial poses for the config `aves`."""
    true_bird: Bird | None = None
    """The model of the true poses, with the same keypoints; None for the model of the fit."""
    views: Views | None = None
    """Several cameras, of which `observations` is the first; the true poses are in the frame of the first camera."""


class World(NamedTuple):
    """A world: a name and a function that draws its scenes."""

    name: str
    draw: Callable[[int, bool, bool], list[Scene]]
    """From a seed, whether the scenes are small, and whether the birds have equal bodies, to the scenes."""
    reference: str
    """The config that no other config may be worse than."""
    pictures: bool = False
    """Whether frames are single pictures without motion."""
    birds: str = "birds"
    """What is resampled for the intervals."""
    seeds: bool = True
    """Whether the scenes differ between seeds."""


def bodies(equal: bool) -> dict[str, float]:
    """Return the arguments of a simulated scene for individuals, or for equal bodies."""
    return {"bone_sd": 0.0, "keypoint_offset": 0.0} if equal else {}


def murres(seed: int, quick: bool, equal: bool) -> list[Scene]:
    """Draw a scene of murres with simulated detections."""
    bird = load_murre()
    scene = stage_scene(bird, *((3, 20) if quick else (5, 60)), seed=seed, **bodies(equal))
    return [Scene(bird, scene.detections, scene.truth, scene.poses)]


def murre_pixels(seed: int, quick: bool, equal: bool) -> list[Scene]:
    """Draw a scene of murres, film the scene, and track the birds in the footage with the built-in networks."""
    bird = load_murre()
    with tempfile.TemporaryDirectory() as folder:
        scene = simulate(bird, Path(folder) / "scene", *((3, 20) if quick else (5, 60)), seed=seed, **bodies(equal))
        tracks = track_video(Path(folder) / "scene" / FOOTAGE, load_reconstruct_config().track)
    return [Scene(bird, tracks, scene.truth, scene.poses)]


def murre_views(seed: int, quick: bool, equal: bool) -> list[Scene]:
    """Draw a scene of murres that four cameras without distortion see."""
    bird = load_murre()
    rig = stage_rig(bird, 4, *((2, 20) if quick else (3, 60)), size=(1296, 760), seed=seed, **bodies(equal))
    scenes = []
    for part, count in {"2 views": 2, "3 views": 3, "4 views": 4, "4 views, exact": 4}.items():
        cameras, staged = rig.cameras[:count], rig.scenes[:count]
        tracks = [scene.truth if part.endswith("exact") else scene.detections for scene in staged]
        matches = match_birds(cameras, tracks)
        ids = range(1, matches.birds + 1)
        rows = tuple(birds_in_rows(*each, ids) for each in zip(tracks, matches.bird, strict=True))
        views = Views(cameras, cameras, rows)
        scenes.append(Scene(bird, rows[0], staged[0].truth, staged[0].poses, part, views=views))
    return scenes


def published(kind: str, folder: str) -> Bird:
    """Return a model of the reference data.

    Raises:
        InputError: there are no reference data.
    """
    reference = reference_folder()
    if reference is None:
        raise InputError(
            "reference data", "are missing", "set JAXFIT_REFERENCE to their folder, or choose world 1 or 2"
        )
    return import_model(kind, [reference / "models" / folder])


def aves_windows(seed: int, quick: bool, equal: bool) -> list[Scene]:
    """Draw windows of the AVES model; keypoints have Gaussian errors of 2 px, and 5 % are outliers."""
    bird = published("aves", "aves")
    return [windows_of(bird, (3, seed), *_window_size(quick), _gaussian_errors, _mean_body if equal else _individual)]


def avian_windows(seed: int, quick: bool, equal: bool) -> list[Scene]:
    """Draw windows of the avian-mesh model with 12 keypoints, of which some are missing."""
    bird = published("avian-mesh", "avian_mesh")
    return [windows_of(bird, (6, seed), *_window_size(quick), _heavy_errors, _mean_body if equal else _individual)]


def aves_individuals(seed: int, quick: bool, _equal: bool) -> list[Scene]:
    """Draw windows of individuals from the priors of AVES, with correlated errors and masks that are too large."""
    bird = published("aves", "aves")
    return [windows_of(bird, (7, seed), *_window_size(quick), _correlated_errors, _of_prior, GROWN_PX)]


def other_models(seed: int, quick: bool, _equal: bool) -> list[Scene]:
    """Draw windows of individuals for fits with another model than the true one."""
    aves, avian = published("aves", "aves"), published("avian-mesh", "avian_mesh")
    pairs = {
        "AVES, fitted by avian-mesh": (aves, avian, _of_prior),
        "avian-mesh, fitted by AVES": (avian, aves, _of_prior),
        "species, fitted by the murre": (random_species(aves, 1000 + seed), load_murre(), _individual),
    }
    scenes = []
    for i, (part, (true, fitted, draw_body)) in enumerate(pairs.items()):
        common = tuple(name for name in fitted.keypoint_names if name in true.keypoint_names)
        bird = with_keypoints(true, common)
        scene = windows_of(bird, (8, seed, i), *_window_size(quick), _correlated_errors, draw_body, GROWN_PX)
        # birds of different parts must have different names, so that the intervals count all birds
        ids = 10 * i + scene.exact.track_id
        observations, exact, poses = (
            replace(each, track_id=ids) for each in (scene.observations, scene.exact, scene.poses)
        )
        scenes.append(Scene(with_keypoints(fitted, common), observations, exact, poses, part, true_bird=bird))
    return scenes


def with_keypoints(bird: Bird, names: Sequence[str]) -> Bird:
    """Return a model with only some of its keypoints, in the order of the names."""
    at = [bird.keypoint_names.index(name) for name in names]
    pairs = tuple((at.index(left), at.index(right)) for left, right in bird.keypoint_pairs if {left, right} <= set(at))
    weights = bird.keypoint_weights[np.array(at)]
    return replace(bird, keypoint_weights=weights, keypoint_names=tuple(names), keypoint_pairs=pairs)


def _window_size(quick: bool) -> tuple[int, int]:
    """Return the number of birds and of frames."""
    return (2, 20) if quick else (3, 100)


DrawBody = Callable[[Bird, np.random.Generator], tuple[np.ndarray, np.ndarray]]
"""Draws the bone lengths and the shape coefficients of an individual."""


def _mean_body(bird: Bird, _rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(bird.bone_mean), np.zeros(bird.num_shapes, np.float32)


def _individual(bird: Bird, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw bones that differ by 5 %, and a shape from the shape space."""
    return draw_bones(bird, rng), draw_shape(bird, rng)


def _of_prior(bird: Bird, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw bones and shape from the priors of the model."""
    return draw_bones_of_prior(bird, rng), draw_shape(bird, rng)


def windows_of(
    bird: Bird,
    seed: tuple[int, ...],
    birds: int,
    frames: int,
    errors: Callable[[np.random.Generator, Observations], Observations],
    draw_body: DrawBody = _mean_body,
    grown_px: float = 0.0,
) -> Scene:
    """Draw smooth random motion of some birds, each in images of its own; the masks of the truth are exact.

    Args:
        bird: the model.
        seed: number of the world, and seed; every pair has other motion and other errors.
        birds: number of birds.
        frames: number of frames.
        errors: from exact observations to observations with errors of the keypoints.
        draw_body: the bodies of the birds; the motion does not depend on it.
        grown_px: masks include all pixels whose centre is at most this far outside the bird.
    """
    poses = [smooth_motion(bird, frames, int(motion)) for motion in np.random.SeedSequence(seed).generate_state(birds)]
    rng = np.random.default_rng((*seed, 11))
    for n, (bone_length, betas) in enumerate(draw_body(bird, rng) for _ in range(birds)):
        poses[n] = replace(poses[n], bone_length=bone_length, betas=betas)
    exact = detect(bird, poses, camera=WIDE)
    own_images = {(n, t): (f"bird_{n}/{t:06d}.png", *exact.image_size(n, t)) for n, t in exact.masks}
    exact = replace(exact, own_images=own_images, amodal_masks=exact.masks)
    stacked = jax.tree.map(lambda *values: np.stack(values), *poses)

    def each_frame(values: np.ndarray) -> np.ndarray:
        return np.repeat(values[:, None], frames, axis=1)

    stacked = replace(
        stacked,
        scale=np.broadcast_to(stacked.scale, (birds, frames)),
        bone_length=each_frame(stacked.bone_length),
        betas=each_frame(stacked.betas),
    )
    observations = replace(errors(np.random.default_rng((*seed, 8)), exact), amodal_masks={})
    if grown_px:
        rig, faces, masks = fold_bird(bird), np.asarray(bird.faces), {}
        for n, pose in enumerate(poses):
            screens = np.asarray(to_screen(window_vertices(rig, window_transforms(rig, pose), pose), WIDE))
            masks |= {
                (n, t): encode_mask(grown_mask(screen, faces, WIDE.size_px, grown_px))
                for t, screen in enumerate(screens)
            }
        boxes = [[box_of_mask(decode_mask(masks[n, t])) for t in range(frames)] for n in range(birds)]
        observations = replace(observations, masks=masks, box_px=np.float32(boxes))
    return Scene(bird, observations, exact, true_solution(bird, stacked, exact, WIDE))


FINE = 5
"""Samples of a pixel, in x and y, for masks that are larger than the bird; the middle sample is the centre."""


def grown_mask(screen: Float[np.ndarray, "V 3"], faces: np.ndarray, size_px: int, grown_px: float) -> np.ndarray:
    """Return the pixels whose centre lies inside the projection of a mesh, or at most `grown_px` outside.

    Args:
        screen: x and y in pixels, and depth.
        faces: faces of the mesh.
        size_px: width and height of the picture.
        grown_px: distance in pixels; distances are precise to about a fifth of a pixel.
    """
    margin = int(np.ceil(grown_px)) + 1
    (x, y), (right, bottom) = (
        np.clip(side.astype(int), 0, size_px)
        for side in (screen[:, :2].min(0) - margin, screen[:, :2].max(0) + margin + 1)
    )
    width, height = right - x, bottom - y
    moved = np.float32((screen - [x, y, 0]) * [FINE, FINE, 1])
    fine = hard_mask(moved, faces, int(FINE * width), int(FINE * height))
    # the border of the bird lies half a sample outside the outermost sample, on average
    distance = cv2.distanceTransform((~fine).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    mask, middle = np.zeros((size_px, size_px), bool), slice(FINE // 2, None, FINE)
    mask[y:bottom, x:right] = distance[middle, middle] <= FINE * grown_px + 0.5
    return mask


def true_solution(bird: Bird, pose: Pose, exact: Observations, camera: CropCamera) -> Solution:
    """Return true poses as a result whose crop is the whole image.

    Args:
        bird: the model.
        pose: the poses; every field has leading axes (N, T).
        exact: the true observations.
        camera: the camera of the image.
    """
    keypoints_cam = np.asarray(keypoints_of(fold_bird(bird), pose), np.float64)
    birds, frames = exact.present.shape
    return Solution.from_arrays(
        track_id=exact.track_id,
        frame_index=exact.frame_index,
        valid=exact.present,
        global_orient=np.asarray(pose.global_orient),
        body_pose=np.asarray(pose.body_pose),
        transl=np.asarray(pose.transl),
        scale=np.asarray(pose.scale),
        bone_length=np.asarray(pose.bone_length),
        betas=np.asarray(pose.betas),
        keypoints_cam=keypoints_cam,
        keypoints_px=np.asarray(project(keypoints_cam, camera)),
        crop=np.broadcast_to(np.float32([0, 0, camera.size_px]), (birds, frames, 3)),
        image_size_px=np.full((birds, frames, 2), camera.size_px),
        focal_px=camera.focal_px,
        keypoint_names=bird.keypoint_names,
        joint_names=bird.joint_names,
        crop_px=camera.size_px,
        loss={},
        status=np.full(birds, "ok"),
    )


@jax.jit
def keypoints_of(rig: Rig, poses: Pose) -> Float[Array, "N T K 3"]:
    """Return the keypoints of poses with leading axes (N, T), camera frame."""
    return jax.vmap(jax.vmap(lambda pose: posed_keypoints(rig, joint_transforms(rig, pose), pose)))(poses)


def _gaussian_errors(rng: np.random.Generator, exact: Observations) -> Observations:
    """Add Gaussian errors to the keypoints, and place some at random around the bird; all confidences are 1."""
    points = exact.keypoints_px + NOISE_PX * rng.standard_normal(exact.keypoints_px.shape)
    is_outlier = rng.random(exact.confidence.shape) < OUTLIERS
    low, size = exact.box_px[..., None, :2], exact.box_px[..., None, 2:]
    points = np.where(is_outlier[..., None], low + size * rng.uniform(-0.2, 1.2, points.shape), points)
    return exact.with_keypoints(points, exact.confidence)


MISSING, RHO, DOF = 0.15, 0.7, 3.0
"""Share of missing keypoints, correlation of an error between consecutive frames, degrees of freedom of the tails."""


def _heavy_errors(rng: np.random.Generator, exact: Observations) -> Observations:
    """Add errors to the keypoints whose scale differs between keypoints (0.7 to 3 px), with heavy tails.

    The errors are Student-t distributed and correlated in time. A missing keypoint is missing in runs of about ten
    frames. The confidence depends on the error weakly.
    """
    N, T, K = exact.confidence.shape
    sd = np.exp(rng.uniform(np.log(0.7), np.log(3.0), (N, 1, K)))
    normal = autoregressive(rng, (N, T, K, 2), RHO)
    error = sd[..., None] * normal / np.sqrt(rng.chisquare(DOF, (N, T, K, 1)) / DOF)
    runs = np.repeat(rng.random((N, -(-T // 10), K)), 10, axis=1)[:, :T]
    ratio = np.linalg.norm(error, axis=-1) / 3.0
    confidence = 1 / (1 + np.exp(-(2.0 - ratio + 0.7 * rng.standard_normal(ratio.shape))))
    confidence = np.where(runs < MISSING, 0.0, confidence)
    return exact.with_keypoints(exact.keypoints_px + error, confidence)


ERROR_PX, MOTION, AR1, OUTLIER_PX, GROWN_PX = 3.0, 0.15, 0.7, 30.0, 0.44
"""World 7: standard deviation of an error of a keypoint at rest (pixels), its increase per pixel of motion per frame,
its correlation between consecutive frames, standard deviation of an outlier, and what masks are too large (pixels)."""


def _correlated_errors(rng: np.random.Generator, exact: Observations) -> Observations:
    """Add errors of the keypoints, which are correlated in time and larger in fast motion, and enlarge the masks.

    The errors of x and y are σ · z with σ² = ERROR_PX² + (MOTION · displacement to the next frame)². z has unit
    variance and is AR(1): z_t = ρ z_{t−1} + √(1 − ρ²) w_t with ρ = 0.7. Outliers are independent between frames. All
    confidences are 1.
    """
    points = exact.keypoints_px.astype(np.float64)
    z = autoregressive(rng, points.shape, AR1)
    moved = np.linalg.norm(np.diff(points, axis=1, append=points[:, -1:]), axis=-1, keepdims=True)
    error = np.hypot(ERROR_PX, MOTION * moved) * z
    is_outlier = rng.random(exact.confidence.shape) < OUTLIERS
    error = np.where(is_outlier[..., None], OUTLIER_PX * rng.standard_normal(points.shape), error)
    return exact.with_keypoints(points + error, exact.confidence)


PICTURE_NOISE_PX = 1.5
"""Standard deviation of the annotator's errors in x and y, pixels of a 256-pixel picture."""
KEYPOINTS = (12, 18)
"""Fewest and most annotated keypoints of a picture."""


def species(seed: int, quick: bool, _equal: bool) -> list[Scene]:
    """Draw pictures of 20 random species: half of the pictures have masks.

    The pictures of a species show different individuals in different poses from random directions.
    """
    bird = published("aves", "aves")
    scenes = []
    for part, first in (("with masks", 0), ("without masks", 1)):
        scene = pictures_of(bird, seed, range(4 if quick else 20), 1 if quick else 2, first)
        if part == "without masks":
            scene = replace(scene, observations=replace(scene.observations, masks={}))
        scenes.append(replace(scene, part=part))
    return scenes


def pictures_of(bird: Bird, seed: int, numbers: Sequence[int], pictures: int, stream: int = 0) -> Scene:
    """Draw pictures of random species from all sides, with an annotator's keypoints and exact masks.

    Args:
        bird: the mean model.
        seed: seed of species and pictures.
        numbers: numbers of the species; a number and a seed give one species and one annotator.
        pictures: number of pictures of each species; each is a track with the name of its species.
        stream: pictures of different streams differ.
    """
    N, K = len(numbers) * pictures, bird.num_keypoints
    rig, faces = fold_bird(bird), np.asarray(bird.faces)
    pose_at = jax.jit(lambda pose: (A := joint_transforms(rig, pose), posed_vertices(rig, A, pose)))
    weights, poses = np.asarray(bird.keypoint_weights, np.float64), []
    exact_px, annotated_px, confidence = np.zeros((N, 1, K, 2)), np.zeros((N, 1, K, 2)), np.zeros((N, 1, K))
    masks, boxes = {}, np.zeros((N, 1, 4), np.float32)
    for s, number in enumerate(numbers):
        member = random_species(bird, 1000 * seed + number)
        betas, offsets = _shape_of(member, bird), draw_offsets(bird, np.random.default_rng((seed, number, 9)))
        rng = np.random.default_rng((seed, number, 10 + stream))
        for n in range(s * pictures, (s + 1) * pictures):
            pose = random_pose(member, rng)
            bones = pose.bone_length * (1 + 0.02 * rng.standard_normal(len(pose.bone_length)))
            shape = betas + 0.2 * np.sqrt(np.asarray(bird.shape_variance)) * rng.standard_normal(bird.num_shapes)
            orient = Rotation.random(rng=rng).as_rotvec()
            pose = replace(pose, global_orient=np.float32(orient), bone_length=np.float32(bones))
            pose = replace(pose, betas=np.float32(shape))
            A, vertices = (np.asarray(array, np.float64) for array in pose_at(pose))
            low, high = vertices.min(0), vertices.max(0)
            depth = CAMERA.focal_px * (high - low)[:2].max() / (CAMERA.size_px * rng.uniform(0.55, 0.8))
            shift = np.float32(np.array([*(0.03 * depth / 10 * rng.standard_normal(2)), depth]) - (low + high) / 2)
            pose, vertices = replace(pose, transl=shift), vertices + shift
            points = weights @ vertices
            moved = np.einsum("kj,jab,kb->ka", np.asarray(rig.keypoint_map)[..., 3], A[..., :3], offsets)
            exact_px[n, 0] = project(points, CAMERA)
            noise = PICTURE_NOISE_PX * rng.standard_normal((K, 2))
            annotated_px[n, 0] = np.asarray(project(points + moved, CAMERA)) + noise
            confidence[n, 0, rng.permutation(K)[: rng.integers(KEYPOINTS[0], min(KEYPOINTS[1], K) + 1)]] = 1
            mask = hard_mask(np.asarray(to_screen(vertices, CAMERA), np.float32), faces, CAMERA.size_px, CAMERA.size_px)
            masks[n, 0], boxes[n, 0] = encode_mask(mask), box_of_mask(mask) or (0, 0, 1, 1)
            poses.append(pose)
    exact = Observations(
        track_id=np.arange(N) + 1,
        frame_index=np.zeros(1, int),
        present=np.ones((N, 1), bool),
        keypoints_px=exact_px,
        confidence=np.ones((N, 1, K)),
        box_px=boxes,
        image_size_px=np.full((1, 2), CAMERA.size_px),
        file_name=np.array(["picture"]),
        species={n + 1: f"species_{numbers[n // pictures]}" for n in range(N)},
        keypoint_names=bird.keypoint_names,
        masks=masks,
        amodal_masks=masks,
        own_images={cell: (f"picture_{cell[0]}.png", CAMERA.size_px, CAMERA.size_px) for cell in masks},
    )
    stacked = jax.tree.map(lambda *values: np.stack(values).reshape(N, 1, *np.shape(values[0])), *poses)
    observed = replace(exact.with_keypoints(annotated_px, confidence), amodal_masks={})
    return Scene(bird, observed, exact, true_solution(bird, stacked, exact, CAMERA))


def _shape_of(member: Bird, bird: Bird) -> Float[np.ndarray, "S"]:
    """Return the shape coefficients of a random species in the shape space of its model."""
    basis = np.asarray(bird.shape_basis, np.float64).reshape(bird.num_shapes, -1)
    change = np.asarray(member.vertices, np.float64) - np.asarray(bird.vertices, np.float64)
    return np.linalg.lstsq(basis.T, change.ravel(), rcond=None)[0]


def cub(seed: int, quick: bool, _equal: bool) -> list[Scene]:
    """Read the photographs of five species, with the initial poses of a pose regressor; the seed has no effect."""
    bird, scenes = published("aves", "aves"), []
    for path in sorted((reference_folder() / "cub").glob("*.json"))[: 1 if quick else None]:
        seen = read_coco(path)
        # birds of different species must have different names, so that the intervals count all birds
        poses = load_initial_poses(path.with_suffix(".init.npz"), seen, bird)
        seen = replace(seen, track_id=seen.track_id + 1000 * int(path.name.split(".")[0]))
        scenes.append(Scene(bird, seen, seen, None, initial_poses=poses))
    return scenes


WORLDS = {
    1: World("murres, simulated detections", murres, "paper"),
    2: World("murres from pixels", murre_pixels, "paper"),
    3: World("windows of AVES, exact masks", aves_windows, "paper"),
    4: World("random species, single pictures", species, "aves", pictures=True, birds="species"),
    5: World("photographs of five species (CUB)", cub, "aves", pictures=True, seeds=False),
    6: World("windows of avian-mesh, 12 keypoints", avian_windows, "paper"),
    7: World("windows of AVES, individuals", aves_individuals, "paper"),
    8: World("windows of another model than that of the fit", other_models, "paper"),
    9: World("murres, several cameras", murre_views, "paper"),
}
"""The worlds by number."""
