"""The benchmark of the solvers: all curves begin at the same loss and decrease, and the times agree with the curves."""

import numpy as np
import pytest
from support.birds import toy_bird

from jaxfit.evaluation.benchmarks.fit import SCHEDULES, bench_solvers, noisy_scene, plot_solvers

pytestmark = pytest.mark.extended


@pytest.fixture(scope="module", params=SCHEDULES)
def result(request):
    bird = toy_bird(shapes=0)
    return bench_solvers(noisy_scene(bird, 2, 5)[1], bird, request.param, limit=12, repeats=2)


def test_curves(result):
    assert (result["birds"], result["windows"]) == (2, 2)
    assert len({result[name]["loss"][0] for name in SCHEDULES[result["stage"]]}) == 1
    for name in SCHEDULES[result["stage"]]:
        steps, seconds, loss = (result[name][key] for key in ("steps", "seconds", "loss"))
        assert len(steps) == len(seconds) == len(loss)
        assert (steps[0], steps[-1]) == (0, 12)
        assert seconds[0] == 0
        assert loss[-1] < 0.9 * loss[0], name
    assert (np.diff(result["levenberg_marquardt"]["loss"]) <= 1e-3).all(), (
        "Levenberg-Marquardt must not increase the loss"
    )


def test_times_to_the_loss_of_adam(result):
    adam, own = result["adam"], result["levenberg_marquardt"]
    assert result["adam_s"] == adam["seconds"][-1]
    at = next(i for i, loss in enumerate(own["loss"]) if loss <= adam["loss"][-1])
    assert result["levenberg_marquardt_s"] == own["seconds"][at]
    assert result["levenberg_marquardt_ratio"] == pytest.approx(own["seconds"][at] / adam["seconds"][-1])
    assert result["levenberg_marquardt_loss"] == own["loss"][-1]


def test_plot(result, tmp_path):
    plot_solvers(result, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
