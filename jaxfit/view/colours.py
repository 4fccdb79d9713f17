"""The colours of all pictures: tracks and mesh outlines, keypoints, text and paper."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

Colour = tuple[int, int, int]

"""Blue, green, red."""

PAPER: Colour = (250, 250, 250)
INK: Colour = (40, 40, 40)
GREY: Colour = (120, 120, 120)
DARK: Colour = (60, 60, 60)
FITTED: Colour = (255, 255, 255)
"""Fitted keypoints on footage."""
DETECTED: Colour = (60, 235, 255)
"""Detected keypoints on footage."""
SEEN: Colour = (205, 205, 205)
OUTLINE: Colour = (60, 140, 30)
ON_PAPER_FITTED: Colour = (40, 40, 220)
ON_PAPER_DETECTED: Colour = (30, 30, 30)
"""Contact sheets without footage: the detected mask, the outline of the fitted mesh, fitted and detected keypoints."""

TRACK_COLOURS: tuple[Colour, ...] = (
    (0, 159, 230),  # orange
    (233, 180, 86),  # sky blue
    (136, 204, 60),  # green
    (191, 121, 224),  # pink
    (66, 228, 240),  # yellow
    (0, 84, 213),  # vermilion
    (214, 134, 30),  # blue
    (153, 136, 17),  # teal
    (204, 170, 255),  # rose
    (51, 153, 153),  # olive
    (230, 110, 150),  # violet
    (210, 245, 190),  # mint
)
"""Colours of the tracks in order, repeated after the last. The first seven are the colours of Okabe and Ito with the
dark colours made lighter; people with any colour vision can distinguish them. All contrast with dark and with white
plumage."""

PLUMAGE_SHARE = 0.4
"""Weight of the model's colours in the colours of a drawn bird; the rest is the colour of the track."""


def track_colour(n: int) -> Colour:
    """Return the colour of the track at position `n`."""
    return TRACK_COLOURS[n % len(TRACK_COLOURS)]


def tinted(vertex_colours: Float[np.ndarray, "V 3"], n: int, share: float = PLUMAGE_SHARE) -> Float[np.ndarray, "V 3"]:
    """Mix a model's colours (red, green, blue) with the colour of a track: blue, green, red in [0, 1]."""
    own = np.asarray(vertex_colours, np.float32)[:, ::-1]
    return share * own + (1 - share) * np.array(track_colour(n), np.float32) / 255
