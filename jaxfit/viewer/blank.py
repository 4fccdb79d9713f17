"""`Blank`: frames of a film without a result, in which a person labels birds; `LabelSession` stores the labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.keypoint_names import opposite_keypoints
from jaxfit.data.masks import box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import skeleton_pairs
from jaxfit.model.bird import Bird, rest_length
from jaxfit.review.edits import Edit, apply_edits
from jaxfit.review.points import Point
from jaxfit.review.suggest import picture_name
from jaxfit.video.reader import probe_video
from jaxfit.view.colours import FLAG_COLOURS, css, track_colour
from jaxfit.viewer.arrays import in_steps, pack
from jaxfit.viewer.session import Session
from jaxfit.viewer.shown import mesh_arrays


class Blank:
    """Frames without poses, with the interface of `Shown`.

    Args:
        video: the film.
        bird: the model, whose keypoints are labelled.
        frame_index: numbers of the frames.
        birds: largest number of birds in a frame.
    """

    def __init__(self, video: Path, bird: Bird, frame_index: Int[np.ndarray, "T"], birds: int):
        self.video, self.bird, self.frame_index, self.birds = video, bird, frame_index, birds
        self.size_px = probe_video(video).size_px

    def facts(self) -> dict[str, Any]:
        """Return what the page needs first, as `Shown.facts`."""
        names = self.bird.keypoint_names
        return {
            "name": self.video.name,
            "tracks": [{"id": n + 1, "colour": css(track_colour(n)), "status": ""} for n in range(self.birds)],
            "frames": self.frame_index.tolist(),
            "times_s": [None] * len(self.frame_index),
            "size_px": self.size_px,
            "frames_of_part": len(self.frame_index),
            "skeleton": [list(pair) for pair in skeleton_pairs(names)],
            "keypoints": list(names),
            "opposite": [k if other < 0 else other for k, other in enumerate(opposite_keypoints(names))],
            "flags": ["labelled"],
            "flag_colours": [FLAG_COLOURS["ok"]],
            "values": [],
            "region_radius": 0.0,
            "detected": False,
            "labelling": True,
        }

    def rig(self) -> bytes:
        """Return the model in its rest pose, with its keypoints relative to the root joint."""
        root, length = np.asarray(self.bird.joints)[0], rest_length(self.bird)
        facts = {
            "parents": [int(each) for each in self.bird.parents],
            "length": length,
            "level": True,
            "notes": [],
            "low": [-length / 2] * 3,
            "high": [length / 2] * 3,
            "camera": {"place": [-2 * length, length, length], "R_world_cam": np.eye(3).tolist(), "field_deg": 40.0},
            "keypoints": (np.asarray(self.bird.keypoints) - root).tolist(),
        }
        return pack(mesh_arrays(self.bird), facts)

    def flags(self) -> bytes:
        """Return the flags: nothing is labelled before the page says so."""
        return pack({"flags": np.zeros((self.birds, len(self.frame_index)), np.uint8)})

    def part(self, part: int) -> bytes:
        """Return the poses: none."""
        shape = self.birds, len(self.frame_index)
        keypoints = np.full((*shape, len(self.bird.keypoint_names), 2), np.nan)
        return pack({"valid": np.zeros(shape, np.uint8), "keypoints": in_steps(keypoints, 1)}, {"step_px": 1})

    def outlines(self, part: int) -> bytes:
        """Return the outlines: none."""
        none = np.zeros(0, np.uint32)
        arrays = {"poses": none, "lengths": none, "points": np.zeros((0, 2), np.int16)}
        return pack(arrays, {"step_px": 1, "frames": len(self.frame_index)})

    def why(self, pose: int) -> bytes:
        """There is no pose that has reasons."""
        raise InputError(self.video, "is shown without a result", "run `jaxfit reconstruct` first")


def labels_edits(labels_path: Path) -> Path:
    """Return the file of the edits that belongs to a file of labels."""
    return labels_path.with_suffix(".edits")


class LabelSession(Session):
    """The labels of a film without a result.

    Args:
        blank: the frames.
        labels_path: COCO file of the labels. The page continues from the file of the edits in the same folder.

    Raises:
        InputError: the file of the edits cannot be read.
    """

    def __init__(self, blank: Blank, labels_path: Path):
        super().__init__(blank.video, labels_edits(labels_path), None, blank.video)
        self.labels_path, self._blank = labels_path, blank

    def _write_labels(self, edits: list[Edit | Point]) -> None:
        blank, names = self._blank, self._blank.bird.keypoint_names
        T, N, K = len(blank.frame_index), blank.birds, len(names)
        points, known = np.zeros((N, T, K, 2), np.float32), np.zeros((N, T, K), bool)
        columns = {int(number): t for t, number in enumerate(blank.frame_index)}
        for edit in edits:
            if isinstance(edit, Point) and edit.at_px is not None and edit.track <= N and edit.frame in columns:
                at = edit.track - 1, columns[edit.frame], names.index(edit.keypoint) if edit.keypoint in names else 0
                points[at], known[at] = edit.at_px, True
        present = np.asarray(known.any(-1))
        seen = Observations(
            track_id=np.arange(1, N + 1),
            frame_index=blank.frame_index,
            present=present,
            keypoints_px=np.zeros_like(points),
            confidence=np.zeros(known.shape, np.float32),
            box_px=np.nan_to_num(np.where(present[..., None], box_of_keypoints(points, known), 0)),
            image_size_px=np.tile(blank.size_px, (T, 1)),
            file_name=np.array([picture_name(blank.video, number) for number in blank.frame_index.tolist()]),
            keypoint_names=names,
        )
        labels = apply_edits(seen, edits, blank.video, only_labels=True) if present.any() else seen
        write_coco(labels.select(frames=(labels.confidence > 0).any((0, 2))), self.labels_path)
