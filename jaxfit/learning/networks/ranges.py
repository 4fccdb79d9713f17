"""Ranges of the numbers of a training, without PyTorch, so that a wrong number is rejected at once."""

from __future__ import annotations

from jaxfit.foundation.errors import InputError

CHECKS = 10
"""Number of measurements on the held-out pictures during a training on labels."""
_MIN_STEPS = 20
"""Least number of steps of a training without labels."""
_MAX_SCENES = 900


def check_numbers(has_labels: bool, steps: int | None, scenes: int, seed: int, **shares: float) -> None:
    """Check the numbers of a training.

    Args:
        has_labels: whether a person or a teacher made labels.
        steps: number of steps; None for the default.
        scenes: number of simulated scenes.
        seed: seed of the samples.
        shares: `holdout`, `varied` or `wings`.

    Raises:
        InputError: a number outside its range.
    """
    least = CHECKS if has_labels else _MIN_STEPS
    if steps is not None and steps < least:
        raise InputError("train: steps", f"is {steps}", f"give {least} or more")
    least = 0 if has_labels else 1
    if not least <= scenes <= _MAX_SCENES:
        raise InputError("train: scenes", f"is {scenes}", f"give {least} to {_MAX_SCENES}")
    if seed < 0:
        raise InputError("train: seed", f"is {seed}", "give a whole number from 0")
    for name, share in shares.items():
        most = 0.5 if name == "holdout" else 1
        if not 0 <= share <= most:
            raise InputError(f"train: {name}", f"is {share}", f"give a share of 0 to {most}")
