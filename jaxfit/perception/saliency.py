"""Birds of a detector of boxes and a saliency network, which segments the bird in each box.

A detector such as YOLOX-nano misses birds that are larger, smaller or otherwise turned than those of its training, and
gives them low scores. Three rules detect more of them.

- **Other views.** A picture at half its size shows large birds at a usual size. In photographs, quarter turns show
  birds that a camera sees from above. A view counts only with its mirror image, which shows the same birds.
- **Doubtful boxes** have low scores. A doubtful box counts if the saliency network, which is another network, sees one
  whole object there: the mask of the mirror image is the same, the mask has one part, and it ends within the picture
  that the network saw.
- **Whole masks.** A mask is cut by the boxes of other birds, but not by its own box. A mask that reaches the border of
  the picture that the network saw is segmented again, with more of its surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxfit.data.masks import box_iou
from jaxfit.perception.carried_masks import segment_block
from jaxfit.perception.merging import MIN_SAME_IOU, common_pixels, mask_iou, smaller_inside, tile_spans
from jaxfit.perception.network import Instance, OnnxModel, instance_of, normalise
from jaxfit.perception.segmentation_inputs import Placement, enlarge, image_input
from jaxfit.perception.segmentation_layouts import Detection, View, Yolox

# margins on each side of a box, as shares of its sides:
CONTEXT = 0.25  # of the picture for the saliency network, which needs background around the object
MASK_MARGIN = 0.05  # of a mask that is cut by its box, because boxes are seldom exact
_SALIENCY_INPUT_PX = (320, 320)

DOUBTFUL_SCORE = 0.1
"""Least score of a doubtful box, as in ByteTrack (Zhang et al. 2022)."""
MAX_DOUBTFUL = 2
"""Largest number of doubtful boxes of a frame that are segmented, to bound the time: the best ones."""
MIN_PART = 0.9
"""Least share of the salient pixels in the largest part of a mask that counts as one object."""
MIN_INSIDE = 0.5
"""Least share of a mask in its box, of a bird in the salient object of its photograph, and of a bird in another bird
that is the same bird."""
GROWTHS = 2
"""How often a mask that is cut is segmented again with more of its surroundings."""
ZOOMS, TURNS = (1.0, 0.5), (0, 1, 2, 3)
"""Sizes and quarter turns of the views of a photograph."""
BOTH = (False, True)
"""A picture and its mirror image."""


class Saliency:
    """Probability that a pixel belongs to the salient object of a picture, the first output of U²-Net.

    Input (1, 3, h, w): the picture stretched to the input, divided by its largest value, red-green-blue, normalised
    with ImageNet's mean and standard deviation; 320 x 320 for an input of variable size. First output (1, 1, h, w):
    probabilities. The outputs of coarser stages are not used.

    Raises:
        InputError: an unsupported input.

    Source: Qin et al. 2020, U²-Net; `ToTensorLab` of https://github.com/xuebinqin/U-2-Net (Apache-2.0).
    """

    def __init__(self, model: OnnxModel):
        self._model = model
        self._input = image_input(model)
        self.size_px = self._input.size_px or _SALIENCY_INPUT_PX

    @staticmethod
    def fits(model: OnnxModel) -> bool:
        """Whether the shapes of a network have this layout."""
        shape = model.outputs[0].shape
        return len(model.inputs) == 1 and len(shape) == 4 and shape[1] == 1

    def __call__(self, picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
        """Compute the probabilities over a blue-green-red picture of `size_px`."""
        rgb = picture[..., ::-1].astype(np.float32) / max(1, int(picture.max()))
        outputs = self._model(self._input.array(normalise(rgb)))
        name = self._model.outputs[0].name
        self._model.check_outputs(outputs, {name: (1, 1, "h", "w")})
        return outputs[name][0, 0].astype(np.float32)


class _Segmented(NamedTuple):
    """The bird in a box."""

    bird: Instance
    is_whole: bool
    """Whether the mask ends within the picture that the network saw, and has one part."""
    crop_px: Int[np.ndarray, "4"]
    """The part of the frame that the network saw."""


class DetectorAndSaliency:
    """A segmenter of a detector and a saliency network. A box without a salient object gives no instance.

    Args:
        detector: detects the boxes and their scores, also boxes with low scores.
        saliency: computes the masks.
        min_score: boxes with lower scores are doubtful.
    """

    def __init__(self, detector: Yolox, saliency: Saliency, min_score: float):
        self._detector, self._saliency = detector, saliency
        self.class_names = detector.class_names
        self.min_best_score = min_score
        """A track of doubtful detections alone does not count."""

    def __call__(self, frame: UInt8[np.ndarray, "H W 3"], known: Sequence[Instance] = ()) -> list[Instance]:
        """Segment a frame, as `Segmenter` describes; without a certain bird, at a second size too.

        Birds that are known in this frame are not segmented, and not returned.
        """
        zooms, found = ZOOMS[:1], self._detector(frame)
        if not any(map(self._is_certain, found)):
            zooms, found = ZOOMS, self._detector(frame, *map(View, ZOOMS))
        boxes = [Detection(bird.corners_px, bird.score, bird.label) for bird in known]
        is_known = _box_iou(found, boxes).max(1, initial=0) > MIN_SAME_IOU
        found = [one for one, skip in zip(found, is_known, strict=True) if not skip]
        birds = list(known)
        others = [one for one in (*found, *boxes) if self._is_certain(one)]
        for one in filter(self._is_certain, found):
            segmented = self._segmented(frame, one, others)
            if segmented and all(mask_iou(segmented.bird, bird) <= MIN_SAME_IOU for bird in birds):
                birds.append(segmented.bird)
        # the mirror image is tested before the masks, because the detector is much faster than the saliency network
        doubtful = [one for one in found if not self._is_certain(one) and not _overlap(one, others)][:MAX_DOUBTFUL]
        mirrored = self._detector(frame, *(View(zoom, mirrored=True) for zoom in zooms)) if doubtful else []
        for one, iou in zip(doubtful, _box_iou(doubtful, mirrored), strict=True):
            segmented = self._segmented(frame, one, others) if iou.max(initial=0) > MIN_SAME_IOU else None
            if segmented and not _is_known(segmented.bird, birds) and self._is_confirmed(frame, segmented):
                birds.append(segmented.bird)
        return birds[len(known) :]

    def segment_block(self, frames: Sequence[UInt8[np.ndarray, "H W 3"]]) -> list[list[Instance]]:
        """Segment consecutive frames, most of them by optical flow (`jaxfit.perception.carried_masks`)."""
        return segment_block(self, frames)

    def photograph(self, picture: UInt8[np.ndarray, "H W 3"]) -> list[Instance]:
        """Segment a photograph, more thoroughly than a frame of a film; the result is as that of a call.

        Of several birds, those outside the salient object of the whole photograph are dropped, unless all are outside:
        a photograph is taken of its bird.
        """
        birds: list[Instance] = []
        doubtful = 0
        for one in self._in_views(picture):
            is_certain = self._is_certain(one)
            doubtful += not is_certain
            if not is_certain and doubtful > MAX_DOUBTFUL:
                continue
            segmented = self._segmented(picture, one, sides=BOTH)
            if segmented is None or _is_known(segmented.bird, birds):
                continue
            if is_certain or self._is_confirmed(picture, segmented):
                birds.append(segmented.bird)
        if len(birds) > 1:
            whole_px = np.array([0, 0, picture.shape[1], picture.shape[0]])
            salient = self._salient(picture, whole_px, whole_px, BOTH)
            subject = salient and salient._replace(mask=_largest_component(salient.mask))
            birds = [bird for bird in birds if subject and _share(bird, subject) >= MIN_INSIDE] or birds
        return sorted(birds, key=lambda bird: -bird.score)

    def boxes(self, frame: UInt8[np.ndarray, "H W 3"]) -> list[Float[np.ndarray, "4"]]:
        """Return the boxes of the certain detections: x0, y0, x1, y1 in image pixels."""
        return [one.corners_px for one in self._detector(frame) if self._is_certain(one)]

    def instance_in_box(
        self, frame: UInt8[np.ndarray, "H W 3"], corners_px: Float[np.ndarray, "4"], margin: float = MASK_MARGIN
    ) -> Instance | None:
        """Segment the salient object in a box, with the score 1.

        Args:
            frame: blue, green, red.
            corners_px: x0, y0, x1, y1 in image pixels.
            margin: margin of the box that the mask may cover, as a share of the sides of the box.

        Returns:
            The instance; None for a box outside the frame or without a salient object.
        """
        frame_px = (frame.shape[1], frame.shape[0])
        crop_px = enlarge(corners_px, CONTEXT, frame_px)
        salient = self._salient(frame, crop_px, enlarge(corners_px, margin, frame_px))
        if salient is None:
            return None
        return instance_of(_largest_component(salient.mask), 1.0, salient.label, salient.x0, salient.y0)

    def _is_certain(self, detection: Detection) -> bool:
        return detection.score >= self.min_best_score

    def _segmented(
        self,
        frame: UInt8[np.ndarray, "H W 3"],
        detection: Detection,
        others: Sequence[Detection] = (),
        sides: Sequence[bool] = (False,),
    ) -> _Segmented | None:
        """Segment the bird in a box, which may reach beyond the box, but not into the boxes of others.

        A mask that cannot be whole is cut by its box.
        """
        frame_px, corners_px = (frame.shape[1], frame.shape[0]), detection.corners_px
        crop_px = enlarge(corners_px, CONTEXT, frame_px)
        for _ in range(1 + GROWTHS):
            salient = self._salient(frame, crop_px, crop_px, sides)
            if salient is None:
                return None
            own, free = _pixels(corners_px, salient), salient.mask.copy()
            for other in others:
                if other is not detection:
                    free &= own | ~_pixels(other.corners_px, salient)
            mask = _largest_component(free, own)
            bird = instance_of(mask, detection.score, detection.label, salient.x0, salient.y0)
            if bird is None or np.count_nonzero(mask & own) < MIN_INSIDE * np.count_nonzero(mask):
                break
            box_px = bird.corners_px.astype(int)
            # a mask may end at the border of the frame
            if not ((box_px == crop_px) & (crop_px != [0, 0, *frame_px])).any():
                has_one_part = bool(np.count_nonzero(mask) >= MIN_PART * np.count_nonzero(free))
                return _Segmented(bird, has_one_part, crop_px)
            low, high = np.minimum(box_px, corners_px)[:2], np.maximum(box_px, corners_px)[2:]
            crop_px = enlarge(np.concatenate([low, high]), CONTEXT, frame_px)
        bird = self.instance_in_box(frame, corners_px)
        if bird is None:
            return None
        return _Segmented(bird._replace(score=detection.score, label=detection.label), False, crop_px)

    def _is_confirmed(self, frame: UInt8[np.ndarray, "H W 3"], segmented: _Segmented) -> bool:
        """Whether the mask of a doubtful bird is one whole object, and the same in the mirror image."""
        if not segmented.is_whole:
            return False
        mirrored = self._salient(frame, segmented.crop_px, segmented.crop_px, (True,))
        return mirrored is not None and mask_iou(segmented.bird, mirrored) > MIN_SAME_IOU

    def _salient(
        self,
        frame: UInt8[np.ndarray, "H W 3"],
        crop_px: Int[np.ndarray, "4"],
        part_px: Int[np.ndarray, "4"],
        sides: Sequence[bool] = (False,),
    ) -> Instance | None:
        """Return all salient pixels in a part of a frame, with the score 1; None without any.

        Args:
            frame: blue, green, red.
            crop_px: the part of the frame that the network sees: x0, y0, x1, y1 in whole pixels.
            part_px: the part of the frame that the mask may cover.
            sides: whether the network sees the mirror image; of several runs, the mean probability counts.
        """
        if (crop_px[:2] >= crop_px[2:]).any():  # a box outside the frame
            return None
        placement = Placement.cropped((frame.shape[1], frame.shape[0]), self._saliency.size_px, crop_px)
        picture = placement.picture(frame)
        runs = [self._saliency(picture[:, ::-1])[:, ::-1] if side else self._saliency(picture) for side in sides]
        probability = np.mean(runs, 0)
        label = self.class_names[0] if self.class_names else "bird"
        return placement.instance(probability, part_px, 0.5, 1.0, label)

    def _in_views(self, picture: UInt8[np.ndarray, "H W 3"]) -> list[Detection]:
        """Return what the views of a photograph show; without anything, of its enlarged parts.

        Of the boxes at one place, the best counts. The places are in the order of the sum of the scores of all views.
        """
        found = self._agreed(picture)
        if not found:
            side_px = int(np.ceil(max(picture.shape[:2]) / 2))
            for y0, y1 in tile_spans(picture.shape[0], side_px, CONTEXT):
                for x0, x1 in tile_spans(picture.shape[1], side_px, CONTEXT):
                    part = self._agreed(np.ascontiguousarray(picture[y0:y1, x0:x1]))
                    corner_px = np.array([x0, y0, x0, y0], np.float32)
                    found += [one._replace(corners_px=one.corners_px + corner_px) for one in part]
        places: list[list[Detection]] = []
        for one in sorted(found, key=lambda one: -one.score):
            for place in places:
                if _box_iou([place[0]], [one])[0, 0] > MIN_SAME_IOU:
                    place.append(one)
                    break
            else:
                places.append([one])
        return [place[0] for place in sorted(places, key=lambda place: -sum(one.score for one in place))]

    def _agreed(self, picture: UInt8[np.ndarray, "H W 3"]) -> list[Detection]:
        """Return the boxes of every view that its mirror image shows too; their score is the geometric mean."""
        agreed = []
        for zoom in ZOOMS:
            for turns in TURNS if self._detector.is_square else (0,):
                first, second = (self._detector(picture, View(zoom, turns, mirrored)) for mirrored in BOTH)
                iou = _box_iou(first, second)
                for one, row in zip(first, iou, strict=True):
                    if row.max(initial=0) > MIN_SAME_IOU:
                        score = np.sqrt(one.score * second[int(row.argmax())].score)
                        agreed.append(one._replace(score=float(score)))
        return agreed


def _is_known(bird: Instance, birds: Sequence[Instance]) -> bool:
    """Whether the larger part of the smaller of two birds is the same bird."""
    return any(smaller_inside(bird, other) >= MIN_INSIDE for other in birds)


def _share(bird: Instance, other: Instance) -> float:
    """Return the share of a bird that lies in another mask."""
    return common_pixels(bird, other) / np.count_nonzero(bird.mask)


def _overlap(detection: Detection, others: Sequence[Detection]) -> bool:
    """Whether most of the smaller of two boxes lies in the other box."""
    corners = np.array([other.corners_px for other in others]).reshape(-1, 4)
    low, high = np.maximum(corners, detection.corners_px)[:, :2], np.minimum(corners, detection.corners_px)[:, 2:]
    area, own = (np.prod(c[..., 2:] - c[..., :2], -1) for c in (corners, detection.corners_px))
    return bool((np.prod(np.maximum(high - low, 0), -1) > MIN_INSIDE * np.minimum(area, own)).any())


def _box_iou(first: Sequence[Detection], second: Sequence[Detection]) -> Float[np.ndarray, "M N"]:
    corners = [np.array([one.corners_px for one in some]).reshape(-1, 4) for some in (first, second)]
    boxes = [np.concatenate([c[:, :2], c[:, 2:] - c[:, :2]], 1) for c in corners]
    return box_iou(boxes[0][:, None], boxes[1][None])


def _pixels(corners_px: Float[np.ndarray, "4"], instance: Instance) -> Bool[np.ndarray, "h w"]:
    """Return which pixels of the box of an instance lie in a box."""
    rows, columns = (np.arange(length) + 0.5 for length in instance.mask.shape)
    x, y = instance.x0 + columns, instance.y0 + rows[:, None]
    return (x >= corners_px[0]) & (x < corners_px[2]) & (y >= corners_px[1]) & (y < corners_px[3])


def _largest_component(
    mask: Bool[np.ndarray, "h w"], within: Bool[np.ndarray, "h w"] | bool = True
) -> Bool[np.ndarray, "h w"]:
    """Return the component with the most pixels within a part of the mask."""
    count, components = cv2.connectedComponents(mask.astype(np.uint8))
    sizes = np.bincount(components[mask & within], minlength=count)
    return components == sizes.argmax() if sizes.any() else mask & within
