"""Features of a bird and its nearest neighbour."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from jaxfit.behaviour.birds import Birds
from jaxfit.behaviour.motion import velocity
from jaxfit.behaviour.posture import heading_deg, turn_deg, unit_vector
from jaxfit.behaviour.registry import feature


def nearest(birds: Birds) -> tuple[Int[np.ndarray, "N T"], Float[np.ndarray, "N T"]]:
    """Return the position of the nearest other bird of each bird (−1 without), and its distance."""
    N, T = birds.valid.shape
    best, index = np.full((N, T), np.inf), np.full((N, T), -1)
    for n in range(N):  # bird by bird, so that the memory stays small
        distance = np.linalg.norm(birds.place - birds.place[n], axis=-1)
        distance[n] = np.nan
        distance = np.where(np.isnan(distance), np.inf, distance)
        index[n] = np.where(np.isfinite(distance.min(axis=0)), distance.argmin(axis=0), -1)
        best[n] = distance.min(axis=0)
    return index, np.where(index >= 0, best, np.nan)


def of_neighbour(birds: Birds, values: Float[np.ndarray, "N T *D"]) -> Float[np.ndarray, "N T *D"]:
    """Return the values of the nearest neighbour of each bird; NaN without a neighbour."""
    index, _ = birds.once(nearest)
    chosen = values[index, np.arange(index.shape[1])]
    return np.where((index >= 0).reshape(*index.shape, *(1,) * (values.ndim - 2)), chosen, np.nan)


def towards(birds: Birds) -> Float[np.ndarray, "N T 3"]:
    """Return the horizontal direction from each bird to its nearest neighbour."""
    return unit_vector((of_neighbour(birds, birds.place) - birds.place) * [1, 1, 0])


@feature(unit="id", needs=("neighbours",))
def neighbour(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Track of the nearest other bird, by the distance between the middles of the bodies (the root joints)."""
    index, _ = birds.once(nearest)
    return np.where(index >= 0, index, np.nan)


@feature(unit="length", needs=("neighbours",))
def neighbour_distance(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Distance between the middle of the body and that of the nearest neighbour."""
    return birds.once(nearest)[1]


@feature(unit="length", keypoints=("bill_tip",), needs=("neighbours",))
def bill_distance(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Distance between the tip of the bill and that of the nearest neighbour."""
    tip = birds.keypoint("bill_tip")
    return np.linalg.norm(of_neighbour(birds, tip) - tip, axis=-1)


@feature(unit="deg", needs=("neighbours", "level"))
def facing_angle(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Angle between body_heading and the direction to the nearest neighbour; 0 faces it, 180 turns its back to it."""
    return np.abs(turn_deg(heading_deg(birds.forward) - heading_deg(birds.once(towards))))


@feature(unit="length/s", needs=("neighbours", "level", "time"))
def approach_speed(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Speed of the bird towards its nearest neighbour, from its own movement only; negative if the bird withdraws."""
    return np.sum(birds.once(velocity) * birds.once(towards), axis=-1)


@feature(unit="length/s", needs=("neighbours", "level", "time"))
def neighbour_approach_speed(birds: Birds) -> Float[np.ndarray, "N T"]:
    """Speed of the nearest neighbour towards the bird, from the movement of the neighbour only."""
    return -np.sum(of_neighbour(birds, birds.once(velocity)) * birds.once(towards), axis=-1)
