"""Unusable terms are rejected before the fit. Terms that make a fit diverge are named with track and step."""

import importlib
import json
import logging
import sys
from typing import Any

import numpy as np
import pytest
from support.cli_files import SIZE, T, arguments, rejected

from jaxfit.cli.main import main
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.solution import load_solution
from jaxfit.fitting.diagnose import name_failures
from jaxfit.model.camera import CROP_PX
from jaxfit.objective import registry

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


def command(inputs, tmp_path, *names, steps=3, weight=1):
    listed = ", ".join(f"'{name}'" for name in ("keypoints", *names))
    (tmp_path / "own.yaml").write_text(
        f"base: {inputs / 'quick.yaml'}\n"
        f"terms: {{{', '.join(f'{name!r}: {weight}' for name in names)}}}\n"
        f"stages:\n  - {{name: first, steps: {steps}, terms: [keypoints]}}\n"
        f"  - {{name: second, steps: {steps}, terms: [{listed}]}}\n"
    )
    return arguments(inputs, tmp_path / "out", config=str(tmp_path / "own.yaml"))


def test_a_term_by_its_path(inputs, tmp_path):
    asymmetry = []
    for weight in (0, 1e4):
        assert main([*command(inputs, tmp_path, "own_terms:symmetry", steps=30, weight=weight), "--overwrite"]) == 0
        solution, _ = load_solution(tmp_path / "out")
        assert set(solution.loss) == {"keypoints", "own_terms:symmetry"}
        left, right = (solution.joint_names.index(f"{side}_wing") - 1 for side in ("left", "right"))
        asymmetry.append(np.abs(solution.body_pose[:2, :, left] - solution.body_pose[:2, :, right]).mean())
    assert asymmetry[1] < 0.3 * asymmetry[0]
    assert "own_terms:symmetry" in (tmp_path / "out" / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("own_terms:vector", ("float32 of shape (6, 3)", "not one real number")),
        ("own_terms:python_if", ("own_terms.py:15", "jax.jit")),
        ("own_terms:no_reverse", ("differentiated", "while_loop")),
        ("own_terms:hoof", ("no keypoint 'hoof'", "bill_tip")),
        ("joint_limits", ("no joint limits",)),
        ("own_terms:absent", ("has no function 'absent'", "own.yaml")),
        ("absent_terms:symmetry", ("cannot be imported", "own.yaml")),
        ("nonsense", ("velocity", "package.module:function", "own.yaml")),
    ],
)
def test_unusable_terms_are_rejected(inputs, tmp_path, capsys, name, words):
    rejected(capsys, command(inputs, tmp_path, name, steps=1000), name, *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "part"), [("nan_value", "value"), ("nan_gradient", "gradient")])
def test_the_term_that_makes_a_fit_diverge_is_named(inputs, tmp_path, caplog, name, part):
    bill_px = read_coco(inputs / "birds.json").keypoints_px[:2, 0, 0, 0]  # of tracks 4 and 7
    importlib.import_module("own_terms").SPLIT_PX = bill_px.mean() * CROP_PX / SIZE
    diverged = {"nan_value": {("4", "7")[bill_px.argmin()]}, "nan_gradient": {"4", "7"}}[name]
    with caplog.at_level(logging.WARNING):
        assert main(command(inputs, tmp_path, f"own_terms:{name}")) == 0
    solution, _ = load_solution(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert set(summary["failures"]) == diverged
    assert {str(track) for track in solution.track_id[solution.status == "diverged"]} == diverged
    for track, reported in summary["failures"].items():
        failure = f"frames 0 to {T - 1}: the {part} of own_terms:{name} was not finite at step 1 of stage second"
        assert reported == [failure]
        assert f"track {track}, {failure}" in caplog.text


@pytest.mark.extended
def test_the_step_of_a_failure_is_reported(inputs, tmp_path):
    """The first step of Adam moves every translation by 0.01, so the value is not finite at the second step."""
    assert main(command(inputs, tmp_path, "own_terms:nan_value_later", steps=20)) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    expected = "the value of own_terms:nan_value_later was not finite at step 2 of stage second"
    assert [reported[0].split(": ", 1)[1] for reported in summary["failures"].values()] == [expected] * 2


def test_the_first_failure_is_kept():
    known = np.array(["", "known"], object)
    unused: Any = None  # no term is evaluated
    assert name_failures(known, np.array([0, 3]), "stage", unused, unused, unused).tolist() == ["", "known"]
