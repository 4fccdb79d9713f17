"""Light on plumage: sun, sky, texture of feathers, sheen."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxfit.simulation.ledge import Light
from jaxfit.simulation.texture import Noise, smoothstep

__all__ = ["lit_plumage"]


def lit_plumage(attributes: Float[np.ndarray, "P 10"], light: Light, feathers: Noise) -> Float[np.ndarray, "P 3"]:
    """Return the colours of lit points of birds: texture of feathers, sheen, and less skylight near the feet.

    Args:
        attributes: for each point, colour (3, linear light), normal (3, world frame), position on the rest mesh (3) and
            height above the ground (1), in model units.
        light: sunlight and skylight.
        feathers: noise for the texture.
    """
    colour, normal, rest, height = np.split(attributes, [3, 6, 9], axis=1)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    across, along, up = (np.ascontiguousarray(rest[:, i]) for i in range(3))
    barbs = feathers(across + up, 0.35 * along, 9.0)
    tracts = feathers(along, 1.5 * (up - across), 60.0)
    colour = colour * np.clip(1 + 0.13 * barbs + 0.10 * tracts, 0.5, 1.6)[:, None]
    sun = np.maximum(normal @ light.to_sun_world, 0)
    sky = 0.5 + 0.5 * normal[:, 2]
    open_sky = 0.55 + 0.45 * smoothstep(0, 9, height[:, 0])  # ledge and body shade low parts
    brightness = 1.35 * light.sun * sun + (1 - 0.6 * light.sun) * (0.35 + 0.65 * sky) * open_sky
    sheen = 0.05 * sun**6 + 0.02 * sky
    return (colour * brightness[:, None] + (sheen * open_sky)[:, None]) * light.tint
