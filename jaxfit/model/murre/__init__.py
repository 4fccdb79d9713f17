"""The bird that comes with jaxfit: a common guillemot (common murre), *Uria aalge*, in breeding plumage.

Everything is made here from measurements: `measurements` (what is known of the species), `skeleton` (joints, and how
the wing unfolds), `surface`, `wing` and `leg` (the mesh), `skinning`, `plumage`, `variation` (shape and bones),
`postures`, `prior`. `build` puts them together and writes `murre.npz`, which is what `load_murre` reads.
"""

from jaxfit.model.files import load_murre
from jaxfit.model.murre.postures import POSTURES, Posture

__all__ = ["POSTURES", "Posture", "load_murre"]
