"""Keypoint networks in ONNX files, made to look at one bird after the other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.errors import InputError
from jaxfit.model.anatomy import AVES_KEYPOINTS, AVIAN_MESH_KEYPOINTS, MURRE_KEYPOINTS
from jaxfit.perception.instances import Instance
from jaxfit.perception.keypoints.crops import DILATE_PX, PAD_PX, crop_bird
from jaxfit.perception.keypoints.heads import HeatmapHead, SimccHead, find_head
from jaxfit.perception.keypoints.notes import read_notes
from jaxfit.perception.keypoints.pictures import PictureInput, picture_input
from jaxfit.perception.onnx_model import OnnxModel

__all__ = ["NAME_SETS", "OnnxKeypoints", "load_keypoint_detector"]

BUILTIN_PATH = Path(__file__).parents[1] / "networks" / "keypoints.onnx"
NAME_SETS = {"murre": MURRE_KEYPOINTS, "aves": AVES_KEYPOINTS, "avian-mesh": AVIAN_MESH_KEYPOINTS}


class OnnxKeypoints:
    """A `KeypointDetector`: crops birds, runs the network on batches of them, brings its points back."""

    keypoint_names: tuple[str, ...]

    def __init__(
        self,
        model: OnnxModel,
        pictures: PictureInput,
        head: HeatmapHead | SimccHead,
        keypoint_names: Sequence[str],
        pad_px: int,
        dilate_px: int,
        batch: int,
    ):
        self.keypoint_names = tuple(keypoint_names)
        self._model, self._pictures, self._head = model, pictures, head
        self._pad_px, self._dilate_px = pad_px, dilate_px
        self._batch = pictures.batch or batch

    def __call__(
        self, frame: UInt8[np.ndarray, "H W 3"], instances: Sequence[Instance]
    ) -> tuple[Float[np.ndarray, "M K 2"], Float[np.ndarray, "M K"]]:
        """See `KeypointDetector`."""
        K = len(self.keypoint_names)
        points_px, confidence = np.zeros((len(instances), K, 2), np.float32), np.zeros((len(instances), K), np.float32)
        width, height = self._pictures.size_px
        for start in range(0, len(instances), self._batch):
            birds = instances[start : start + self._batch]
            batch = np.zeros((self._pictures.batch or len(birds), height, width, 3), np.uint8)
            crops = []
            for i, bird in enumerate(birds):
                batch[i], crop = crop_bird(frame, bird, (width, height), self._pad_px, self._dilate_px)
                crops.append(crop)
            found_px, trust = self._head(self._model(self._pictures(batch)))
            for i, crop in enumerate(crops):
                points_px[start + i] = crop.to_image(found_px[i])
                confidence[start + i] = trust[i]
        return points_px, confidence


def load_keypoint_detector(
    spec: str | Path = "builtin",
    *,
    kind: str = "auto",
    names: Sequence[str] | str | None = None,
    pad_px: int | None = None,
    dilate_px: int | None = None,
    batch: int = 16,
    threads: int | None = None,
) -> OnnxKeypoints:
    """A keypoint network, its layout told from its inputs and outputs.

    Args:
        spec: `builtin`, or an ONNX file; what its metadata may say stands in `notes`.
        kind: one of `KINDS`; `auto` takes what fits.
        names: of its keypoints, in the order of its output, or a key of `NAME_SETS`; None or none take the file's.
        pad_px, dilate_px: of the crops (`crop_bird`), image pixels; None takes the file's, or the paper's 40 and 70.
        batch: crops in one run, where the network leaves that open.
        threads: cores that one run may use; None takes all.

    Raises:
        InputError: no such file, no keypoint network, other channels than three, an unknown layout, no names or
            another number of them.
    """
    model = OnnxModel(BUILTIN_PATH if spec == "builtin" else spec, threads)
    notes = read_notes(model)
    pictures = picture_input(model, notes)
    width, height = pictures.size_px
    outputs = model(pictures(np.zeros((pictures.batch or 1, height, width, 3), np.uint8)))
    head, count = find_head(model, outputs, kind, pictures.size_px, pictures.channels_last, notes)
    return OnnxKeypoints(
        model,
        pictures,
        head,
        _names(model, count, names or notes.keypoint_names),
        _given(pad_px, notes.pad_px, PAD_PX),
        _given(dilate_px, notes.dilate_px, DILATE_PX),
        batch,
    )


def _names(model: OnnxModel, count: int, given: Sequence[str] | str | None) -> Sequence[str]:
    sets = ", ".join(f"`{name}` ({len(keypoints)})" for name, keypoints in NAME_SETS.items())
    if not given:
        remedy = f"give them in the order of its output, or one of {sets}"
        raise InputError(model.path, f"does not name its {count} keypoints", remedy)
    if isinstance(given, str) and given not in NAME_SETS:
        raise InputError(given, "is no set of keypoint names", f"known are {sets}; or give the {count} names")
    names = NAME_SETS[given] if isinstance(given, str) else given
    if len(names) != count:
        problem = f"has {count} keypoints, but {len(names)} are named"
        raise InputError(model.path, problem, f"name each, in the order of its output: {model.describe()}")
    return names


def _given(*values: int | None) -> int:
    return next(value for value in values if value is not None)
