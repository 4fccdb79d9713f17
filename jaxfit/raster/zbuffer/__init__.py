"""A z-buffer renderer: visible faces, masks, interpolated attributes and overlays. Not differentiable.

`operator` holds the public operations. `reference` defines their results in NumPy. `shading` computes lit colours.
"""

from jaxfit.raster.zbuffer.operator import Fragments, MaskOverlap, draw, hard_mask, interpolate, mask_overlap, zbuffer
from jaxfit.raster.zbuffer.shading import shade, vertex_normals

__all__ = [
    "Fragments",
    "MaskOverlap",
    "draw",
    "hard_mask",
    "interpolate",
    "mask_overlap",
    "shade",
    "vertex_normals",
    "zbuffer",
]
