"""Fits of several configs in one batch: equal to separate fits, with shared work done once and one program."""

import dataclasses

import numpy as np
import pytest
from support import fits
from support.fits import BIRD, CAMERA, T, truths

from jaxfit.config.build import with_values
from jaxfit.fitting import batch, tasks
from jaxfit.fitting import fit as fit_module
from jaxfit.fitting.fit import fit, fit_runs
from jaxfit.fitting.solve import advance
from jaxfit.simulation.noise import detect

BIRDS = 2


def config(steps=(12, 2), **values):
    base = fits.config(steps=steps, memory_gb=1.0)
    terms = {"keypoints": 0.625, "mask": 0.0625, "pose_prior": 0.1, "velocity": 0.1, "acceleration": 0.1}
    changes = {path.replace("__", "."): value for path, value in values.items()}
    return with_values(dataclasses.replace(base, terms=terms), changes)


SWEEP = [config(terms__velocity=0.1), config(terms__velocity=10), config(terms__velocity=10, filter_window=3)]


@pytest.fixture(scope="module")
def observed():
    return detect(BIRD, truths(birds=BIRDS), 1.0, 0.05, 0, camera=CAMERA)


@pytest.fixture(scope="module")
def swept(observed):
    return fit_runs(observed, BIRD, SWEEP)


def assert_equal(a, b):
    for name in ("global_orient", "body_pose", "transl", "scale", "keypoints_px", "valid"):
        np.testing.assert_array_equal(a.arrays()[name], b.arrays()[name], err_msg=name)
    for term in a.loss:
        np.testing.assert_array_equal(a.loss[term], b.loss[term], err_msg=term)


@pytest.mark.extended
def test_a_sweep_compiles_once(observed, compilations, monkeypatch):
    monkeypatch.setattr(advance, "_loaded", {})  # other tests fit batches of these shapes
    values = [(1, 2), (5, 6), (7, 8)]
    for a, b in values:
        fit_runs(observed, BIRD, [config((3, 1), terms__velocity=v) for v in (a, b)])
    compiled = [m for m in compilations() if "advance" in m.split("with")[0]]
    assert len(compiled) == 2  # one program for each stage


def test_runs_of_a_sweep_equal_separate_fits(observed, swept):
    reordered = fit_runs(observed, BIRD, SWEEP[::-1])[::-1]
    for each, solution, other in zip(SWEEP, swept, reordered, strict=True):
        assert solution.status.tolist() == ["ok"] * BIRDS
        assert_equal(solution, fit(observed, BIRD, each))
        assert_equal(solution, other)
    # the configs have different results
    assert np.abs(swept[0].keypoints.px - swept[1].keypoints.px).max() > 0.1
    assert np.abs(swept[1].keypoints.px - swept[2].keypoints.px).max() > 0.1


def test_a_batch_may_be_shorter_than_the_other_batches(observed, swept):
    """Three runs of two windows in batches of four: the last batch has two windows."""
    some = [dataclasses.replace(each, memory_gb=0.0066) for each in SWEEP]
    assert batch.frames_per_batch(BIRD, some[0]) // T == 4
    for a, b in zip(fit_runs(observed, BIRD, some), swept, strict=True):
        assert_equal(a, b)


def count_problems(monkeypatch):
    """Return a list that receives the number of problems of every stage."""
    counts = []
    tile_rows = batch.tile_rows

    def counting(count, size):
        counts.append(count)
        return tile_rows(count, size)

    monkeypatch.setattr(batch, "tile_rows", counting)
    return counts


def test_equal_first_stages_are_computed_once(observed, monkeypatch):
    counts = count_problems(monkeypatch)
    sweep = [config(stages__mask__override={"mask": weight / 16}) for weight in (0.5, 1, 2)]
    shared = fit_runs(observed, BIRD, sweep)
    assert counts == [BIRDS, 3 * BIRDS]
    for each, solution in zip(sweep, shared, strict=True):
        assert_equal(solution, fit(observed, BIRD, each))
    assert np.abs(shared[0].keypoints.px - shared[2].keypoints.px).max() > 0.01


def test_hypotheses_of_different_runs_are_not_mixed(observed, monkeypatch):
    two = {"initialise": dataclasses.replace(SWEEP[0].initialise, hypotheses=2)}
    sweep = [dataclasses.replace(each, **two) for each in SWEEP[:2]]
    counts = count_problems(monkeypatch)
    together = fit_runs(observed, BIRD, sweep)
    assert counts == [2 * 2 * BIRDS] * 2
    for each, solution in zip(sweep, together, strict=True):
        assert_equal(solution, fit(observed, BIRD, each))


def test_shared_data_is_prepared_once(observed, monkeypatch):
    counts = {}
    modules = {"cut_windows": fit_module, "load_targets": tasks, "search_initial_poses": tasks}
    for name, module in modules.items():
        original = getattr(module, name)

        def counting(*given, name=name, original=original):
            counts[name] = counts.get(name, 0) + 1
            return original(*given)

        monkeypatch.setattr(module, name, counting)
    fit_runs(observed, BIRD, SWEEP)
    # once without the filter, and once with the filter
    assert counts == {"cut_windows": 2, "load_targets": 2, "search_initial_poses": 2}


def test_configs_with_different_programs_are_rejected(observed):
    for other in (config(common_size=False), config(window=3), config((12, 3))):
        with pytest.raises(ValueError, match="one compiled program"):
            fit_runs(observed, BIRD, [SWEEP[0], other])
