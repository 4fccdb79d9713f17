"""The race of solvers: every curve begins at one loss and falls, and what is told of it is in the curves."""

import numpy as np
import pytest
from support.birds import toy_bird

from jaxfit.benchmarks.fit import noisy_scene
from jaxfit.benchmarks.solvers import RACE, bench_solvers, plot_solvers

pytestmark = pytest.mark.extended


@pytest.fixture(scope="module")
def found():
    bird = toy_bird(shapes=0)
    return bench_solvers(noisy_scene(bird, 2, 5)[1], bird, limit=12, repeats=2)


def test_curves(found):
    assert (found["birds"], found["windows"]) == (2, 2)
    assert len({found[name]["loss"][0] for name in RACE}) == 1
    for name in RACE:
        steps, seconds, loss = (found[name][key] for key in ("steps", "seconds", "loss"))
        assert len(steps) == len(seconds) == len(loss)
        assert (steps[0], steps[-1]) == (0, 12)
        assert seconds[0] == 0
        assert (np.diff(seconds) > 0).all()
        assert loss[-1] < 0.9 * loss[0], name
    assert (np.diff(found["levenberg_marquardt"]["loss"]) <= 1e-3).all(), "it never takes a step upwards"


def test_times_to_the_loss_of_adam(found):
    adam, own = found["adam"], found["levenberg_marquardt"]
    assert found["adam_s"] == adam["seconds"][-1]
    at = next(i for i, loss in enumerate(own["loss"]) if loss <= adam["loss"][-1])
    assert found["levenberg_marquardt_s"] == own["seconds"][at]
    assert found["levenberg_marquardt_ratio"] == pytest.approx(own["seconds"][at] / adam["seconds"][-1])
    assert found["levenberg_marquardt_loss"] == own["loss"][-1]


def test_plot(found, tmp_path):
    plot_solvers(found, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
