"""Readers that the tests call in bounded children, with arguments and results that JSON can represent."""

from pathlib import Path

__all__ = ["read_coco_and_masks"]


def read_coco_and_masks(path: str) -> None:
    """Read observations, decode their masks, and write and read them again."""
    from jaxfit.data.formats.coco import read_coco, write_coco
    from support.observations import assert_same

    observations = read_coco(path)
    written = Path(f"{path}.again")
    write_coco(observations, written)
    assert_same(read_coco(written), observations)
