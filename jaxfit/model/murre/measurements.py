"""How large a common guillemot is: the numbers that the model is made from, in centimetres, and where they come from.

`low` and `high` bound adults of the species (all subspecies and both sexes, which differ little); `used` is this
model's. Total length and wingspan are ranges as published. Wing, bill, tarsus and tail are the usual values of the
handbooks named, rounded outwards by us and not transcribed from their tables: good enough to build a bird, not to be
cited. Those marked APPROXIMATE are no one's table: our reading of photographs and of the proportions of auk skeletons,
good to a tenth or two of their value.

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
    """One length in centimetres."""

    low: float
    high: float
    used: float
    source: str


MEASUREMENTS = {
    "total_length": Measurement(38.0, 46.0, 42.5, "Collins 38–46; HBW 38–43; bill tip to tail tip, neck stretched"),
    "wingspan": Measurement(61.0, 73.0, 67.3, "Collins 61–73; BWP 64–70"),
    "wing": Measurement(19.0, 21.6, 19.9, "BWP, Pyle: folded wing, wrist to the tip of the longest primary"),
    "bill": Measurement(4.2, 5.1, 4.7, "BWP, Pyle: culmen, from the feathers to the tip"),
    "tarsus": Measurement(3.5, 4.1, 3.8, "BWP, Pyle"),
    "tail": Measurement(4.0, 5.3, 4.8, "BWP, Pyle"),
    "middle_toe": Measurement(4.4, 5.6, 5.0, "BWP: middle toe with claw; APPROXIMATE"),
    "humerus": Measurement(7.4, 9.4, 7.5, "proportions of auk skeletons; APPROXIMATE, the feathered length is shorter"),
    "forearm": Measurement(5.8, 7.4, 6.7, "proportions of auk skeletons; APPROXIMATE"),
    "body_width": Measurement(
        10.0, 12.5, 11.4, "photographs, and 0.95–1.05 kg at the density of a plumed bird; APPROXIMATE"
    ),
    "body_depth": Measurement(9.0, 11.5, 9.9, "likewise; APPROXIMATE"),
    "neck_width": Measurement(4.0, 5.8, 5.2, "photographs; APPROXIMATE"),
}
