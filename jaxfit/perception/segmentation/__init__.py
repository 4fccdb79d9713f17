"""Segmentation: from a frame to its instances, with networks of several layouts behind one protocol."""

from jaxfit.perception.segmentation.load import KINDS, load_segmenter, segmenter_files

__all__ = ["KINDS", "load_segmenter", "segmenter_files"]
