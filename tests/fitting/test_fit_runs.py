"""Many configs as one batch: each as if it were alone, what they share done once, and one program for all."""

import dataclasses
import logging

import jax
import numpy as np
import pytest
from support.birds import toy_bird

from jaxfit.config.fit import load_config
from jaxfit.config.paths import with_values
from jaxfit.fitting import batch
from jaxfit.fitting import fit as fit_module
from jaxfit.fitting.fit import fit, fit_runs
from jaxfit.model.camera import Camera
from jaxfit.simulation.detections import detect
from jaxfit.simulation.motion import smooth_motion

BIRD, T, SIZE, BIRDS = toy_bird(shapes=0), 6, 64, 2
CAMERA = Camera(2167.0 * SIZE / 256, SIZE / 2, SIZE)
ONE = 0.002
"""GB in which one window of six frames fits."""


def config(steps=(12, 2), **values):
    paper = load_config("paper")
    stages = tuple(dataclasses.replace(s, steps=n) for s, n in zip(paper.stages, steps, strict=True))
    crop = dataclasses.replace(paper.crop, mode="image", size_px=SIZE)
    terms = {"keypoints": 0.625, "mask": 0.0625, "pose_prior": 0.1, "velocity": 0.1, "acceleration": 0.1}
    base = dataclasses.replace(paper, window=T, stages=stages, crop=crop, terms=terms, filter_window=1)
    return with_values(base, {path.replace("__", "."): value for path, value in values.items()})


SWEEP = [config(terms__velocity=0.1), config(terms__velocity=10), config(terms__velocity=10, filter_window=3)]


@pytest.fixture(scope="module")
def observed():
    return detect(BIRD, [smooth_motion(BIRD, T, seed) for seed in range(BIRDS)], 1.0, 0.05, 0, camera=CAMERA)


@pytest.fixture(scope="module")
def swept(observed):
    return fit_runs(observed, BIRD, SWEEP)


def assert_equal(a, b):
    for name in ("global_orient", "body_pose", "transl", "scale", "keypoints_px", "valid"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for term in a.loss:
        np.testing.assert_array_equal(a.loss[term], b.loss[term], err_msg=term)


def test_a_sweep_compiles_once(observed, caplog):
    jax.clear_caches()  # other tests fit batches of these shapes
    with caplog.at_level(logging.WARNING), jax.log_compiles():
        values = [(1, 2), (5, 6), (7, 8)]
        for a, b in values:
            fit_runs(observed, BIRD, [config((3, 1), terms__velocity=v) for v in (a, b)])
    messages = [record.getMessage() for record in caplog.records]
    compiled = [m for m in messages if m.startswith("Compiling") and "advance" in m.split("with")[0]]
    assert len(compiled) == 2  # a stage each


def test_every_run_is_as_if_alone(observed, swept):
    for each, solution in zip(SWEEP, swept, strict=True):
        alone = fit(observed, BIRD, each)
        assert solution.status.tolist() == ["ok"] * BIRDS
        # batches of other sizes round otherwise, and Adam's steps do not shrink
        np.testing.assert_allclose(solution.keypoints_px, alone.keypoints_px, atol=0.05)
        for term, loss in alone.loss.items():
            np.testing.assert_allclose(solution.loss[term], loss, rtol=0.02, err_msg=term)
    # and they are not all the same
    assert np.abs(swept[0].keypoints_px - swept[1].keypoints_px).max() > 0.1
    assert np.abs(swept[1].keypoints_px - swept[2].keypoints_px).max() > 0.1


def test_the_place_in_a_batch_does_not_matter(observed, swept):
    turned = fit_runs(observed, BIRD, SWEEP[::-1])[::-1]
    for a, b in zip(swept, turned, strict=True):
        assert_equal(a, b)


def test_batches_of_one_window_give_the_same(observed):
    small = [dataclasses.replace(each, memory_gb=ONE) for each in SWEEP]
    together = fit_runs(observed, BIRD, small)
    for each, solution in zip(small, together, strict=True):
        assert_equal(solution, fit(observed, BIRD, each))


def test_a_short_batch_is_filled_up(observed):
    """Three runs of two windows in batches of four: the last is filled with counts that count nothing."""
    some = [dataclasses.replace(each, memory_gb=0.0066) for each in SWEEP]
    assert batch.frames_per_batch(BIRD, some[0]) // T == 4
    together = fit_runs(observed, BIRD, some)
    for a, b in zip(together, fit_runs(observed, BIRD, some[::-1])[::-1], strict=True):
        assert_equal(a, b)


def count_problems(monkeypatch):
    counts = []
    begin = batch.begin

    def counting(program, problems, *rest):
        counts.append(problems.anchor.global_orient.shape[0])
        return begin(program, problems, *rest)

    monkeypatch.setattr(batch, "begin", counting)
    return counts


def test_equal_first_stages_are_done_once(observed, monkeypatch):
    counts = count_problems(monkeypatch)
    sweep = [config(stages__mask__override={"mask": weight / 16}) for weight in (0.5, 1, 2)]
    shared = fit_runs(observed, BIRD, sweep)
    assert counts == [BIRDS, 3 * BIRDS]
    for each, solution in zip(sweep, shared, strict=True):
        np.testing.assert_allclose(solution.keypoints_px, fit(observed, BIRD, each).keypoints_px, atol=0.05)
    assert np.abs(shared[0].keypoints_px - shared[2].keypoints_px).max() > 0.01


def test_runs_that_start_alike_but_pull_otherwise_share_nothing(observed, monkeypatch):
    counts = count_problems(monkeypatch)
    fit_runs(observed, BIRD, SWEEP[:2])
    assert counts == [2 * BIRDS, 2 * BIRDS]


def test_hypotheses_stay_with_their_run(observed, monkeypatch):
    two = {"initialise": dataclasses.replace(SWEEP[0].initialise, hypotheses=2)}
    sweep = [dataclasses.replace(each, **two) for each in SWEEP[:2]]
    counts = count_problems(monkeypatch)
    together = fit_runs(observed, BIRD, sweep)
    assert counts == [2 * 2 * BIRDS] * 2
    for each, solution in zip(sweep, together, strict=True):
        np.testing.assert_allclose(solution.keypoints_px, fit(observed, BIRD, each).keypoints_px, atol=0.05)


def test_what_runs_share_is_prepared_once(observed, monkeypatch):
    counts = {}
    for name in ("cut_windows", "load_targets", "search_initial_poses"):
        original = getattr(fit_module, name)

        def counting(*given, name=name, original=original):
            counts[name] = counts.get(name, 0) + 1
            return original(*given)

        monkeypatch.setattr(fit_module, name, counting)
    fit_runs(observed, BIRD, SWEEP)
    # without and with the filter
    assert counts == {"cut_windows": 2, "load_targets": 2, "search_initial_poses": 2}


def test_other_programs_are_refused(observed):
    for other in (config(common_size=False), config(window=3), config((12, 3))):
        with pytest.raises(ValueError, match="one compiled program"):
            fit_runs(observed, BIRD, [SWEEP[0], other])
