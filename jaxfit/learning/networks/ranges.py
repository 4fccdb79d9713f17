"""Ranges of the numbers of a training, without PyTorch, so that a wrong number is rejected at once."""

from __future__ import annotations

from jaxfit.foundation.errors import InputError

CHECKS = 10
"""Number of measurements on the held-out pictures during a training on labels."""


def check_numbers(has_labels: bool, steps: int | None, scenes: int, seed: int, **shares: float) -> None:
    """Check the numbers of a training, and raise InputError for a number outside its range.

    Args:
        has_labels: whether a person or a teacher made labels.
        steps: number of steps; None for the default.
        scenes: number of simulated scenes.
        seed: seed of the samples.
        shares: `holdout`, `varied` or `wings`.
    """
    fewest_steps, fewest_scenes = (CHECKS, 0) if has_labels else (20, 1)
    if steps is not None and steps < fewest_steps:
        raise InputError("train: steps", f"is {steps}", f"give {fewest_steps} or more")
    if not fewest_scenes <= scenes <= 900:  # seeds of 1000 and more are for tests
        raise InputError("train: scenes", f"is {scenes}", f"give {fewest_scenes} to 900")
    if seed < 0:
        raise InputError("train: seed", f"is {seed}", "give a whole number from 0")
    for name, share in shares.items():
        largest = 0.5 if name == "holdout" else 1
        if not 0 <= share <= largest:
            raise InputError(f"train: {name}", f"is {share}", f"give a share of 0 to {largest}")
