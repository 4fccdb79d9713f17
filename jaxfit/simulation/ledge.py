"""Rendering of the empty ledge: rock, guano, the wall behind, the sea below."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from jaxfit.simulation.texture import Noise, smoothstep
from jaxfit.simulation.viewpoint import PICTURE_WIDTH_UNITS, Viewpoint

__all__ = ["Ledge", "Light", "paint_ledge", "random_light"]

HEIGHT_ABOVE_SEA = 900.0
"""Height of the ledge above the sea, model units."""


class Light(NamedTuple):
    """Sunlight and skylight of one scene."""

    to_sun_world: Float[np.ndarray, "3"]
    """Unit direction towards the sun."""
    sun: float
    """Share of the sunlight in the light; the rest is skylight."""
    tint: Float[np.ndarray, "3"]
    """Colour of the light: blue, green, red."""


class Ledge(NamedTuple):
    """The picture without birds."""

    picture: Float[np.ndarray, "H W 3"]
    """Linear light, blue, green, red."""
    on_ledge: Float[np.ndarray, "H W"]
    """1 where the picture shows the ledge, on which the shadows of birds fall."""


def random_light(rng: np.random.Generator) -> Light:
    """Draw a light between overcast and bright sun, with a random direction of the sun."""
    azimuth, height = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(40, 75))
    to_sun = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
    warmth = rng.normal(0, 0.04)
    return Light(to_sun, float(rng.uniform(0.15, 0.6)), rng.uniform(0.85, 1.1) * np.array([1 - warmth, 1, 1 + warmth]))


def paint_ledge(rng: np.random.Generator, view: Viewpoint, depth: float, light: Light) -> Ledge:
    """Render the scene without birds: each pixel has the texture at the point that its ray meets.

    Args:
        rng: source of randomness.
        view: the camera.
        depth: distance from the edge of the ledge (y = 0) to the wall, model units.
        light: sunlight and skylight.
    """
    coarse, fine, specks = Noise(rng), Noise(rng, gain=0.7), Noise(rng, octaves=4, coarsest=32)
    rays = view.rays()
    position = view.position_world.astype(np.float32)
    down = np.minimum(rays[..., 2], -1e-3)
    ground = -position[2] / down
    x, y = position[0] + ground * rays[..., 0], position[1] + ground * rays[..., 1]
    edge = 2.2 * coarse(x, np.zeros_like(x), 180.0)  # the edge is not straight
    wall_at = depth + 1.5 * coarse(x, np.full_like(x, 7.0), 130.0)
    behind, below = y > wall_at, y < edge
    # the point where the ray meets the wall, y = depth
    forward = np.where(np.abs(rays[..., 1]) > 1e-3, rays[..., 1], 1e-3)
    to_wall = (depth - position[1]) / forward
    wall_x, wall_z = position[0] + to_wall * rays[..., 0], position[2] + to_wall * rays[..., 2]
    u, v = np.where(behind, wall_x, x), np.where(behind, 1.4 * wall_z + 400, y)
    height = 1.0 * coarse(u, v, 230.0) + 0.35 * fine(u, v, 110.0)
    slope = _relief(height, light, view)
    warmth = rng.uniform(0, 0.3)  # from grey to brown
    stone = rng.uniform(0.16, 0.27) * np.array([1 - warmth, 1 - 0.3 * warmth, 1 + 0.2 * warmth], np.float32)
    mottled = 1 + 0.22 * coarse(u + 55, v - 31, 190.0) + 0.16 * specks(u, v, 110.0)
    cracked = 0.45 + 0.55 * smoothstep(0, 0.05, np.abs(coarse(v + 13, u - 71, 210.0) + 0.1 * fine(u, v, 90.0)))
    rock = stone * np.clip(mottled * slope * cracked, 0.1, 2.2)[..., None]
    guano = _guano(coarse, fine, specks, u, v, behind)[..., None]
    white = np.array([0.62, 0.68, 0.70], np.float32) * np.clip(0.8 + 0.2 * slope, 0.4, 1.2)[..., None]
    rock = rock * (1 - guano) + white * guano
    rock *= np.where(behind, 0.7 + 0.1 * smoothstep(0, 30, wall_z), 1.0)[..., None].astype(np.float32)
    crease = 1 - 0.45 * np.exp(-np.abs(y - wall_at) / 2.5)  # little light reaches the corner between ledge and wall
    rim = 1 - 0.5 * np.exp(-np.maximum(y - edge, 0) / 0.7)
    rock *= (crease * rim)[..., None]
    sea = _sea(coarse, position, rays, down, light)
    sea_share = cv2.GaussianBlur(below.astype(np.float32), (0, 0), 0.0006 * view.width + 0.4)[..., None]
    picture = rock * (1 - sea_share) + sea * sea_share
    on_ledge = (1 - sea_share[..., 0]) * ~behind
    return Ledge((picture * light.tint).astype(np.float32), on_ledge.astype(np.float32))


def _relief(height: np.ndarray, light: Light, view: Viewpoint) -> np.ndarray:
    """Shade the relief of the rock: 1 on a flat surface, brighter on slopes towards the sun."""
    units = view.width / PICTURE_WIDTH_UNITS
    rise_x = cv2.Sobel(height, cv2.CV_32F, 1, 0, scale=0.125) * units
    rise_y = -cv2.Sobel(height, cv2.CV_32F, 0, 1, scale=0.125) * units
    lit = 1 - (rise_x * light.to_sun_world[0] + rise_y * light.to_sun_world[1]) * (0.5 + light.sun)
    return np.clip(lit, 0.35, 1.8)


def _guano(coarse: Noise, fine: Noise, specks: Noise, u: np.ndarray, v: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Compute the share of guano: blotches on the ledge, streaks on the wall."""
    blotch = smoothstep(0.7, 1.5, coarse(u - 90, v + 17, 150.0) + 0.45 * fine(u, v, 90.0))
    speck = 0.8 * smoothstep(2.2, 2.6, specks(u + 5, v + 5, 190.0) + 0.5 * coarse(v, u, 230.0))
    streak = smoothstep(0.6, 1.6, coarse(u, 0.12 * v, 60.0) + 0.3 * fine(u, v, 60.0))
    return np.where(behind, 0.7 * streak, np.maximum(0.8 * blotch, speck)).astype(np.float32)


def _sea(coarse: Noise, position: np.ndarray, rays: np.ndarray, down: np.ndarray, light: Light) -> np.ndarray:
    """Render the sea: dark water with swell and foam, out of focus."""
    distance = -(position[2] + HEIGHT_ABOVE_SEA) / down
    x, y = position[0] + distance * rays[..., 0], position[1] + distance * rays[..., 1]
    swell = coarse(x, 2.5 * y, 900.0)
    foam = smoothstep(1.6, 2.6, swell + 0.5 * coarse(x + 31, y, 300.0))[..., None]
    water = np.array([0.10, 0.085, 0.055], np.float32) * (1 + 0.22 * swell)[..., None]
    return cv2.GaussianBlur(np.clip(water + 0.35 * foam, 0, 1).astype(np.float32), (0, 0), 2.0)
