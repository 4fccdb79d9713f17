"""Common part of the networks with one file: model, input, classes, least score."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.classes import choose_classes, names_of
from jaxfit.perception.segmentation.inputs import image_input

__all__ = ["SegmentationNetwork"]


class SegmentationNetwork:
    """Base class of segmentation and detection networks.

    Args:
        model: the network.
        classes: names of the classes to keep; None keeps `bird`, or the only class.
        min_score: least score; None uses `default_min_score`.
        names: names of all classes; None uses the names in the file.

    Raises:
        InputError: an unsupported input or layout, or unknown classes.
    """

    layout: ClassVar[str]
    """Description of the outputs, for messages."""
    default_min_score: ClassVar[float]
    accepts_unbatched: ClassVar[bool] = False
    """Whether the input may be a single picture (3, h, w)."""
    class_names: tuple[str, ...]
    path: Path

    def __init__(
        self,
        model: OnnxModel,
        classes: Sequence[str] | None = None,
        min_score: float | None = None,
        names: Sequence[str] | None = None,
    ):
        self._model, self.path = model, model.path
        self._input = image_input(model, self.accepts_unbatched)
        self._min_score = self.default_min_score if min_score is None else min_score
        self._classes = choose_classes(model.path, self._all_classes(names), classes)
        self.class_names = tuple(self._classes.values())
        self._set_up()

    def _set_up(self) -> None:
        """Prepare what a layout needs besides the classes; the last part of `__init__`."""

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the inputs and outputs of a network have this layout."""
        raise NotImplementedError

    def _all_classes(self, names: Sequence[str] | None) -> dict[int, str]:
        """Return index → name of every class of the network."""
        return names_of(self._model, names, None)
