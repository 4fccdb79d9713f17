"""Randomised appearance, random patches of frames, errors of masks.

Light, texture, background, blur, noise and compression vary more than between real cameras, so that a network does not
depend on the appearance of the simulation.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.special import expit

from jaxfit.learning.networks.labelled_frames import LabelledFrames

SCENE_SHARE = 0.75
"""Share of the simulated pictures with a random scene; in all others, only the camera is randomised."""


def randomise_appearance(
    rng: np.random.Generator,
    picture: UInt8[np.ndarray, "H W 3"],
    birds: Bool[np.ndarray, "H W"],
    scene_share: float = SCENE_SHARE,
) -> UInt8[np.ndarray, "H W 3"]:
    """Randomise light, background and camera of a picture; the positions of the birds do not change.

    Args:
        rng: source of randomness.
        picture: blue, green, red, at the network's resolution.
        birds: the pixels of birds.
        scene_share: probability of a random scene: ground, clutter, contrast and light.
    """
    if rng.random() < scene_share:
        picture = _to_bytes(_randomise_scene(rng, picture, birds))
    picture = _randomise_colours(rng, picture)
    picture = _random_blur(rng, picture)
    picture = _add_grain(rng, picture)
    if rng.random() < 0.6:
        _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 92))])
        picture = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    return picture


def _randomise_scene(rng: np.random.Generator, picture: np.ndarray, birds: np.ndarray) -> Float[np.ndarray, "H W 3"]:
    """Randomise background and light; values may lie slightly outside 0 and 1."""
    image = picture.astype(np.float32) / 255
    if rng.random() < 0.45:
        image = _replace_ground(rng, image, birds)
    if rng.random() < 0.4:
        alpha = _soft_mask(birds)
        image = image * alpha + draw_clutter(rng, image) * (1 - alpha)
    if rng.random() < 0.5:  # contrast between plumage and ground: from black on white to grey on grey
        alpha = _soft_mask(birds)
        scaled = image * rng.uniform(0.6, 1.8) + rng.uniform(0, 0.08)
        image = image * (1 - alpha) + scaled * alpha
    if rng.random() < 0.5:
        image = image * np.exp(rng.uniform(0.1, 0.5) * _noise(rng, image.shape, 2))[..., None]
    if rng.random() < 0.25:
        image = image * _cast_shadow(rng, image.shape)[..., None]
    return image


def _to_bytes(image: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    return np.clip(255 * image + 0.5, 0, 255).astype(np.uint8)


def _noise(rng: np.random.Generator, shape: tuple[int, ...], octaves: int) -> Float[np.ndarray, "H W"]:
    """Draw smooth noise of about unit standard deviation: enlarged grids of random numbers."""
    height, width = shape[:2]
    total = np.zeros((height, width), np.float32)
    cells = int(rng.integers(2, 7))
    for octave in range(octaves):
        grid = rng.standard_normal((cells, cells), np.float32)
        total += 0.6**octave * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells = min(cells * 2 + 1, 128)
    return total


def _soft_mask(birds: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 1"]:
    return cv2.GaussianBlur(birds.astype(np.float32), (0, 0), 0.7)[..., None]


def _replace_ground(rng: np.random.Generator, image: np.ndarray, birds: np.ndarray) -> np.ndarray:
    """Replace the ground by two random colours mixed by noise, sometimes with streaks or the ledge shining through."""
    share = np.clip(0.5 + rng.uniform(0.2, 0.8) * _noise(rng, image.shape, int(rng.integers(2, 7))), 0, 1)[..., None]
    if rng.random() < 0.3:
        angle, length = rng.uniform(0, np.pi), rng.uniform(4, 40)
        y, x = np.ogrid[: image.shape[0], : image.shape[1]]
        streaks = np.sin((x * np.cos(angle) + y * np.sin(angle)) * (2 * np.pi / length)).astype(np.float32)
        share = np.clip(share + rng.uniform(0, 0.4) * streaks[..., None], 0, 1)
    first, second = (rng.uniform(0.02, 0.95, (2, 1)) + rng.uniform(-0.15, 0.15, (2, 3))).astype(np.float32)
    ground = np.clip(first * (1 - share) + second * share, 0, 1)
    kept = rng.uniform(0, 0.7) if rng.random() < 0.5 else 0.0
    ground = ground * (1 - kept) + image * kept
    alpha = _soft_mask(birds)
    return image * alpha + ground * (1 - alpha)


def draw_clutter(rng: np.random.Generator, image: np.ndarray) -> Float[np.ndarray, "H W 3"]:
    """Draw random ellipses and polygons, some as dark as a bird."""
    drawn = np.ascontiguousarray(image, np.float32)
    height, width = image.shape[:2]
    for _ in range(int(rng.integers(1, 9))):
        colour = np.clip(rng.choice([0.08, rng.uniform(0, 1)]) + rng.uniform(-0.06, 0.06, 3), 0, 1).tolist()
        centre = rng.uniform(0, [width, height])
        if rng.random() < 0.5:
            axes = rng.uniform(3, 0.12 * width, 2).astype(int).tolist()
            cv2.ellipse(drawn, centre.astype(int).tolist(), axes, rng.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA)
        else:
            spokes = int(rng.integers(3, 9))
            angles = np.sort(rng.uniform(0, 2 * np.pi, spokes))
            reach = rng.uniform(2, 0.14 * width, spokes)
            corners = centre + reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
            cv2.fillPoly(drawn, [corners.astype(np.int32)], colour, cv2.LINE_AA)
    return drawn


def _cast_shadow(rng: np.random.Generator, shape: tuple[int, ...]) -> Float[np.ndarray, "H W"]:
    """Draw the factor of brightness of a shadow with one edge across the picture."""
    height, width = shape[:2]
    y, x = np.ogrid[:height, :width]
    angle = rng.uniform(0, 2 * np.pi)
    beyond = (x - rng.uniform(0, width)) * np.cos(angle) + (y - rng.uniform(0, height)) * np.sin(angle)
    return (1 - rng.uniform(0.2, 0.6) * expit(beyond / rng.uniform(0.5, 8))).astype(np.float32)


def _randomise_colours(rng: np.random.Generator, picture: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    """Randomise exposure, contrast, white balance and saturation."""
    tone = np.linspace(0, 1, 256) ** np.exp(rng.uniform(-0.35, 0.35))
    tone = (tone - 0.4) * rng.uniform(0.6, 1.4) + 0.4 + rng.uniform(-0.12, 0.12)
    curves = _to_bytes(tone[None, :, None] * rng.uniform(0.85, 1.15, 3))
    picture = np.asarray(cv2.LUT(picture, curves))
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    saturation = rng.uniform(0.4, 1.6) if rng.random() < 0.9 else 0.0
    return np.asarray(cv2.addWeighted(picture, saturation, grey, 1 - saturation, 0), np.uint8)


def _random_blur(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Apply a random blur: defocus, motion, or a lower resolution."""
    kind = rng.random()
    if kind < 0.35:
        return cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 1.6))
    if kind < 0.45:
        side = int(rng.integers(3, 8))
        kernel = np.zeros((side, side), np.float32)
        reach = (side - 1) / 2 * np.array([np.cos(angle := rng.uniform(0, np.pi)), np.sin(angle)])
        middle = np.array([side // 2, side // 2])
        first, last = (np.round(middle + sign * reach).astype(int).tolist() for sign in (-1, 1))
        cv2.line(kernel, first, last, 1.0)
        return cv2.filter2D(picture, -1, kernel / kernel.sum())
    if kind < 0.6:
        height, width = picture.shape[:2]
        share = rng.uniform(0.4, 0.9)
        fewer = cv2.resize(picture, (int(share * width), int(share * height)), interpolation=cv2.INTER_AREA)
        return cv2.resize(fewer, (width, height), interpolation=cv2.INTER_LINEAR)
    return picture


@cache
def _noise_array() -> Float[np.ndarray, "512 512 3"]:
    return np.random.default_rng(0).standard_normal((512, 512, 3), np.float32)


def _add_grain(rng: np.random.Generator, picture: np.ndarray) -> UInt8[np.ndarray, "H W 3"]:
    """Add sensor noise: a random part of one array of noise, which is much faster than new noise."""
    height, width = picture.shape[:2]
    noise = _noise_array()
    if max(height, width) >= 512:  # a picture larger than the training samples
        noise = np.tile(noise, (height // 512 + 2, width // 512 + 2, 1))
    y, x = rng.integers(0, [noise.shape[0] - height, noise.shape[1] - width])
    grain = noise[y : y + height, x : x + width]
    return np.clip(picture + rng.uniform(0, 10) * grain + 0.5, 0, 255).astype(np.uint8)


def random_rotation(
    rng: np.random.Generator, factor: float, max_degrees: float
) -> tuple[Float[np.ndarray, "2 2"], bool]:
    """Draw a rotation times `factor`, mirrored with probability 1/2; return the matrix and whether it mirrors."""
    angle = np.radians(rng.uniform(-max_degrees, max_degrees))
    matrix = factor * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    mirrored = bool(rng.random() < 0.5)
    if mirrored:
        matrix[:, 0] *= -1
    return matrix, mirrored


def patch_around(
    frames: LabelledFrames, s: int, centre_px: Float[np.ndarray, "2"], reach_px: float, factor: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"], Int[np.ndarray, "2"]]:
    """Cut a square patch out of a frame, clipped to the frame; the patch may be empty.

    If `factor` reduces the picture, a Gaussian blur first removes the detail that would alias.

    Args:
        frames: the frames.
        s: index of the frame.
        centre_px: centre of the patch, pixels of the frame.
        reach_px: half the side of the patch, pixels of the frame.
        factor: scale of the later resampling.

    Returns:
        Picture, bird of each pixel, and x, y of the upper left corner in the frame.
    """
    low = np.maximum(np.floor(centre_px - reach_px), 0).astype(int)
    high = np.maximum(np.ceil(centre_px + reach_px), 0).astype(int)
    part = slice(low[1], high[1]), slice(low[0], high[0])
    picture, owner = np.ascontiguousarray(frames.pictures[s][part]), np.ascontiguousarray(frames.owner[s][part])
    if factor < 1 and picture.size:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.45 * np.sqrt(1 / factor**2 - 0.75)), np.uint8)
    return picture, owner, low
