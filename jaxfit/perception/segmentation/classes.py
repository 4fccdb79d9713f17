"""Class names of networks, and the choice of the classes to keep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from jaxfit.errors import InputError
from jaxfit.limits import CLASSES
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
"""The 80 classes of COCO, in the order of networks with consecutive class numbers."""
_UNUSED_CATEGORIES = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)


def coco_by_category() -> dict[int, str]:
    """Return COCO's category numbers (1 to 90 with gaps) → names, as in torchvision and RF-DETR."""
    numbers = (number for number in range(1, 91) if number not in _UNUSED_CATEGORIES)
    return dict(zip(numbers, COCO, strict=True))


def names_of(model: OnnxModel, names: Sequence[str] | None, count: int | None) -> dict[int, str]:
    """Return index → name of the classes of a network that numbers its classes from 0.

    The given names have priority over the file's metadata (`names`, a Python literal, as Ultralytics writes it), and
    the metadata over COCO's names. A network without names whose number of classes is not COCO's has the names
    `class_0`, `class_1` and so on.

    Args:
        model: the network.
        names: names in the order of the classes; None uses the file's names.
        count: number of classes; None if the shapes of the network do not contain it.

    Raises:
        InputError: the numbers of names and classes differ, the metadata cannot be read, or there are too many classes.
    """
    if count is not None and count > CLASSES:
        raise InputError(model.path, f"has {count:,} classes", f"the limit is {CLASSES:,}")
    own = literal_metadata(model, "names") if names is None else list(names)
    if own is None:
        own = COCO if count in (None, len(COCO)) else [f"class_{i}" for i in range(count or 0)]
    try:
        by_index = {int(i): str(name) for i, name in (own.items() if isinstance(own, dict) else enumerate(own))}
    except (ValueError, TypeError, OverflowError) as error:
        problem = f"metadata `names` is not a list of classes: {own!r:.80}"
        raise InputError(model.path, problem, "give the names of its classes") from error
    if sorted(by_index) != list(range(len(by_index) if count is None else count)):
        problem = f"has {count} classes, but its names are {', '.join(by_index.values())}"
        raise InputError(model.path, problem, "give one name for each class, in the order of the classes")
    return by_index


def choose_classes(source: object, names: Mapping[int, str], chosen: Sequence[str] | None) -> dict[int, str]:
    """Return index → name of the classes to keep.

    Args:
        source: the file, for messages.
        names: index → name of every class.
        chosen: names of the classes to keep; None keeps `bird`, or the only class.

    Raises:
        InputError: the network lacks a chosen class, or has several classes without `bird` and `chosen` is None.
    """
    if not names:
        raise InputError(source, "has no classes", "give the names of its classes")
    listing = f"its classes are {', '.join(names.values())}"
    if chosen is None:
        if "bird" not in names.values() and len(names) > 1:
            raise InputError(source, f"has no class called bird; {listing}", "choose the classes that are birds")
        return {i: name for i, name in names.items() if name == "bird"} or dict(names)
    missing = [name for name in chosen if name not in names.values()]
    if missing or not chosen:
        raise InputError(source, f"lacks {', '.join(missing) or 'a class to keep'}; {listing}", "choose from these")
    return {i: name for i, name in names.items() if name in chosen}
