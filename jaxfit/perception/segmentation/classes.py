"""Which classes a network can name, and which of them are wanted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from jaxfit.errors import InputError
from jaxfit.perception.onnx_model import OnnxModel
from jaxfit.perception.segmentation.inputs import literal_metadata

__all__ = ["COCO", "choose_classes", "coco_by_category", "names_of"]

_NAMES = (
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,parking meter,"
    "bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,tie,suitcase,frisbee,"
    "skis,snowboard,sports ball,kite,baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,"
    "cup,fork,knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,"
    "potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,oven,toaster,sink,"
    "refrigerator,book,clock,vase,scissors,teddy bear,hair drier,toothbrush"
)
COCO = tuple(_NAMES.split(","))
"""The 80 classes of COCO, in the order of networks that number them without gaps."""
_UNUSED_CATEGORIES = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)


def coco_by_category() -> dict[int, str]:
    """COCO's own numbers, 1 to 90 with gaps, as torchvision and RF-DETR use them."""
    numbers = (number for number in range(1, 91) if number not in _UNUSED_CATEGORIES)
    return dict(zip(numbers, COCO, strict=True))


def names_of(model: OnnxModel, names: Sequence[str] | None, count: int | None) -> dict[int, str]:
    """The class of each index of a network that numbers its classes from 0 on.

    Told names come first, then the file's own (`names` of its metadata, a Python literal as Ultralytics writes it),
    then COCO's; a network of another number of classes that nothing names has `class_0`, `class_1` and so on.

    Args:
        count: of its classes; None where its shapes do not show it.

    Raises:
        InputError: another number of names than classes, or metadata that cannot be read.
    """
    own = literal_metadata(model, "names") if names is None else list(names)
    if own is None:
        own = COCO if count in (None, len(COCO)) else [f"class_{i}" for i in range(count or 0)]
    try:
        found = {int(i): str(name) for i, name in (own.items() if isinstance(own, dict) else enumerate(own))}
    except (ValueError, TypeError) as error:
        problem = f"metadata `names` is no list of classes: {own!r:.80}"
        raise InputError(model.path, problem, "give the names of its classes") from error
    if sorted(found) != list(range(len(found) if count is None else count)):
        problem = f"has {count} classes, but its names are {', '.join(found.values())}"
        raise InputError(model.path, problem, "give one name for each class, in their order")
    return found


def choose_classes(source: object, found: Mapping[int, str], wanted: Sequence[str] | None) -> dict[int, str]:
    """The indices that are kept, with their names.

    Args:
        source: the file, for messages.
        found: index → name of every class.
        wanted: names; None takes `bird` where there is one, or the only class there is.

    Raises:
        InputError: a wanted class that the network lacks, or no choice made among several without a bird.
    """
    listing = f"its classes are {', '.join(found.values())}"
    if wanted is None:
        if "bird" not in found.values() and len(found) > 1:
            raise InputError(source, f"has no class called bird; {listing}", "say which of them are birds")
        return {i: name for i, name in found.items() if name == "bird"} or dict(found)
    missing = [name for name in wanted if name not in found.values()]
    if missing or not wanted:
        raise InputError(source, f"lacks {', '.join(missing) or 'a class to look for'}; {listing}", "ask for these")
    return {i: name for i, name in found.items() if name in wanted}
