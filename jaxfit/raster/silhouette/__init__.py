"""The soft silhouette of a triangle mesh and its loss against a mask, with gradients.

`operator` holds the public operations. `reference` defines their results in plain JAX. `native` calls the kernels.
"""

from jaxfit.raster.silhouette.native import available_isas, choose_isa, current_isa, kernels_available
from jaxfit.raster.silhouette.operator import Backend, Kind, mask_loss, silhouette, silhouette_gauss_newton
from jaxfit.raster.silhouette.reference import UNKNOWN, Blur, Skin

__all__ = [
    "UNKNOWN",
    "Backend",
    "Blur",
    "Kind",
    "Skin",
    "available_isas",
    "choose_isa",
    "current_isa",
    "kernels_available",
    "mask_loss",
    "silhouette",
    "silhouette_gauss_newton",
]
