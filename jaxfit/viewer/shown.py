"""`Shown`: a result as the page shows it, some frames at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Int16
from scipy.spatial.transform import Rotation

from jaxfit.behaviour.birds import Flock, flock_of
from jaxfit.behaviour.describe import describe
from jaxfit.behaviour.registry import find_feature, own_features
from jaxfit.cameras.files import read_cameras
from jaxfit.data.flags import FLAGS, flags
from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.data.observations import Observations
from jaxfit.data.projection import PosedBirds, image_focal_px, in_image
from jaxfit.data.result_folder import CAMERAS
from jaxfit.data.solution import select_solution
from jaxfit.data.world import as_filmed
from jaxfit.export.glb import four_weights
from jaxfit.export.result import Exported
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.model.bird import Bird
from jaxfit.view.birds import REGION_95, Detected, DrawnBird, outlines
from jaxfit.view.colours import FLAG_COLOURS, css, track_colour
from jaxfit.viewer.arrays import in_steps, pack
from jaxfit.viewer.why import Why

FRAMES = 50
"""Frames that the page loads at once."""
OWN_VALUES = {
    "confidence": ("Confidence of the keypoints", "0 to 1"),
    "residual": ("Keypoints off the detections", "share of the box"),
}
"""Values over time that need the observations: name → title, unit. All other values are features of behaviour."""
TURN_STEP = 1 / 32767
"""Step of the components of quaternions."""
POSED_FRAMES = 10
"""Frames whose meshes are in memory at once."""
PARTS_KEPT = 24
"""Parts of films that stay in memory."""


class Shown:
    """A result as the page shows it. Methods may be called from several threads.

    Args:
        folder: the result.
        exported: its chosen tracks and frames (`jaxfit.export.result.open_result`).
        observations: what was detected; None takes that of the result, if there is any.
        camera: the camera of the film, for a result in a world; None is its first camera.

    Raises:
        InputError: the result has no pose, its cameras cannot be read, or the observations have other keypoints.
    """

    def __init__(
        self, folder: Path, exported: Exported, observations: Observations | None = None, camera: str | None = None
    ):
        exported.require_poses()
        self.folder, self.exported, self.bird = folder, exported, exported.bird
        self.solution, self._lens = as_filmed(folder, exported.solution, exported.bird, camera)
        self.observations = exported.observations if observations is None else observations
        self._detected = Detected(self.solution, self.observations)
        self.times_s, self.frame_index = exported.times_s, self.solution.frame_index
        self._lock = Lock()
        self.part = lru_cache(PARTS_KEPT)(self._part)
        self.outlines = lru_cache(PARTS_KEPT)(self._outlines)
        self.values = lru_cache(PARTS_KEPT)(self._values)

    @property
    def parts(self) -> int:
        """Number of parts of `FRAMES` frames."""
        return -(-len(self.solution.frame_index) // FRAMES)

    @cached_property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the film."""
        width, height = self.solution.crops.image_size_px[self.solution.valid].max(axis=0).tolist()
        return width, height

    @cached_property
    def _step_px(self) -> float:
        """Step of positions in the image, so that positions up to two image sides away have a number."""
        return 2 * max(self.size_px) / 32767

    @cached_property
    def _posed(self) -> PosedBirds:
        return PosedBirds(self.solution, self.bird, self._lens)

    @cached_property
    def _why(self) -> Why:
        return Why(self.solution, self.bird, self.observations, self._lens)

    def why(self, pose: int) -> bytes:
        """Return what speaks for and against a pose, by its position n·T + t among all poses (`Why.entries`).

        Raises:
            InputError: there is no such pose.
        """
        if not 0 <= pose < self.solution.valid.size:
            raise InputError(f"pose {pose}", "is not in the result", "reload the page")
        with self._lock:
            return pack({}, self._why.entries(*divmod(pose, self.solution.valid.shape[1])))

    @cached_property
    def flock(self) -> Flock:
        """The birds in one world. The ledge is estimated where the result has none."""
        path = self.folder / CAMERAS
        count = len(read_cameras(path)) if self.solution.world is not None and path.is_file() else 0
        return flock_of(self.solution, self.bird, self.times_s, count, self._lens, source=self.folder)

    def facts(self) -> dict[str, Any]:
        """Return what the page needs first: tracks, times, names."""
        s = self.solution
        times = [None if np.isnan(time) else round(float(time), 6) for time in self.times_s]
        return {
            "name": "/".join(self.folder.resolve().parts[-2:]),
            "tracks": [
                {"id": track, "colour": css(track_colour(n)), "status": str(s.status[n])}
                for n, track in enumerate(s.track_id.tolist())
            ],
            "frames": s.frame_index.tolist(),
            "times_s": times,
            "size_px": self.size_px,
            "frames_of_part": FRAMES,
            "skeleton": [list(pair) for pair in skeleton_pairs(s.keypoint_names)],
            "keypoints": list(s.keypoint_names),
            "opposite": [k if other < 0 else other for k, other in enumerate(opposite_keypoints(s.keypoint_names))],
            "flags": list(FLAGS),
            "flag_colours": [FLAG_COLOURS[flag] for flag in FLAGS],
            "values": self.kinds_of_values,
            "region_radius": float(np.sqrt(REGION_95)),
            "detected": self.observations is not None,
        }

    @property
    def kinds_of_values(self) -> list[dict[str, str]]:
        """Name, title and unit of the values over time that the page offers."""
        own_values = OWN_VALUES if self.observations is not None else {}
        own = [{"name": name, "title": title, "unit": unit} for name, (title, unit) in own_values.items()]
        unit = "m" if self.solution.world is not None and self.bird.metres_per_unit else "bl"
        return own + [
            {"name": each.name, "title": each.name.replace("_", " ").capitalize(), "unit": each.shown_unit(unit)}
            for each in own_features()
            if each.unit != "id"
        ]

    def flags(self) -> bytes:
        """Return the flag of every pose, uint8 (N, T): a position in `FLAGS` plus 1, 0 without a pose."""
        found = flags(self.solution.flags.doubts)
        numbers = np.select([found == flag for flag in FLAGS], range(1, len(FLAGS) + 1), default=0)
        return pack({"flags": np.where(self.solution.valid, numbers, 0).astype(np.uint8)})

    def rig(self) -> bytes:
        """Return the mesh, its skeleton and its skin, and the place of camera and ledge."""
        bird, flock = self.bird, self.flock
        places = flock.place[self.solution.valid]
        facts = {
            "parents": [int(each) for each in bird.parents],
            "unit": {"m": "m", "bl": "body lengths"}[flock.unit],
            "per_unit": flock.per_unit,
            "length": flock.model_length,
            "level": flock.level,
            "notes": list(flock.notes),
            "low": np.quantile(places, 0.01, axis=0).tolist(),
            "high": np.quantile(places, 0.99, axis=0).tolist(),
            "camera": self._camera(),
        }
        return pack(mesh_arrays(bird), facts)

    def _camera(self) -> dict[str, Any]:
        """Return the place of the camera in the world: every pose is known in both."""
        flock, (n, t) = self.flock, np.argwhere(self.solution.valid)[0]
        one = select_solution(flock.solution, np.array([n]), np.array([t]))
        # the focal length of birds in crops is that of all poses
        at = in_image(one, self.bird, None if flock.solution.world is not None else image_focal_px(flock.solution))
        R_cam_root = Rotation.from_rotvec(at.orientation[0, 0]).as_matrix()
        R_world_cam = flock.R_world_body[n, t] @ R_cam_root.T
        place = flock.place[n, t] - R_world_cam @ at.root[0, 0] * flock.per_unit
        height = 2 * np.degrees(np.arctan(self.size_px[1] / 2 / at.focal_px))
        return {"place": place.tolist(), "R_world_cam": R_world_cam.tolist(), "field_deg": float(height)}

    def _span(self, part: int) -> slice:
        if not 0 <= part < self.parts:
            raise InputError(f"part {part}", f"is not one of the {self.parts} parts of the result", "reload the page")
        return slice(part * FRAMES, min((part + 1) * FRAMES, len(self.solution.frame_index)))

    def _part(self, part: int) -> bytes:
        """Return the poses and the keypoints of a part of the frames."""
        s, flock, span = self.solution, self.flock, self._span(part)
        valid = s.valid[:, span]
        arrays: dict[str, np.ndarray] = {
            "valid": valid.astype(np.uint8),
            "place": flock.place[:, span].astype(np.float32),
            "size": (flock.size[:, span] * flock.per_unit).astype(np.float32),
            "turns": in_steps(self._turns(span), TURN_STEP),
            "keypoints": in_steps(np.where(valid[..., None, None], s.keypoints.px[:, span], np.nan), self._step_px),
        }
        bones, betas = np.where(valid[..., None], s.poses.bone_length[:, span], 1), s.poses.betas[:, span]
        if (bones != 1).any():
            arrays["bones"] = bones.astype(np.float32)
        if np.nan_to_num(betas).any():
            arrays["betas"] = np.nan_to_num(betas).astype(np.float32)
        if self.observations is not None:
            arrays["detected"] = in_steps(self._detections(span), self._step_px)
        if s.error_bars is not None:
            arrays["regions"] = regions(s.error_bars.keypoints_px_cov[:, span])
        return pack(arrays, {"step_px": self._step_px, "turn_step": TURN_STEP})

    def _turns(self, span: slice) -> Float[np.ndarray, "N F J 4"]:
        """Return the rotation of the root in the world, and of every other joint relative to its parent."""
        valid = self.solution.valid[:, span]
        root = Rotation.from_matrix(np.where(valid[..., None, None], self.flock.R_world_body[:, span], np.eye(3)))
        body = np.where(valid[..., None, None], self.solution.poses.body_pose[:, span], 0)
        joints = Rotation.from_rotvec(body.reshape(-1, 3)).as_quat().reshape(*body.shape[:3], 4)
        return np.concatenate([root.as_quat().reshape(*valid.shape, 1, 4), joints], axis=2)

    def _detections(self, span: slice) -> Float[np.ndarray, "N F K 2"]:
        """Return detected keypoints; NaN where nothing is detected."""
        s = self.solution
        columns = range(*span.indices(len(s.frame_index)))
        found = np.full((len(s.track_id), len(columns), len(s.keypoint_names), 2), np.nan)
        for n in range(len(s.track_id)):
            for i, t in enumerate(columns):
                points, confidence = self._detected.keypoints(n, t)
                found[n, i] = np.where(confidence[:, None] > 0, points, np.nan)
        return found

    def _outlines(self, part: int) -> bytes:
        """Return the outlines of the visible parts of all birds, as the overlay draws them, of a part of the frames."""
        span, faces = self._span(part), np.asarray(self.bird.faces)
        poses, lengths, points, count = [], [], [], span.stop - span.start
        for first in range(span.start, span.stop, POSED_FRAMES):
            for i, birds in enumerate(self._birds_of(first, min(first + POSED_FRAMES, span.stop)), first):
                crops = self.solution.crops.square_px[[bird.position for bird in birds], i]
                one_camera = bool((crops == crops[:1]).all())
                for n, curves in outlines(birds, faces, self.size_px, one_camera).items():
                    for curve in curves:
                        poses.append(n * count + i - span.start)
                        lengths.append(len(curve))
                        points.append(curve)
        flat = np.concatenate(points) if points else np.zeros((0, 2))
        arrays = {"poses": np.array(poses, np.uint32), "lengths": np.array(lengths, np.uint32)}
        return pack(arrays | {"points": in_steps(flat, self._step_px)}, {"step_px": self._step_px, "frames": count})

    def _birds_of(self, first: int, stop: int) -> list[list[DrawnBird]]:
        """Return the birds with a pose in some frames, of which only the outlines count."""
        # all slices have one length and one compiled program
        start = max(0, min(first, len(self.solution.frame_index) - POSED_FRAMES))
        span, none, valid = slice(start, start + POSED_FRAMES), np.zeros((0, 2)), self.solution.valid
        with self._lock:
            screens = [self._posed.vertices_screen_window(n, span) for n in range(len(valid))]
        colours = np.zeros((screens[0].shape[1], 1), np.float32)
        return [
            [DrawnBird(n, "", screens[n][t - start], colours, none, none) for n in np.flatnonzero(valid[:, t]).tolist()]
            for t in range(first, stop)
        ]

    def _values(self, name: str) -> bytes:
        """Return values over time, float32 (N, T); NaN without a value.

        Raises:
            InputError: the result has no such values.
        """
        return pack({"values": self._values_of(name).astype(np.float32)})

    def _values_of(self, name: str) -> np.ndarray:
        if name not in OWN_VALUES:
            with self._lock:
                found = describe(self.flock, own=[find_feature(name)], deviations=False)
            if name in found.missing:
                raise InputError(name.replace("_", " "), f"is not known: {found.missing[name]}", "choose another value")
            return found.values[name]
        if self.observations is None:
            raise InputError(name, "needs the detections, which this result does not hold", "give --observations")
        return self._why.compared[name]


def mesh_arrays(bird: Bird) -> dict[str, np.ndarray]:
    """Return the mesh of a bird, its skeleton and its skin, as the page reads them."""
    joints, weights = four_weights(bird)
    return {
        "vertices": np.asarray(bird.vertices, np.float32),
        "faces": np.asarray(bird.faces, np.uint32),
        "colours": np.asarray(bird.vertex_colours, np.float32),
        "joints": np.asarray(bird.joints, np.float32),
        "skin_joints": joints.astype(np.uint16),
        "skin_weights": weights.astype(np.float32),
        "shapes": np.asarray(bird.shape_basis, np.float32),
    }


def frames_of(results: Sequence[Any]) -> Int[np.ndarray, "T"]:
    """Return the frames of the page: those of all results."""
    return np.unique(np.concatenate([each.frame_index for each in results]))


def regions(covariance: Float[np.ndarray, "N F K 2 2"]) -> Int16[np.ndarray, "N F K 3"]:
    """Return the semi-axes of one standard deviation in 1/64 px and the direction of the long axis in 0.01°.

    Args:
        covariance: of the fitted keypoints, squared image pixels; NaN where unknown.
    """
    known = np.asarray(np.isfinite(covariance).all((-1, -2)))
    variance, axes = np.linalg.eigh(np.where(known[..., None, None], covariance, 0).astype(np.float64))
    semi = np.sqrt(np.maximum(variance[..., ::-1], 0))
    angle = np.degrees(np.arctan2(axes[..., 1, 1], axes[..., 0, 1]))
    steps = np.concatenate([in_steps(semi, 1 / 64), in_steps(angle[..., None], 0.01)], axis=-1)
    return np.where(known[..., None], steps, np.int16(-32768))
