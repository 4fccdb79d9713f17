"""Comparison of two bird models: bones, surfaces, and a picture of both."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfit.adapt.rigid_start import Similarity, fit_similarity
from jaxfit.adapt.species import absolute_bones, body_length, rest_surface
from jaxfit.adapt.surface import closest_points, search_samples
from jaxfit.errors import InputError
from jaxfit.model.bird import Bird
from jaxfit.view.surface_views import Surface, error_colours, surface_views

__all__ = ["Comparison", "compare_birds", "draw_comparison"]

LARGEST_PERCENT = 5.0
"""The last colour of the picture."""
LEAST_COMMON = 4
"""Fewest common keypoints, or joints, that align two models."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Differences between two models in their rest pose, after an alignment by rotation, size and shift."""

    first: Float[np.ndarray, "U 3"]
    """Vertices of the first model."""
    aligned: Float[np.ndarray, "V 3"]
    """Vertices of the second model in the frame and the size of the first model."""
    size: float
    """Size of the second model relative to the first: 1.1 means that the second model is 10 % larger."""
    bones: dict[str, float]
    """Common bone → length in the second model, relative to the first, after the alignment."""
    of_first: Float[np.ndarray, "U"]
    """Distance of each vertex of the first model from the second, as a share of the first model's length."""
    of_second: Float[np.ndarray, "V"]
    """Distance of each vertex of the second model from the first, as the same share."""


def compare_birds(first: Bird, second: Bird) -> Comparison:
    """Compare two models in their rest pose, with the mean bone lengths of their priors.

    Models with the same faces are aligned by their vertices, other models by the keypoints that both have.

    Raises:
        InputError: the models have different faces, and fewer than four common keypoints and joints.
    """
    a, b = rest_surface(first), rest_surface(second)
    faces_a, faces_b = np.asarray(first.faces), np.asarray(second.faces)
    if np.array_equal(faces_a, faces_b) and len(a) == len(b):
        to_first = fit_similarity(b, a)
    else:
        to_first = _by_names(first, second)
    aligned = to_first.apply(b)
    length = body_length(first)
    on_b = closest_points(a, aligned, faces_b, search_samples(aligned, faces_b, 40_000))
    on_a = closest_points(aligned, a, faces_a, search_samples(a, faces_a, 40_000))
    lengths = [dict(zip(bird.joint_names[1:], absolute_bones(bird), strict=True)) for bird in (first, second)]
    common = [name for name in lengths[0] if lengths[1].get(name) and lengths[0][name] > 0.01 * length]
    bones = {name: float(lengths[1][name] * to_first.scale / lengths[0][name]) for name in common}
    return Comparison(a, aligned, 1 / to_first.scale, bones, on_b.distance / length, on_a.distance / length)


def _by_names(first: Bird, second: Bird) -> Similarity:
    """Return the similarity from the second model to the first by common keypoints, or by common joints."""
    for names, points in (("keypoint_names", "keypoints"), ("joint_names", "joints")):
        place = [
            dict(zip(getattr(b, names), np.asarray(getattr(b, points), np.float64), strict=True))
            for b in (first, second)
        ]
        common = [name for name in place[0] if name in place[1]]
        if len(common) >= LEAST_COMMON:
            to_first = [np.stack([places[name] for name in common]) for places in place]
            return fit_similarity(to_first[1], to_first[0])
    raise InputError(second.name, f"shares no four keypoints or joints with {first.name}", "compare models of birds")


def draw_comparison(path: str | Path, first: Bird, second: Bird, comparison: Comparison) -> None:
    """Write a picture of both models from six sides, each coloured by its distance from the other."""
    largest = LARGEST_PERCENT
    surfaces = [
        Surface(comparison.first, np.asarray(first.faces), error_colours(100 * comparison.of_first, largest)),
        Surface(comparison.aligned, np.asarray(second.faces), error_colours(100 * comparison.of_second, largest)),
    ]
    titles = [f"{first.name}: distance from {second.name}", f"{second.name}: distance from {first.name}"]
    lines = [
        f"mean distance of {name}: {100 * float(distance.mean()):.2f} % of length"
        for name, distance in ((first.name, comparison.of_first), (second.name, comparison.of_second))
    ]
    surface_views(path, [[surface] for surface in surfaces], titles, largest, lines)
