"""`behaviour_of`: features, bouts and time budgets as the report shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxfit.behaviour.bouts import Budget, Ethogram
from jaxfit.behaviour.describe import Description, by_reason
from jaxfit.behaviour.rules import OTHER, BehaviourConfig
from jaxfit.view.report.behaviour import Behaviour, Kind, ShownBout, ShownBudget
from jaxfit.view.report.curves import Curve

CURVES = {
    "body_pitch": "Body pitch",
    "wing_spread": "Wing spread",
    "speed": "Speed",
    "neighbour_distance": "Distance of the nearest neighbour",
}
"""Features that the report draws over time → title."""
UNITS = {"wing_spread": "share of the wing span"}
"""Unit of a feature for people, where the registry has none."""
RULES_NOTE = (
    "Rules with limits find the behaviours in the fitted poses. The limits of the shipped rules were chosen on "
    "simulated murres. Look at bouts in the film before you use them."
)
"""What every page says about the behaviours."""
OTHER_DEFINITION = "The bird has a pose, and no rule holds."


def behaviour_of(
    description: Description,
    ethogram: Ethogram,
    budget: Sequence[Budget],
    config: BehaviourConfig,
    notes: Sequence[str] | None = None,
) -> Behaviour:
    """Return what the birds of a result do, for `jaxfit.view.report`.

    Args:
        description: features of all birds and all frames of the result.
        ethogram: the bouts of the same birds.
        budget: the time budgets of the ethogram.
        config: the rules of the ethogram.
        notes: sentences about what is estimated or unknown; None: those of the birds (`Flock.notes`).
    """
    solution, names = description.flock.solution, list(ethogram.names)
    order = {name: n for n, name in enumerate(config.behaviours)}
    kinds = [
        Kind("other", OTHER_DEFINITION, None)
        if name == OTHER
        else Kind(name.replace("_", " "), config.behaviours[name].definition, order[name])
        for name in names
    ]
    bouts = [
        ShownBout(each.bird, names.index(each.behaviour), each.frames, each.start_s, each.stop_s, each.partner)
        for each in ethogram.bouts
    ]
    return Behaviour(
        track_id=solution.track_id,
        frames=solution.frame_index,
        times_s=ethogram.time_s,
        kinds=kinds,
        state=ethogram.state,
        bouts=bouts,
        curves=_curves(description),
        budget=_budget(names, budget, solution.track_id),
        notes=_notes(description, ethogram, description.flock.notes if notes is None else notes),
    )


def _curves(description: Description) -> list[Curve]:
    by_name = {each.name: each for each in description.features}
    curves = []
    for name, title in CURVES.items():
        if name in by_name:
            unit = UNITS.get(name) or by_name[name].shown_unit(description.flock.unit)
            curves.append(Curve(title, unit, description.values[name], by_name[name].definition))
    return curves


def _budget(names: Sequence[str], budget: Sequence[Budget], track_id: np.ndarray) -> list[ShownBudget]:
    shares = {(row.track, row.behaviour): row.share for row in budget}
    rows = []
    for row in budget:
        if row.track is None:
            of_birds = np.array([shares[track, row.behaviour] for track in track_id.tolist()])
            kind = names.index(row.behaviour)
            rows.append(ShownBudget(kind, row.seconds, row.bouts, row.share, row.low, row.high, of_birds))
    return rows


def _notes(description: Description, ethogram: Ethogram, notes: Sequence[str]) -> list[str]:
    """Return sentences about what is estimated, what is simulated, and what the result cannot show."""
    absent = {title.lower(): description.missing[name] for name, title in CURVES.items() if name in description.missing}
    lacking = {name.replace("_", " "): reason for name, reason in ethogram.missing.items()}
    sentences = [RULES_NOTE, *map(_sentence, notes)]
    sentences += [f"No curve of {_listed(names)}: {reason}." for reason, names in by_reason(absent).items()]
    for reason, names in by_reason(lacking).items():
        sentences.append(f"The result cannot show {_listed(names)}: {reason}.")
    return sentences


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
