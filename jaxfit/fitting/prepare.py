"""What comes before the solver: filtered observations, windows, targets, starting poses. Runs that ask for the same
share it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfit.config.fit import FitConfig
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.errors import InputError
from jaxfit.fitting.initialise import initial_poses
from jaxfit.fitting.start import Start
from jaxfit.fitting.window import Windows, cut_windows, filter_observations, load_keypoints, load_targets
from jaxfit.model.bird import Bird
from jaxfit.model.camera import Camera
from jaxfit.model.kinematics import Rig
from jaxfit.model.pose import Pose
from jaxfit.objective.posed_window import Targets

__all__ = ["Preparation", "camera_of", "start_key", "targets_key"]


def camera_of(config: FitConfig) -> Camera:
    """The crop camera."""
    return Camera(config.crop.focal_px, config.crop.size_px / 2, config.crop.size_px)


class Preparation:
    """The observations of one video, made ready for any number of configs.

    Args:
        observations: keypoints and masks; their keypoints must be the bird's, in any order.
        bird: the model.
        start: where to start; None searches by the config's `initialise`.
        source: what the observations are called in an error.

    Raises:
        InputError: no bird, or keypoints that are not the model's.
    """

    def __init__(self, observations: Observations, bird: Bird, start: Start | None, source: object):
        if not observations.num_tracks:
            raise InputError(source, "holds no bird", "look for birds in other footage, or with another network")
        self.observations = check_keypoints(observations, bird.keypoint_names, source)
        self.source = source
        self._start = start
        self._filtered: dict[int, Observations] = {}
        self._windows: dict[Any, Windows] = {}
        self._poses: dict[Any, Pose] = {}
        self._targets: dict[Any, Targets] = {}

    @property
    def starts_with_shape(self) -> bool:
        """Whether a given start has a shape of its own."""
        return self._start is not None and self._start.has_shape

    def filtered(self, config: FitConfig) -> Observations:
        """The observations, smoothed as the config says."""
        key = config.filter_window
        if key not in self._filtered:
            self._filtered[key] = filter_observations(self.observations, key)
        return self._filtered[key]

    def windows(self, config: FitConfig) -> Windows:
        """All windows of a config.

        Raises:
            InputError: no track with a usable frame, or crops that cannot be made.
        """
        key = targets_key(config)
        if key not in self._windows:
            windows = cut_windows(self.filtered(config), config)
            if len(windows) == 0:
                raise InputError(
                    self.source,
                    f"no track has a frame with {config.min_keypoints} confident keypoints",
                    "detect more keypoints, or lower min_keypoints in the config",
                )
            if self._start is not None:
                self._start.check_crops(self.filtered(config), windows)
            self._windows[key] = windows
        return self._windows[key]

    def targets(self, wanted: Sequence[tuple[FitConfig, np.ndarray]]) -> Targets:
        """Targets of some windows of some configs, one after the other; masks are kept until others are asked for."""
        held = {}
        for config, rows in wanted:
            key = (targets_key(config), rows.tobytes())
            if key not in self._targets:
                size_px = config.crop.size_px
                self._targets[key] = load_targets(self.filtered(config), self.windows(config)[rows], size_px)
            held[key] = self._targets[key]
        self._targets = held
        each = list(held.values())
        return each[0] if len(each) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *each)

    def starting_poses(self, bird: Bird, rig: Rig, config: FitConfig, rows: np.ndarray) -> Pose:
        """Starting poses of some windows of a config, with leading axes W, H (hypotheses)."""
        key = (start_key(config), bird.num_shapes, rows.tobytes())
        if key not in self._poses:
            self._poses[key] = self._find_poses(bird, rig, config, self.windows(config)[rows])
        return self._poses[key]

    def _find_poses(self, bird: Bird, rig: Rig, config: FitConfig, windows: Windows) -> Pose:
        if self._start is None:
            seen = load_keypoints(self.filtered(config), windows, config.crop.size_px)
            keypoints_px, confidence = (jnp.asarray(x) for x in seen)
            common = config.common_size
            return initial_poses(bird, rig, keypoints_px, confidence, config.initialise, camera_of(config), common)
        poses = [
            self._start.window_pose(bird, int(n), frame, present, config.common_size)
            for n, frame, present in zip(windows.track, windows.frame, windows.present, strict=True)
        ]
        return jax.tree.map(lambda *x: jnp.stack(x)[:, None], *poses)


def targets_key(config: FitConfig) -> tuple:
    """What windows and targets depend on."""
    return config.filter_window, config.window, config.min_keypoints, config.crop


def start_key(config: FitConfig) -> tuple:
    """What starting poses depend on."""
    return *targets_key(config), config.initialise, config.common_size
