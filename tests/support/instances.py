"""Instances with rectangular masks."""

import numpy as np

from jaxfit.perception.network import Instance


def rectangle_instance(x0, y0, width, height, score=1.0, label="bird"):
    """An instance whose mask fills its box."""
    return Instance(np.ones((height, width), bool), x0, y0, score, label)
