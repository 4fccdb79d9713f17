"""Unusable terms are rejected before the fit. Terms that make a fit diverge are named with track and step."""

import dataclasses
import importlib
import logging
import sys
from typing import Any

import numpy as np
import pytest
from support.fits import BIRD, CAMERA, SIZE, T, config, truths

from jaxfit.fitting.diagnose import check_terms, name_failures
from jaxfit.fitting.fit import fit
from jaxfit.fitting.solve import fit_model
from jaxfit.foundation.errors import InputError
from jaxfit.model.camera import CROP_PX
from jaxfit.objective import registry
from jaxfit.simulation.noise import detect

MODULE = """
import jax
import jax.numpy as jnp

def symmetry(window, *, power=2.0):
    "The symmetry of the left and the right wing."
    left, right = window.joint_indices("left_wing", "right_wing")
    difference = window.pose.body_pose[:, left - 1] - window.pose.body_pose[:, right - 1]
    return jnp.sum(jnp.where(window.present[:, None], jnp.abs(difference) ** power, 0.0))

def vector(window):
    return window.pose.body_pose[:, 0]

def python_if(window):
    if window.pose.scale[0] > 1:
        return jnp.sum(window.pose.scale)
    return jnp.zeros(())

def no_reverse(window):
    return jax.lax.while_loop(lambda x: x < 3, lambda x: x + 1, jnp.sum(window.pose.scale))

def hoof(window):
    return jnp.sum(window.keypoints_px[:, window.keypoint_indices("hoof")])

SPLIT_PX = 0.0

def nan_value(window):
    left = window.targets.keypoints_px[0, 0, 0] < SPLIT_PX
    return jnp.where(left, jnp.nan, 0.0) * jnp.sum(window.pose.scale)

def nan_value_later(window):
    "NaN after the bird has moved, with a gradient of zero."
    moved = jnp.abs(window.pose.transl - window.anchor.transl).max() > 0.005
    return jnp.where(moved, jnp.nan, 0.0)

def nan_gradient(window):
    return jnp.sum(jnp.sqrt(jnp.abs(window.pose.body_pose - window.anchor.body_pose)))
"""


@pytest.fixture(autouse=True)
def package(tmp_path, monkeypatch):
    (tmp_path / "own_terms.py").write_text(MODULE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(registry, "_terms", dict(registry._terms))
    yield
    sys.modules.pop("own_terms", None)


def config_of(*names, steps=3, weight=1.0):
    """A stage with keypoints, then a stage with other terms, too."""
    plain = config(memory_gb=1.0)
    first = dataclasses.replace(plain.stages[0], name="first", steps=steps, terms=("keypoints",))
    second = dataclasses.replace(first, name="second", terms=("keypoints", *names))
    return dataclasses.replace(plain, stages=(first, second), terms={"keypoints": 6.25} | dict.fromkeys(names, weight))


@pytest.fixture(scope="module")
def observed():
    return detect(BIRD, truths(birds=2), masks=False, camera=CAMERA)


def test_a_term_by_its_path(observed):
    asymmetry = []
    left, right = (BIRD.joint_names.index(f"{side}_wing") - 1 for side in ("left", "right"))
    for weight in (0, 1e4):
        solution = fit(observed, BIRD, config_of("own_terms:symmetry", steps=30, weight=weight))
        assert set(solution.loss) == {"keypoints", "own_terms:symmetry"}
        asymmetry.append(np.abs(solution.poses.body_pose[:, :, left] - solution.poses.body_pose[:, :, right]).mean())
    assert asymmetry[1] < 0.3 * asymmetry[0]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("own_terms:vector", r"float32 of shape \(6, 3\).*not one real number"),
        ("own_terms:python_if", r"own_terms\.py:15.*jax\.jit"),
        ("own_terms:no_reverse", "differentiated.*while_loop"),
        ("own_terms:hoof", "no keypoint 'hoof'.*bill_tip"),
        ("joint_limits", "no joint limits"),
    ],
)
def test_unusable_terms_are_rejected_before_the_fit(name, words):
    with pytest.raises(InputError, match=f"(?s)'{name}'.*{words}"):
        check_terms(config_of(name), fit_model(BIRD, config()))


@pytest.mark.parametrize(("name", "part"), [("nan_value", "value"), ("nan_gradient", "gradient")])
def test_the_term_that_makes_a_fit_diverge_is_named(observed, caplog, name, part):
    """The value of one term is not finite for one bird; the gradient of the other term for both birds."""
    bill_px = observed.keypoints_px[:, 0, 0, 0]
    importlib.import_module("own_terms").SPLIT_PX = bill_px.mean() * CROP_PX / SIZE
    with caplog.at_level(logging.WARNING):
        solution = fit(observed, BIRD, config_of(f"own_terms:{name}"))
    diverged = {"nan_value": {int(bill_px.argmin())}, "nan_gradient": {0, 1}}[name]
    assert set(solution.failures) == set(np.flatnonzero(solution.status == "diverged")) == diverged
    for track, reported in solution.failures.items():
        failure = f"frames 0 to {T - 1}: the {part} of own_terms:{name} was not finite at step 1 of stage second"
        assert reported == (failure,)
        assert f"track {track}, {failure}" in caplog.text


def test_the_step_of_a_failure_is_reported(observed):
    """The first step of Adam moves every translation by 0.01, so the value is not finite at the second step."""
    solution = fit(observed, BIRD, config_of("own_terms:nan_value_later", steps=20))
    expected = "the value of own_terms:nan_value_later was not finite at step 2 of stage second"
    assert [reported[0].split(": ", 1)[1] for reported in solution.failures.values()] == [expected] * 2


def test_the_first_failure_is_kept():
    known = np.array(["", "known"], object)
    unused: Any = None  # no term is evaluated
    assert name_failures(known, np.array([0, 3]), "stage", unused, unused, unused).tolist() == ["", "known"]
