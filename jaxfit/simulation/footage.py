"""Rendered frames: the ledge, its texture, the light on plumage.

The colours are linear light in the order blue, green, red; the last step encodes them in eight bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import hard_mask, interpolate, vertex_normals
from jaxfit.simulation.flock import SimulatedBird, smooth_noise
from jaxfit.simulation.viewpoint import PICTURE_WIDTH_UNITS, Viewpoint

TILE = 1024


def smoothstep(low: float, high: float, values: np.ndarray) -> np.ndarray:
    """Map values to 0 below `low`, 1 above `high`, and smoothly in between; `low` may exceed `high`."""
    x = np.clip((values - low) / (high - low), 0, 1)
    return x * x * (3 - 2 * x)


class Noise:
    """A periodic tile of fractal noise, with mean 0 and standard deviation 1.

    Args:
        rng: source of randomness.
        octaves: number of octaves; each has twice as many cells as the previous octave.
        gain: amplitude of an octave relative to the previous octave.
        coarsest: number of cells of the first octave along a side, a power of two.
    """

    def __init__(self, rng: np.random.Generator, octaves: int = 8, gain: float = 0.55, coarsest: int = 4):
        tile = np.zeros((TILE, TILE), np.float32)
        for octave in range(octaves):
            cells = coarsest * 2**octave
            knots = rng.normal(size=(cells, cells)).astype(np.float32)
            padded = np.pad(knots, 4, mode="wrap")
            zoom = TILE // cells
            fine = cv2.resize(padded, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
            tile += gain**octave * fine[4 * zoom : 4 * zoom + TILE, 4 * zoom : 4 * zoom + TILE]
        self.tile = (tile - tile.mean()) / tile.std()

    def __call__(self, u: np.ndarray, v: np.ndarray, period: float) -> Float[np.ndarray, "*B"]:
        """Sample the noise at coordinates (u, v); the tile has the side `period`."""
        rows = -(-u.size // TILE)  # cv2.remap needs a two-dimensional picture
        x, y = (np.resize(np.asarray(c, np.float32) * np.float32(TILE / period) % TILE, (rows, TILE)) for c in (u, v))
        values = cv2.remap(self.tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return values.reshape(-1)[: u.size].reshape(u.shape)


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


SHUTTER = 0.4
"""Exposure time as a share of the time between frames."""
BLUR_STEP_PX = 4.0
"""A bird that moves farther than this during the exposure is rendered at several times."""
GAMMA = 2.2


class Footage:
    """Renders the frames of one scene.

    Args:
        bird: the model, for faces, colours and rest vertices.
        birds: the simulated birds.
        view: the camera.
        ledge_depth: distance from the edge of the ledge to the wall, model units.
        light: sunlight and skylight.
        seed: seed of rock, feathers and noise.
    """

    def __init__(
        self, bird: Bird, birds: Sequence[SimulatedBird], view: Viewpoint, ledge_depth: float, light: Light, seed: int
    ):
        rng = np.random.default_rng((seed, 2))
        self.birds, self.view, self.light = birds, view, light
        self.ledge = paint_ledge(rng, view, ledge_depth, light)
        self._feathers = Noise(rng, octaves=5, coarsest=16)
        V = len(bird.vertices)
        self._faces = np.concatenate([np.asarray(bird.faces) + n * V for n in range(len(birds))])
        self._bird_faces = np.asarray(bird.faces)
        self._rest = np.asarray(bird.vertices)
        self._colours = np.asarray(bird.vertex_colours)[:, ::-1] ** GAMMA * rng.uniform(0.85, 1.15, (len(birds), 1, 3))
        # birds differ in brightness more than in hue
        self._colours = np.clip(self._colours.mean(-1, keepdims=True) * 0.3 + self._colours * 0.7, 0.012, 0.9)
        self._grain = rng.normal(size=(2 * 256 + view.height, 2 * 256 + view.width)).astype(np.float32)
        self._flicker = 1 + 0.01 * smooth_noise(rng, len(birds[0].behaviour))
        self._noise = float(rng.uniform(0.004, 0.014))
        self._softness_px = float(rng.uniform(0.3, 0.8)) * view.width / 2592
        self._offsets = rng.integers(0, 512, (len(birds[0].behaviour), 2))
        x, y = np.meshgrid(np.linspace(-1, 1, view.width), np.linspace(-1, 1, view.height))
        self._vignette = (1 - rng.uniform(0.02, 0.12) * (x**2 + y**2)).astype(np.float32)[..., None]

    def frame(self, t: int) -> UInt8[np.ndarray, "H W 3"]:
        """Render frame t: blue, green, red."""
        now = np.stack([bird.vertices_world[t] for bird in self.birds])
        last = len(self._offsets) - 1
        before, after = (
            np.stack([bird.vertices_world[i] for bird in self.birds]) for i in (max(t - 1, 0), min(t + 1, last))
        )
        velocity = (after - before) / max(min(t + 1, last) - max(t - 1, 0), 1)
        travel = np.linalg.norm((self.view.to_screen(now + velocity) - self.view.to_screen(now))[..., :2], axis=-1)
        exposures = int(np.clip(np.ceil(SHUTTER * travel.max() / BLUR_STEP_PX), 1, 4))
        picture = self._with_shadows(now)
        total: np.ndarray | None = None
        for i in range(exposures):
            share = SHUTTER * ((i + 0.5) / exposures - 0.5)  # the true poses are those in the middle of the exposure
            rendered = self._with_birds(picture, now + share * velocity)
            total = rendered if total is None else total + rendered
        assert total is not None
        return self._expose(total / exposures, t)

    def _with_shadows(self, vertices_world: Float[np.ndarray, "N V 3"]) -> Float[np.ndarray, "H W 3"]:
        """Render the ledge with the shadows of the birds: a shadow in sunlight, and a soft shadow in skylight."""
        to_sun, view = self.light.to_sun_world, self.view
        projected = vertices_world - vertices_world[..., 2:] * (to_sun / to_sun[2])
        below = vertices_world * [1, 1, 0]
        small = view.smaller(4)
        sun, sky = (np.zeros((small.height, small.width), np.float32) for _ in range(2))
        for layer, points in ((sun, projected), (sky, below)):
            for mesh in small.to_screen(points):
                layer[hard_mask(mesh, self._bird_faces, small.width, small.height)] = 1
        sun = cv2.GaussianBlur(sun, (0, 0), 0.7 + small.width / 1500)
        sky = cv2.GaussianBlur(sky, (0, 0), small.width / 130)
        dark = np.clip(self.light.sun * sun + 0.55 * (1 - 0.5 * self.light.sun) * sky, 0, 0.85)
        dark = cv2.resize(dark, (view.width, view.height), interpolation=cv2.INTER_LINEAR) * self.ledge.on_ledge
        return self.ledge.picture * (1 - dark)[..., None]

    def _with_birds(
        self, picture: Float[np.ndarray, "H W 3"], vertices_world: Float[np.ndarray, "N V 3"]
    ) -> Float[np.ndarray, "H W 3"]:
        """Render the birds into the picture, within their common box."""
        view = self.view
        screen = view.to_screen(vertices_world)
        low = np.maximum(np.floor(screen[..., :2].min((0, 1))).astype(int) - 1, 0)
        high = np.minimum(np.ceil(screen[..., :2].max((0, 1))).astype(int) + 1, [view.width, view.height])
        if (high <= low).any():
            return picture
        normals = np.stack([vertex_normals(mesh, self._bird_faces) for mesh in vertices_world])
        rest = np.broadcast_to(self._rest, vertices_world.shape)
        attributes = np.concatenate([self._colours, normals, rest, vertices_world[..., 2:]], axis=-1)
        C = attributes.shape[-1]
        values, coverage, _ = interpolate(
            (screen - [*low, 0]).reshape(-1, 3).astype(np.float32),
            self._faces,
            attributes.reshape(-1, C).astype(np.float32),
            int(high[0] - low[0]),
            int(high[1] - low[1]),
        )
        out = picture.copy()
        box = out[low[1] : high[1], low[0] : high[0]]
        inside = coverage > 0
        alpha = coverage[inside][:, None]
        box[inside] = (1 - alpha) * box[inside] + alpha * lit_plumage(
            values[inside] / alpha, self.light, self._feathers
        )
        return out

    def _expose(self, linear: Float[np.ndarray, "H W 3"], t: int) -> UInt8[np.ndarray, "H W 3"]:
        """Apply blur, vignetting, flicker, gamma and noise (most visible in dark parts), and encode eight bits."""
        soft = cv2.GaussianBlur(linear.astype(np.float32), (0, 0), max(self._softness_px, 0.2))
        soft *= self._vignette * np.float32(1.5 * self._flicker[t])
        encoded = cv2.pow(np.clip(soft, 0, 1), 1 / GAMMA)
        y, x = self._offsets[t]
        grain = self._grain[y : y + self.view.height, x : x + self.view.width]
        return np.clip(255 * (encoded + self._noise * grain[..., None]) + 0.5, 0, 255).astype(np.uint8)
