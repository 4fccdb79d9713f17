"""The soft silhouette of a triangle mesh and its loss against a mask, with gradients: the raster core.

`operator` holds the operations, `reference` defines them in plain JAX, `native` runs them in compiled kernels.
"""

from jaxfit.raster.silhouette.native import available_isas, choose_isa, current_isa, kernels_available
from jaxfit.raster.silhouette.operator import Backend, mask_loss, silhouette
from jaxfit.raster.silhouette.reference import Blur

__all__ = [
    "Backend",
    "Blur",
    "available_isas",
    "choose_isa",
    "current_isa",
    "kernels_available",
    "mask_loss",
    "silhouette",
]
