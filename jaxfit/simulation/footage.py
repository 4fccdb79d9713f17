"""Rendering of the frames of a scene: lighting, shadows, motion blur, sensor noise.

The colours are linear light in the order blue, green, red; the last step encodes them in eight bits.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import hard_mask, interpolate, vertex_normals
from jaxfit.simulation.flock import SimulatedBird
from jaxfit.simulation.ledge import Light, paint_ledge
from jaxfit.simulation.motion import smooth_noise
from jaxfit.simulation.plumage_light import lit_plumage
from jaxfit.simulation.texture import Noise
from jaxfit.simulation.viewpoint import Viewpoint

__all__ = ["Footage"]

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
        small = view._replace(width=view.width // 4, height=view.height // 4, focal_px=view.focal_px / 4)
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
