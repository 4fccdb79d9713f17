"""Fits of photographs: as accurate as AVES' fitter from the same initial poses, and also without initial poses."""

import json

import pytest

from jaxfit.config.fit import load_config
from jaxfit.data.formats.coco import read_coco
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.fitting.fit import fit
from jaxfit.fitting.initial_poses import load_initial_poses
from jaxfit.model.published import import_model

pytestmark = pytest.mark.extended

SPECIES = "106.Horned_Puffin"


@pytest.fixture(scope="module")
def photographs(reference_dir):
    bird = import_model("aves", [reference_dir / "models" / "aves"])
    aves_fitter = json.loads((reference_dir / "reference" / "aves_fit.json").read_text())["species"][SPECIES]
    observations = read_coco(reference_dir / "cub" / f"{SPECIES}.json")
    assert observations.num_tracks == aves_fitter["n"]
    return bird, observations, aves_fitter


def fit_and_evaluate(photographs, config, initial_poses=None):
    bird, observations, _ = photographs
    solution = fit(observations, bird, load_config(config), initial_poses)
    assert (solution.status == "ok").all()
    overall = evaluate(solution, bird, observations).overall
    print(config, overall)  # noqa: T201
    return overall


def test_a_fit_from_stored_initial_poses(photographs, reference_dir):
    bird, observations, aves_fitter = photographs
    initial_poses = load_initial_poses(reference_dir / "cub" / f"{SPECIES}.init.npz", observations, bird)
    result = fit_and_evaluate(photographs, "aves", initial_poses)
    assert result["pck@0.05"] >= aves_fitter["pck05"] - 0.01
    assert result["pck@0.10"] >= aves_fitter["pck10"] - 0.01
    assert result["iou"] >= aves_fitter["iou"] - 0.015


def test_a_fit_without_stored_initial_poses(photographs):
    aves_fitter = photographs[2]
    result = fit_and_evaluate(photographs, "photo")
    assert result["pck@0.05"] >= aves_fitter["pck05"]
    assert result["iou"] >= aves_fitter["iou"] - 0.015
