"""The bird that comes with jaxfit: a common guillemot (common murre), *Uria aalge*, in breeding plumage.

This package designs the model from measurements: `skeleton` (joints, and the
unfolding of the wing), `surface` (the mesh of body, wing and leg), `skinning` (with the variation of shape and bone
lengths), `postures` (with the prior). `build` combines these parts and writes `murre.npz`, the file that `load_murre`
reads.
"""

from jaxfit.model.files import load_murre
from jaxfit.model.murre.postures import POSTURES, Posture

__all__ = ["POSTURES", "Posture", "load_murre"]
