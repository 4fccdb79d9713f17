"""RF-DETR's segmentation networks, as `model.export()` writes them to ONNX."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.perception.imagenet import normalise
from jaxfit.perception.instances import Instance, collect_instances
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import coco_by_category, names_of
from jaxfit.perception.segmentation.network import SegmentationNetwork
from jaxfit.perception.segmentation.placement import Placement

__all__ = ["RfDetrSeg"]


class RfDetrSeg(SegmentationNetwork):
    """Queries with a box, class logits and a mask each; suppression of duplicates is not necessary.

    Outputs: `dets` (1, queries, 4), centre and size as shares of the picture; `labels` (1, queries, slots), one logit
    per slot, with a sigmoid; `masks` (1, queries, h, w), logits over the whole picture at a quarter of its resolution.
    Input: the frame stretched to the input, red-green-blue, normalised with ImageNet's mean and standard deviation.

    Newer exports name the slots in their metadata (`rfdetr_inference`). Otherwise 91 slots are COCO's category numbers,
    with an unused slot 0. With any other number of slots, the last slot is "no object".

    Raises:
        InputError: an input of variable size, an unsupported layout, or unknown classes.

    Source: `PostProcess` and the export of https://github.com/roboflow/rf-detr (Apache-2.0).
    """

    layout = "outputs dets (1, queries, 4), labels (1, queries, slots), masks (1, queries, h, w)"
    default_min_score = 0.5  # as in RF-DETR

    def _set_up(self) -> None:
        if self._input.size_px is None:
            raise InputError(self._model.path, "has an input of variable size", "export it with a fixed size")
        self._size_px = self._input.size_px
        self._slots = _slots(self._model)

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the outputs of a network have this layout."""
        shapes = {port.name: port.shape for port in model.outputs}
        if set(shapes) != {"dets", "labels", "masks"}:
            return False
        ranks = [len(shapes[name]) for name in ("dets", "labels", "masks")]
        # exports of mmdeploy have the same names, but boxes with five columns and labels without slots
        return ranks == [3, 3, 4] and shapes["dets"][2] == 4 and shapes["labels"][2] is not None

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes."""
        placement = Placement.stretched((frame.shape[1], frame.shape[0]), self._size_px)
        rgb = placement.picture(frame)[..., ::-1].astype(np.float32) / 255
        outputs = self._model(self._input.array(normalise(rgb)))
        head = {"dets": (1, "queries", 4), "labels": (1, "queries", self._slots)}
        self._model.check_outputs(outputs, head | {"masks": (1, "queries", "h", "w")})
        dets, logits = (outputs[name][0].astype(np.float32) for name in ("dets", "labels"))
        slots = np.array(list(self._classes))
        scores = 1 / (1 + np.exp(-np.clip(logits[:, slots], -80, 80)))
        best = scores.argmax(1)
        scores = scores[np.arange(len(scores)), best]
        centre, half = dets[:, :2], dets[:, 2:] / 2
        corners_px = placement.to_frame(np.concatenate([centre - half, centre + half], 1) * np.tile(self._size_px, 2))
        instances = (
            placement.instance(
                outputs["masks"][0, i], corners_px[i], 0.0, float(scores[i]), self._classes[int(slots[best[i]])]
            )
            for i in np.argsort(-scores)
            if scores[i] >= self._min_score
        )
        return collect_instances(self._model.path, instances, placement.frame_px)

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        """Return slot → name of every slot that is a class."""
        model = self._model
        count = _slots(model)
        if names is None and "rfdetr_inference" in model.metadata:
            try:
                named = json.loads(model.metadata["rfdetr_inference"])["class_id_to_name"]
                return {int(slot): str(name) for slot, name in named.items() if 0 <= int(slot) < count}
            except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
                problem = "metadata `rfdetr_inference` names no classes"
                raise InputError(model.path, problem, "give the names of its classes") from error
        if names is None and count == 91:
            return coco_by_category()
        return names_of(model, names, count - 1)


def _slots(model: OnnxModel) -> int:
    return next(port.shape[2] for port in model.outputs if port.name == "labels") or 0
