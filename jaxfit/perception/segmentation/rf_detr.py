"""RF-DETR's segmentation networks, as `model.export()` writes them to ONNX."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from jaxfit.errors import InputError
from jaxfit.perception.instances import Instance
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import choose_classes, coco_by_category, names_of
from jaxfit.perception.segmentation.inputs import IMAGENET_MEAN, IMAGENET_STD, image_input
from jaxfit.perception.segmentation.placing import Placement

__all__ = ["RfDetrSeg"]


class RfDetrSeg:
    """Queries with a box, class logits and a mask each; no suppression is needed.

    `dets` (1, queries, 4): centre and size as shares of the picture; `labels` (1, queries, slots): logits, one sigmoid
    each; `masks` (1, queries, h, w): logits over the whole picture at a quarter of its resolution. Input: the
    frame stretched to the input, red-green-blue, less ImageNet's mean and by its deviation.

    The slots' names are the file's (`rfdetr_inference` of its metadata, in newer exports). Else 91 slots are COCO's own
    category numbers, slot 0 being unused; and of any other number the last is the trained-away "no object".

    Args:
        classes: names that are kept; None takes `bird`.
        min_score: least score; None takes 0.5, as RF-DETR does.
        names: of its classes, where the file does not hold them.

    Raises:
        InputError: another layout, or other classes than asked for.

    Source: `PostProcess` and the export of https://github.com/roboflow/rf-detr (Apache-2.0).
    """

    def __init__(
        self,
        model: OnnxModel,
        classes: Sequence[str] | None = None,
        min_score: float | None = None,
        names: Sequence[str] | None = None,
    ):
        self._model = model
        self._input = image_input(model)
        if self._input.size_px is None:
            raise InputError(model.path, "leaves the size of its input free", "export it with a fixed one")
        self._size_px = self._input.size_px
        self._min_score = 0.5 if min_score is None else min_score
        self._chosen = choose_classes(model.path, _slots(model, names), classes)
        self.class_names = tuple(self._chosen.values())

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether a network has this layout, by its outputs."""
        shapes = {port.name: port.shape for port in model.outputs}
        if set(shapes) != {"dets", "labels", "masks"}:
            return False
        ranks = [len(shapes[name]) for name in ("dets", "labels", "masks")]
        # mmdeploy's exports bear these names too: their boxes have five columns, their labels no slots
        return ranks == [3, 3, 4] and shapes["dets"][2] == 4 and shapes["labels"][2] is not None

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """As `Segmenter`."""
        placement = Placement.stretched((frame.shape[1], frame.shape[0]), self._size_px)
        rgb = placement.picture(frame)[..., ::-1].astype(np.float32) / 255
        outputs = self._model(self._input.array((rgb - IMAGENET_MEAN) / IMAGENET_STD))
        dets, logits = (outputs[name][0].astype(np.float32) for name in ("dets", "labels"))
        slots = np.array(list(self._chosen))
        scores = 1 / (1 + np.exp(-np.clip(logits[:, slots], -80, 80)))
        best = scores.argmax(1)
        scores = scores[np.arange(len(scores)), best]
        centre, half = dets[:, :2], dets[:, 2:] / 2
        boxes_px = placement.boxes_px(np.concatenate([centre - half, centre + half], 1) * np.tile(self._size_px, 2))
        found = (
            placement.instance(
                outputs["masks"][0, i], boxes_px[i], 0.0, float(scores[i]), self._chosen[int(slots[best[i]])]
            )
            for i in np.argsort(-scores)
            if scores[i] >= self._min_score
        )
        return [instance for instance in found if instance is not None]


def _slots(model: OnnxModel, names: Sequence[str] | None) -> dict[int, str]:
    """The name of each slot that stands for a class."""
    count = next(port.shape[2] for port in model.outputs if port.name == "labels") or 0
    if names is None and "rfdetr_inference" in model.metadata:
        try:
            named = json.loads(model.metadata["rfdetr_inference"])["class_id_to_name"]
            return {int(slot): str(name) for slot, name in named.items() if int(slot) < count}
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            problem = "metadata `rfdetr_inference` names no classes"
            raise InputError(model.path, problem, "give the names of its classes") from error
    if names is None and count == 91:
        return coco_by_category()
    return names_of(model, names, count - 1)
