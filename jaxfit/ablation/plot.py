"""Plot of me_p and me_v over the key with the most values in a grid; one line per combination of other values."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from jaxfit.ablation.measure import CLAIMED, Result
from jaxfit.ablation.table import format_cell, heading
from jaxfit.errors import one_line, shortened

__all__ = ["plot", "swept"]

_LABELS = {"me_p": "me_p (fraction of the bird's longer side)", "me_v": "me_v (the same fraction, per frame)"}
_LABEL_CHARACTERS, _LABELS_SHOWN = 100, 60
_STYLES = ("-", "--", "-.", ":")
_MARKERS = "osD^v<>Pp*"


def plot(results: Sequence[Result]) -> bytes:
    """Return a PNG with one panel for me_p and one for me_v.

    The horizontal axis is the varied key with the most numbers (λ_vel for the grid of the paper). A line joins runs
    with the same values of all other keys; a horizontal line shows a run without such partners. Bars are 95 %
    intervals over birds.
    """
    path = swept(results)
    lines: dict[tuple[str, ...], list[Result]] = {}
    for result in results:
        rest = (f"{heading(p)} {format_cell(p, level)}" for p, level in result.run.levels.items() if p != path)
        lines.setdefault(tuple(rest), []).append(result)
    common = set.intersection(*(set(key) for key in lines)) if len(lines) > 1 else set()
    figure = Figure(figsize=(12, 5.2), layout="constrained")
    panels = figure.subplots(1, len(CLAIMED))
    x_of = [_number(result, path) for result in results]
    positive = [x for x in x_of if x > 0]
    logarithmic = bool(path and positive) and max(positive) >= 20 * min(positive)
    shift = 1.1 if logarithmic else 1.03
    for panel, metric in zip(panels, CLAIMED, strict=True):
        for i, (key, members) in enumerate(lines.items()):
            text = ", ".join(part for part in key if part not in common) or "all"
            # Matplotlib reads text between dollar signs as mathematics
            label = shortened(one_line(text), _LABEL_CHARACTERS).replace("$", r"\$")
            style = {"color": f"C{i % 10}", "linestyle": _STYLES[i // 10 % 4], "label": label}
            value = np.array([r.evaluation.overall[metric] for r in members])
            bounds = np.array([r.evaluation.intervals[metric] for r in members]).T
            if len(members) == 1:
                panel.axhline(value[0], linewidth=1, alpha=0.8, **style)
                continue
            # shifted, so that the error bars of different lines do not overlap
            x = np.array([_number(r, path) for r in members]) * shift ** (i - (len(lines) - 1) / 2)
            order = np.argsort(x)
            error = np.abs(bounds - value)[:, order]
            marker = _MARKERS[i % len(_MARKERS)]
            panel.errorbar(x[order], value[order], error, marker=marker, markersize=4, elinewidth=0.6, **style)
        panel.set(xlabel=heading(path) if path else "run", ylabel=_LABELS[metric], title=metric)
        if logarithmic:
            # a logarithmic scale has no place for 0, the weight of a term that is switched off; symlog has
            panel.set_xscale("symlog", linthresh=min(positive), linscale=0.5)
        panel.set_yscale("log")
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter(NullFormatter())
        panel.grid(True, which="both", alpha=0.2)
    if len(lines) > 1:
        handles, labels = (each[:_LABELS_SHOWN] for each in panels[0].get_legend_handles_labels())
        figure.legend(handles, labels, loc="outside right center", fontsize=7, frameon=False)
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110, metadata={"Software": None})
    return out.getvalue()


def swept(results: Sequence[Result]) -> str:
    """Return the path of the varied key with the most numbers; an empty text where no key has two numbers."""

    def numbers(path: str) -> int:
        if not all(_is_number(result.run.value(path)) for result in results):
            return 0
        return len({level for result in results if _is_number(level := result.run.levels[path])})

    best = max(results[0].run.levels, key=numbers, default="")
    return best if best and numbers(best) > 1 else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(result: Result, path: str) -> float:
    """Return the value of the key in this run; without a key, the position of the run."""
    return float(result.run.value(path)) if path else float(result.run.name.partition("_")[0])
