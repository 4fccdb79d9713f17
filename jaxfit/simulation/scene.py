"""`simulate`: a scene in a folder, with visible masks, boxes and hidden keypoints."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxfit.data.footage import read_footage
from jaxfit.data.formats import DETECTIONS, FOOTAGE, MARKER, TRUE_POSES, TRUTH
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.masks import box_of_mask, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution, save_solution
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import own_version
from jaxfit.foundation.files import new_folder, write_whole
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.model.bird import Bird, model_hash
from jaxfit.model.camera import CropCamera
from jaxfit.model.kinematics import fold_bird, move_keypoints, window_keypoints, window_transforms
from jaxfit.raster.zbuffer import hard_mask, zbuffer
from jaxfit.simulation.behaviour import BEHAVIOURS
from jaxfit.simulation.flock import SimulatedBird, simulate_flock
from jaxfit.simulation.footage import Footage, random_light
from jaxfit.simulation.individuals import BONE_SD, OFFSET, draw_offsets
from jaxfit.simulation.noise import simulate_detections
from jaxfit.simulation.viewpoint import Viewpoint, random_viewpoint
from jaxfit.video.writer import VideoWriter

SURFACE_TOLERANCE = 0.6
"""A keypoint is visible up to this depth behind the surface of its own bird, model units (1.2 cm)."""


class Visibility(NamedTuple):
    """Masks and keypoints of N birds in one frame."""

    amodal_masks: list[Bool[np.ndarray, "H W"]]
    """The whole mask of each bird, without occlusion."""
    visible_masks: list[Bool[np.ndarray, "H W"]]
    """The part of each mask that is not occluded by other birds."""
    keypoints_px: Float[np.ndarray, "N K 2"]
    inside: Bool[np.ndarray, "N K"]
    """Whether a keypoint lies in the picture."""
    keypoint_visible: Bool[np.ndarray, "N K"]
    """Whether a keypoint lies in the picture and is not occluded by another bird or by its own bird."""


def mesh_keypoints(bird: Bird, vertices_world: Float[np.ndarray, "T N V 3"]) -> Float[np.ndarray, "T N K 3"]:
    """Compute the keypoints of posed birds, world frame."""
    weights = np.asarray(bird.keypoint_weights, np.float64)
    return np.einsum("kv,tnvc->tnkc", weights, vertices_world, optimize=True)


def render_visibility(
    vertices_world: Float[np.ndarray, "N V 3"],
    keypoints_world: Float[np.ndarray, "N K 3"],
    faces: np.ndarray,
    view: Viewpoint,
) -> Visibility:
    """Render the masks of one frame and project the keypoints; masks are exact at pixel centres.

    Args:
        vertices_world: vertices of the birds, model units.
        keypoints_world: keypoints of the birds, model units.
        faces: (F, 3) faces of one bird.
        view: the camera.
    """
    N, V = vertices_world.shape[:2]
    screen = view.to_screen(vertices_world).astype(np.float32)
    shape = (view.height, view.width)
    amodal_masks = [hard_mask(mesh, faces, view.width, view.height) for mesh in screen]
    owner, depth = np.full(shape, -1), np.full(shape, np.inf, np.float32)
    low = np.clip(np.floor(screen[..., :2].min((0, 1))).astype(int), 0, [view.width, view.height])
    high = np.clip(np.ceil(screen[..., :2].max((0, 1))).astype(int), 0, [view.width, view.height])
    columns, rows = high - low
    if columns > 0 and rows > 0:
        all_faces = np.concatenate([faces + n * V for n in range(N)])
        fragments = zbuffer(
            (screen - np.array([*low, 0], np.float32)).reshape(-1, 3), all_faces, int(columns), int(rows)
        )
        box = slice(low[1], high[1]), slice(low[0], high[0])
        owner[box] = np.where(fragments.face >= 0, fragments.face // len(faces), -1)
        depth[box] = fragments.depth
    points = view.to_screen(keypoints_world)
    inside = np.all((points[..., :2] >= 0) & (points[..., :2] < [view.width, view.height]), axis=-1)
    column, row = (np.clip(points[..., i].astype(int), 0, side - 1) for i, side in enumerate(shape[::-1]))
    tolerance = np.where(owner[row, column] == np.arange(N)[:, None], SURFACE_TOLERANCE, 0)  # only for the own surface
    visible = inside & (points[..., 2] <= depth[row, column] + tolerance)
    return Visibility(amodal_masks, [owner == n for n in range(N)], points[..., :2], inside, visible)


VERSION = own_version()
LEDGE_DEPTH = 62.0
"""Distance from the edge of the ledge to the wall, model units (1.24 m)."""
LARGEST_SIDE, SMALLEST_SIDE = 8192, 160
MAX_POSES = 14_000
"""Largest birds × frames that fits in the memory of a small machine."""


class Scene(NamedTuple):
    """A simulated scene without its footage."""

    birds: list[SimulatedBird]
    view: Viewpoint
    truth: Observations
    """Exact keypoints, visible and amodal masks; boxes of the amodal masks."""
    poses: Solution
    """Exact poses, in the camera of the scene."""
    detections: Observations
    """Simulated detections."""


def stage_scene(
    bird: Bird,
    birds: int = 7,
    frames: int = 100,
    size: tuple[int, int] = (2592, 1520),
    fps: float = 25.0,
    seed: int = 0,
    bone_sd: float = BONE_SD,
    keypoint_offset: float = OFFSET,
    progress: ProgressTask = silent,
) -> Scene:
    """Simulate birds on a ledge, their exact observations, and the detections of a simulated detector.

    Args:
        bird: the model, with the joint names of `jaxfit.load_murre`.
        birds: number of birds, at least 1.
        frames: number of frames, at least 2.
        size: width and height of the picture, pixels.
        fps: frames per second.
        seed: 0 or more; the same seed gives the same scene.
        bone_sd: standard deviation of the length of each bone between birds, as a share of the length; 0 gives every
            bird the bones of the model. Cameras and behaviours do not depend on it.
        keypoint_offset: mean distance between the keypoints of the detector and those of the model, as a share of the
            body length (`draw_offsets`); the offsets are the same for all birds and frames. The truth is without them.
        progress: reports every frame.

    Raises:
        InputError: a number outside its range.
    """
    check_scene(birds, frames, size, fps, seed, bone_sd, keypoint_offset)
    view = random_viewpoint(np.random.default_rng((seed, 0)), *size, LEDGE_DEPTH)
    flock = simulate_flock(bird, birds, frames, fps, LEDGE_DEPTH, view, seed, bone_sd=bone_sd)
    offsets = scene_offsets(bird, seed, keypoint_offset)
    return stage_view(bird, flock, view, fps, seed, offsets, progress, "Staging the scene")


def scene_offsets(bird: Bird, seed: int, mean: float) -> Float[np.ndarray, "K 3"]:
    """Draw the offsets of the detector's keypoints in a scene; see `draw_offsets`."""
    return draw_offsets(bird, np.random.default_rng((seed, 7)), mean)


def stage_view(
    bird: Bird,
    flock: list[SimulatedBird],
    view: Viewpoint,
    fps: float,
    seed: int,
    offsets: Float[np.ndarray, "K 3"],
    progress: ProgressTask,
    title: str,
) -> Scene:
    """Return what one camera sees of simulated birds, and the detections of a simulated detector.

    Args:
        bird: the model.
        flock: the birds, with their poses in the frame of this camera.
        view: the camera.
        fps: frames per second.
        seed: seed of the detections.
        offsets: offsets of the detector's keypoints, in the rest pose, model units.
        progress: reports every frame.
        title: text of the progress.
    """
    birds, frames, size = len(flock), len(flock[0].behaviour), (view.width, view.height)
    vertices = np.stack([simulated.vertices_world for simulated in flock], axis=1)  # T N V 3
    keypoints = mesh_keypoints(bird, vertices)
    K = bird.num_keypoints
    points, inside, visible = np.zeros((birds, frames, K, 2)), *np.zeros((2, birds, frames, K), bool)
    boxes, amodal_masks, visible_masks = np.zeros((birds, frames, 4), np.float32), {}, {}
    faces = np.asarray(bird.faces)
    with progress(title, frames) as report_progress:
        for t in range(frames):
            rendered = render_visibility(vertices[t], keypoints[t], faces, view)
            points[:, t], inside[:, t], visible[:, t] = (
                rendered.keypoints_px,
                rendered.inside,
                rendered.keypoint_visible,
            )
            for n in range(birds):
                box = box_of_mask(rendered.amodal_masks[n])
                if box is None:
                    continue  # the bird is outside the picture
                amodal_masks[n, t], boxes[n, t] = encode_mask(rendered.amodal_masks[n]), box
                if rendered.visible_masks[n].any():
                    visible_masks[n, t] = encode_mask(rendered.visible_masks[n])
            report_progress(1, "")
    present = boxes[..., 2] > 0
    labelled = inside & present[..., None]
    truth = Observations(
        track_id=np.arange(1, birds + 1),
        frame_index=np.arange(frames),
        present=present,
        keypoints_px=np.where(labelled[..., None], points, 0).astype(np.float32),
        confidence=labelled.astype(np.float32),
        box_px=boxes,
        image_size_px=np.tile(size, (frames, 1)),
        file_name=np.array([f"{FOOTAGE}#{t}" for t in range(frames)]),
        keypoint_names=bird.keypoint_names,
        skeleton=skeleton_pairs(bird.keypoint_names),
        masks=visible_masks,
        amodal_masks=amodal_masks,
        occluded=labelled & ~visible,
        timestamp_s=np.arange(frames) / fps,
        fps=fps,
    )
    poses = _true_poses(bird, flock, view, truth, points, np.swapaxes(keypoints, 0, 1))
    marked = truth
    if offsets.any():
        beside = keypoints + np.stack([_moved_world(bird, simulated, offsets, view) for simulated in flock], axis=1)
        marked_px = np.swapaxes(view.to_screen(beside)[..., :2], 0, 1)
        marked = truth.with_keypoints(np.where(labelled[..., None], marked_px, 0), truth.confidence)
    detections = simulate_detections(marked, visible, bird.keypoint_pairs, seed)
    return Scene(flock, view, truth, poses, detections)


def simulate(
    bird: Bird,
    folder: str | Path,
    birds: int = 7,
    frames: int = 100,
    size: tuple[int, int] = (2592, 1520),
    fps: float = 25.0,
    seed: int = 0,
    bone_sd: float = BONE_SD,
    keypoint_offset: float = OFFSET,
    codec: str = "auto",
    overwrite: bool = False,
    progress: ProgressTask = silent,
) -> Scene:
    """Simulate a scene and write its footage, truth and detections; the same arguments give the same bytes.

    The folder contains `footage.mp4`; `truth.json`, exact annotations in COCO format (visible masks as `segmentation`,
    amodal masks as `amodal_segmentation`, occluded keypoints with visibility 1); `truth/`, exact poses as a result
    folder; `detections.json`, simulated detections (see `jaxfit.simulation.noise`); `scene.json`, the camera and the
    behaviours of each bird.

    Args:
        bird: the model, as for `stage_scene`.
        folder: folder to create; after an error it does not exist.
        birds, frames, size, fps, seed, bone_sd, keypoint_offset, progress: as for `stage_scene`.
        codec: codec of the footage, as for `VideoWriter`.
        overwrite: replace an existing scene.

    Raises:
        InputError: a number outside its range, or the folder cannot be written.
    """
    with new_folder(folder, overwrite, marker=MARKER) as part:
        bodies = {"bone_sd": bone_sd, "keypoint_offset": keypoint_offset}
        scene = stage_scene(bird, birds, frames, size, fps, seed, **bodies, progress=progress)
        arguments = {"birds": birds, "frames": frames, "size": list(size), "fps": fps, "seed": seed, **bodies}
        film_scene(bird, scene, part, arguments, codec, progress, "Filming")
    return scene


def film_scene(
    bird: Bird,
    scene: Scene,
    folder: Path,
    arguments: dict[str, Any],
    codec: str,
    progress: ProgressTask,
    title: str,
) -> None:
    """Write the files of a scene, as seen by one camera, to an existing folder; see `simulate`.

    Args:
        bird: the model.
        scene: the scene.
        folder: where to write.
        arguments: the arguments of the simulation, for `scene.json`; `fps` and `seed` are used.
        codec: codec of the footage.
        progress: reports every frame.
        title: text of the progress.
    """
    fps, seed, frames = arguments["fps"], arguments["seed"], scene.truth.num_frames
    light = random_light(np.random.default_rng((seed, 4)))
    footage = Footage(bird, scene.birds, scene.view, LEDGE_DEPTH, light, seed)
    size = scene.view.width, scene.view.height
    with progress(title, frames) as report_progress, VideoWriter(folder / FOOTAGE, size, fps, codec) as video:
        for t in range(frames):
            video.write(footage.frame(t))
            report_progress(1, "")
    identity = read_footage(folder / FOOTAGE, frames)
    write_coco(replace(scene.truth, footage=identity), folder / TRUTH)
    write_coco(replace(scene.detections, footage=identity), folder / DETECTIONS)
    origin = "simulated: these poses are the truth, not a fit"
    facts = {"origin": origin, "jaxfit": VERSION, "model": model_hash(bird), "video": identity.entries()}
    save_solution(scene.poses, bird, f"# {origin}\n", facts, folder / TRUE_POSES)
    write_whole(folder / MARKER, json.dumps(_description(scene, arguments), indent=2).encode())


def _moved_world(
    bird: Bird, simulated: SimulatedBird, offsets: Float[np.ndarray, "K 3"], view: Viewpoint
) -> Float[np.ndarray, "T K 3"]:
    """Return the shifts of the posed keypoints whose rest positions are moved by offsets, world frame."""
    rig = fold_bird(bird)
    A = window_transforms(rig, simulated.pose)
    own, moved = (window_keypoints(each, A, simulated.pose) for each in (rig, move_keypoints(rig, offsets)))
    return np.asarray(moved - own, np.float64) @ view.R_cam_world


def check_scene(
    birds: int,
    frames: int,
    size: tuple[int, int],
    fps: float,
    seed: int,
    bone_sd: float,
    keypoint_offset: float,
) -> None:
    """Raise InputError if an argument of a simulation lies outside its range."""

    def require(name: str, value: object, holds: bool, remedy: str) -> None:
        if not holds:
            raise InputError(f"simulate: {name}", f"is {value}", remedy)

    require("birds", birds, 1 <= birds <= 60, "give 1 to 60 birds")
    longest = MAX_POSES // birds
    require(
        "frames", frames, 2 <= frames <= longest, f"give 2 to {longest} frames; simulate several scenes for more frames"
    )
    remedy = f"give width and height as in 2592x1520, even, {SMALLEST_SIDE} to {LARGEST_SIDE} pixels, at most 3:1"
    sides_fit = len(size) == 2 and all(SMALLEST_SIDE <= side <= LARGEST_SIDE and side % 2 == 0 for side in size)
    sides_fit = sides_fit and max(size) <= 3 * min(size)
    require("size", "x".join(map(str, size)), sides_fit, remedy)
    require("fps", fps, 5 <= fps <= 240, "give 5 to 240 frames a second")
    require("seed", seed, 0 <= seed < 2**32, "give a whole number from 0")
    require("bone_sd", bone_sd, 0 <= bone_sd <= 0.15, "give 0 (equal bones) to 0.15")
    require("keypoint_offset", keypoint_offset, 0 <= keypoint_offset <= 0.2, "give 0 (no offsets) to 0.2")


def _true_poses(
    bird: Bird, birds: list[SimulatedBird], view: Viewpoint, truth: Observations, points_px: np.ndarray, keypoints_world
) -> Solution:
    """Return the true poses as a result. Its crop is the whole picture, so that its camera is that of the scene."""
    N, T = truth.present.shape

    def stack(name: str) -> np.ndarray:
        return np.stack([np.asarray(getattr(simulated.pose, name)) for simulated in birds])

    def each_frame(name: str) -> np.ndarray:
        values = stack(name)
        return np.broadcast_to(values[:, None], (N, T, *values.shape[1:]))

    crop_px = CropCamera().size_px
    return Solution.from_arrays(
        track_id=truth.track_id,
        frame_index=truth.frame_index,
        valid=truth.present,
        global_orient=stack("global_orient"),
        body_pose=stack("body_pose"),
        transl=stack("transl"),
        scale=np.broadcast_to(stack("scale"), (N, T)),
        bone_length=each_frame("bone_length"),
        betas=each_frame("betas"),
        keypoints_cam=view.to_camera(keypoints_world),
        keypoints_px=points_px,
        crop=np.broadcast_to(view.crop, (N, T, 3)),
        image_size_px=np.where(truth.present[..., None], truth.image_size_px[None], 0),
        keypoint_names=bird.keypoint_names,
        joint_names=bird.joint_names,
        status=np.full(N, "ok"),
        timestamp_s=truth.timestamp_s,
        fps=truth.fps,
        loss={},
        focal_px=view.focal_px * crop_px / float(view.crop[2]),
        crop_px=crop_px,
    )


def _description(scene: Scene, arguments: dict[str, Any]) -> dict:
    """Return the content of `scene.json`: arguments, camera, and the behaviours of each bird with first frames."""
    behaviours = {}
    for track, simulated in zip(scene.truth.track_id.tolist(), scene.birds, strict=True):
        starts = np.flatnonzero(np.diff(simulated.behaviour, prepend=-1))
        behaviours[track] = [{"from_frame": int(t), "behaviour": BEHAVIOURS[simulated.behaviour[t]]} for t in starts]
    return {
        "made_by": f"jaxfit {VERSION}, simulated",
        "arguments": arguments,
        "camera": {
            "R_cam_world": scene.view.R_cam_world.tolist(),
            "position_world": scene.view.position_world.tolist(),
            "focal_px": scene.view.focal_px,
            "units": "model units; world z up, ledge at z = 0",
        },
        "behaviour": behaviours,
    }
