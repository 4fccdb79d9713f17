"""A z-buffer renderer: visible faces, masks, interpolated attributes and overlays. Not differentiable.

`operator` holds the public operations. `reference` defines their results in NumPy. `shading` computes lit colours.
"""

from jaxfit.raster.zbuffer.operator import Fragments, draw, hard_mask, interpolate, zbuffer
from jaxfit.raster.zbuffer.shading import shade, vertex_normals

__all__ = ["Fragments", "draw", "hard_mask", "interpolate", "shade", "vertex_normals", "zbuffer"]
