"""A z-buffer renderer for looking at meshes: what is seen where, masks, attributes, overlays. Not differentiable.

`raster` holds the operations, `reference` defines them in NumPy, `shading` lights a mesh.
"""

from jaxfit.raster.zbuffer.operator import Fragments, draw, hard_mask, interpolate, zbuffer
from jaxfit.raster.zbuffer.shading import shade, vertex_normals

__all__ = ["Fragments", "draw", "hard_mask", "interpolate", "shade", "vertex_normals", "zbuffer"]
