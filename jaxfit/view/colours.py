"""The colours of all pictures: tracks and mesh outlines, behaviours, keypoints, text and paper."""

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

BEHAVIOUR_COLOURS: tuple[Colour, ...] = (
    (238, 204, 136),  # light blue
    (153, 170, 68),  # teal
    (136, 34, 51),  # indigo
    (153, 68, 170),  # purple
    (85, 34, 136),  # wine
    (119, 204, 221),  # sand
    (51, 153, 153),  # olive
    (51, 119, 17),  # green
    (119, 102, 204),  # rose
    (212, 207, 200),  # light grey
)
"""Colours of behaviours in the order of their config, repeated after the last: Paul Tol's palette *muted* in another
order, with a light grey that differs from paper. People with any colour vision can distinguish them: the smallest
difference (CIEDE2000) of two of them, or of one and white, is 10.9, also with simulated protanopia, deuteranopia and
tritanopia (Machado et al. 2009)."""
OTHER_BEHAVIOUR: Colour = (155, 145, 133)
"""A bird that shows no behaviour of the config; drawn as a thin bar."""

FLAG_COLOURS = {"ok": "#9fb8a6", "unsure": "#f5b700", "contradicted": "#c1121f"}
"""Flag of a pose → colour in timelines of reports and of the viewer, as HTML names it."""
CONFIDENCE_COLOURS = ("#bdd7e7", "#6baed6", "#2b7bba", "#08306b")
"""Colours of poses in the timeline of reports, from the lowest confidence of the keypoints to the highest."""
NO_POSE_COLOUR = "#d95f02"
"""A detected bird without a pose in the timeline of reports."""

PLUMAGE_SHARE = 0.4
"""Weight of the model's colours in the colours of a drawn bird; the rest is the colour of the track."""


def track_colour(n: int) -> Colour:
    """Return the colour of the track at position `n`."""
    return TRACK_COLOURS[n % len(TRACK_COLOURS)]


def behaviour_colour(n: int | None) -> Colour:
    """Return the colour of the behaviour at position `n` of its config; None is no behaviour of the config."""
    return OTHER_BEHAVIOUR if n is None else BEHAVIOUR_COLOURS[n % len(BEHAVIOUR_COLOURS)]


def css(colour: Colour) -> str:
    """Return a colour as HTML and SVG name it: `#rrggbb`."""
    blue, green, red = colour
    return f"#{red:02x}{green:02x}{blue:02x}"


def ink_on(colour: Colour) -> Colour:
    """Return the colour of text on a colour: dark or white, whichever has more contrast."""
    linear = (np.array(colour) / 255) ** 2.2
    return INK if linear @ (0.0722, 0.7152, 0.2126) > 0.18 else (255, 255, 255)


def tinted(vertex_colours: Float[np.ndarray, "V 3"], n: int, share: float = PLUMAGE_SHARE) -> Float[np.ndarray, "V 3"]:
    """Mix a model's colours (red, green, blue) with the colour of a track: blue, green, red in [0, 1]."""
    own = np.asarray(vertex_colours, np.float32)[:, ::-1]
    return share * own + (1 - share) * np.array(track_colour(n), np.float32) / 255
