"""Readers of observations and truths that the tests call in bounded children, with arguments that JSON can carry."""

from pathlib import Path

from jaxfit.data.formats.coco import read_coco, write_coco
from support.observations import assert_same

__all__ = ["read_and_write_coco"]


def read_and_write_coco(path: str) -> None:
    """Read observations, decode their masks, and write and read them again."""
    observations = read_coco(path)
    written = Path(f"{path}.again")
    write_coco(observations, written)
    assert_same(read_coco(written), observations)
