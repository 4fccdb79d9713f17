"""Measurements of the common guillemot from which the model is built, in centimetres, with their sources.

`low` and `high` are the range of adults of the species (all subspecies and both sexes, which differ little); `used`
is the value of this model. The ranges of total length and wingspan are published ranges. The values of wing, bill,
tarsus and tail are the usual values of the named handbooks. We rounded these ranges outwards and did not copy them
from the tables of the handbooks: they are accurate enough to build a model, but must not be cited. Values marked
APPROXIMATE come from no table. We estimated them from photographs and from the proportions of auk skeletons; their
error is 10 to 20 % of the value.

Sources:
    BWP: Cramp, S. (ed.) 1985, *The Birds of the Western Palearctic*, vol. IV, Uria aalge.
    HBW: del Hoyo, J., Elliott, A. & Sargatal, J. (eds.) 1996, *Handbook of the Birds of the World*, vol. 3, Alcidae.
    Pyle: Pyle, P. 2008, *Identification Guide to North American Birds*, part II.
    G&J: Gaston, A. J. & Jones, I. L. 1998, *The Auks*.
    Collins: Mullarney, K. et al. 1999, *Collins Bird Guide*.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["MEASUREMENTS", "Measurement"]


class Measurement(NamedTuple):
    """Range, model value and source of one length, in centimetres."""

    low: float
    high: float
    used: float
    source: str


MEASUREMENTS = {
    "total_length": Measurement(38.0, 46.0, 42.5, "Collins 38–46; HBW 38–43; bill tip to tail tip, neck straight"),
    "wingspan": Measurement(61.0, 73.0, 67.3, "Collins 61–73; BWP 64–70"),
    "wing": Measurement(19.0, 21.6, 19.9, "BWP, Pyle: folded wing, wrist to the tip of the longest primary"),
    "bill": Measurement(4.2, 5.1, 4.7, "BWP, Pyle: culmen, from the feathers to the tip"),
    "tarsus": Measurement(3.5, 4.1, 3.8, "BWP, Pyle"),
    "tail": Measurement(4.0, 5.3, 4.8, "BWP, Pyle"),
    "middle_toe": Measurement(4.4, 5.6, 5.0, "BWP: middle toe with claw; APPROXIMATE"),
    "humerus": Measurement(7.4, 9.4, 7.5, "proportions of auk skeletons; APPROXIMATE; shorter when feathered"),
    "forearm": Measurement(5.8, 7.4, 6.7, "proportions of auk skeletons; APPROXIMATE"),
    "body_width": Measurement(
        10.0, 12.5, 11.4, "photographs, and 0.95–1.05 kg at the density of a plumed bird; APPROXIMATE"
    ),
    "body_depth": Measurement(9.0, 11.5, 9.9, "as body_width; APPROXIMATE"),
    "neck_width": Measurement(4.0, 5.8, 5.2, "photographs; APPROXIMATE"),
}
