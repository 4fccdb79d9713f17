"""A sweep in memory, and the plot of one."""

import dataclasses
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.birds import toy_bird

import jaxfit
from jaxfit.evaluation.ablation import ablate as ablation
from jaxfit.evaluation.ablation import report as plotting
from jaxfit.evaluation.ablation import table
from jaxfit.evaluation.ablation.grid import ClaimConfig, Run
from jaxfit.evaluation.ablation.measure import Result
from jaxfit.evaluation.ablation.table import results_table
from jaxfit.evaluation.bootstrap import Interval
from jaxfit.evaluation.evaluate import Evaluation
from jaxfit.fitting.fit import fit_runs
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import CropCamera
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect

BIRD, T, SIZE, BIRDS = toy_bird(shapes=0), 6, 64, 2
CAMERA = CropCamera(2167.0 * SIZE / 256, SIZE / 2, SIZE)


@pytest.fixture(scope="module")
def observed():
    return detect(BIRD, [smooth_motion(BIRD, T, seed) for seed in range(BIRDS)], 1.0, 0.05, 0, camera=CAMERA)


def config():
    paper = jaxfit.load_config("paper")
    stages = (dataclasses.replace(paper.stages[0], steps=12),)
    crop = dataclasses.replace(paper.crop, mode="image", size_px=SIZE)
    terms = {"keypoints": 0.625, "pose_prior": 0.1, "velocity": 0.1, "acceleration": 0}
    return dataclasses.replace(paper, window=T, stages=stages, crop=crop, terms=terms)


@pytest.mark.extended
def test_every_run_is_the_fit_of_its_config_in_the_order_of_the_values(observed):
    """Two programs, whose runs take turns: one scale a window, and one a frame."""
    values = {"terms.velocity": [0.1, 5], "common_size": [True, False]}
    swept = jaxfit.sweep(observed, BIRD, config(), values, observed)
    levels = [{"terms.velocity": v, "common_size": c} for v in (0.1, 5) for c in (True, False)]
    assert [dict(result.run.levels) for result in swept.results] == levels
    for first in (0, 1):
        pair = [jaxfit.with_values(config(), levels[r]) for r in (first, first + 2)]
        alone = fit_runs(observed, BIRD, pair)
        for r, expected in zip((first, first + 2), alone, strict=True):
            np.testing.assert_array_equal(swept.solutions[r].keypoints.px, expected.keypoints.px)
            assert swept.results[r].evaluation.overall == jaxfit.evaluate(expected, BIRD, observed).overall
            assert swept.results[r].runs_at_once == 2
    me_p = [result.evaluation.overall["me_p"] for result in swept.results]
    assert len(set(me_p)) == 4
    assert results_table(swept.results, "simple").count("\n") == 5


def test_print_shows_the_best_runs_in_ten_lines(monkeypatch):
    results = [result_of({"terms.velocity": v}, me) for v, me in ((0, 0.3), (1, float("nan")), (2, 0.1), (3, 0.2))]
    lines = repr(jaxfit.Sweep([], results)).splitlines()
    assert lines[1:3] == [f"  terms.velocity {v}  me_p {me:.4f}  me_v {me:.4f}" for v, me in ((2, 0.1), (3, 0.2))]
    assert "terms.velocity 1" in lines[4]
    assert len(repr(jaxfit.Sweep([], results * 30)).splitlines()) == 10
    assert jaxfit.Sweep([], results).table("github") == results_table(results, "github")
    assert jaxfit.Sweep([], results).plot()[1:4] == b"PNG"
    monkeypatch.setattr(ablation, "judge", lambda claims, _: claims)
    monkeypatch.setattr(table, "claims_table", lambda claims, form: (*claims, form))
    claim = ClaimConfig("2 helps", {"terms.velocity": 2}, {"terms.velocity": 0})
    assert jaxfit.Sweep([], results).compare("2 helps", claim.better, claim.worse) == (claim, "simple")


def test_an_unknown_key_is_refused(observed):
    with pytest.raises(InputError, match=r"terms\.veloctiy"):
        jaxfit.sweep(observed, BIRD, config(), {"terms.veloctiy.weight": [1]}, observed)


def result_of(levels, me):
    overall, interval = {"me_p": me, "me_v": me}, Interval(0.9 * me, 1.1 * me)
    evaluation = Evaluation(overall, {}, 1, 0, intervals={"me_p": interval, "me_v": interval})
    run = Run("run", levels, jaxfit.with_values(config(), levels))
    return Result(run, evaluation, 1.0, 1)


def test_too_many_runs_are_refused(observed):
    with pytest.raises(InputError, match=r"`values` makes 1,000,000 runs"):
        jaxfit.sweep(observed, BIRD, config(), {"window": range(1000), "terms.velocity": range(1000)}, observed)


def test_any_text_is_drawn_and_stays_in_its_cell(monkeypatch):
    names = ["$\\frac", "a|b$", "<img src=x>\n| c |", "plain"]
    results = [result_of({"stages[0].name": name, "stages[0].terms": ["velocity"]}, 0.1) for name in names]
    results = [
        dataclasses.replace(result, run=dataclasses.replace(result.run, name=f"{i}_x"))
        for i, result in enumerate(results)
    ]
    figure = drawn(results, monkeypatch)
    assert len(figure.legends[0].get_texts()) == len(names)
    lines = results_table(results, "github").splitlines()
    assert len(lines) == 2 + len(names)
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1
    assert "<" not in "".join(lines)
    assert results_table(results, "simple").count("\n") == 1 + len(names)


def drawn(results, monkeypatch):
    figures = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), save(self, *a, **k))[1])
    assert plotting.plot(results).startswith(b"\x89PNG")
    return figures[0]


def test_a_weight_of_zero_is_drawn(monkeypatch):
    results = [result_of({"terms.velocity": v}, me) for v, me in ((100, 0.2), (0, 0.3), (1, 0.1))]
    figure = drawn(results, monkeypatch)
    for panel in figure.axes:
        (line,) = (each for each in panel.lines if len(each.get_xdata()) == 3)
        np.testing.assert_array_equal(line.get_xdata(), [0, 1, 100])
        np.testing.assert_array_equal(line.get_ydata(), [0.3, 0.1, 0.2])
        at = panel.transData.transform(np.column_stack([line.get_xdata(), line.get_ydata()]))[:, 0]
        low, high = panel.get_window_extent().intervalx
        assert low < at[0] < at[1] < at[2] < high
    assert not figure.legends  # of one line


def test_lines_of_a_grid_stand_side_by_side_and_are_named(monkeypatch):
    levels = [{"filter_window": f, "terms.velocity": v} for f in (1, 5) for v in (1, 10, 100)]
    figure = drawn([result_of(each, 0.1) for each in levels], monkeypatch)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["median filter –", "median filter 5"]
    lines = [line.get_xdata() for line in figure.axes[0].lines if len(line.get_xdata()) == 3]
    assert (lines[0] < lines[1]).all()
    np.testing.assert_allclose(np.sqrt(lines[0] * lines[1]), [1, 10, 100])
