"""Real photographs: as good as AVES' own fitter from its starting points, and better without any."""

import json

import pytest

from jaxfit.config.fit import load_config
from jaxfit.data.formats.coco import read_coco
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.fitting.fit import fit
from jaxfit.fitting.initial_pose_file import load_initial_poses
from jaxfit.model.importers.import_model import import_model

pytestmark = pytest.mark.extended

SPECIES = "106.Horned_Puffin"


@pytest.fixture(scope="module")
def photographs(reference_dir):
    bird = import_model("aves", [reference_dir / "models" / "aves"])
    reached = json.loads((reference_dir / "reference" / "aves_fit.json").read_text())["species"][SPECIES]
    observations = read_coco(reference_dir / "cub" / f"{SPECIES}.json")
    assert observations.num_tracks == reached["n"]
    return bird, observations, reached


def measured(photographs, config, start=None):
    bird, observations, _ = photographs
    solution = fit(observations, bird, load_config(config), start)
    assert (solution.status == "ok").all()
    overall = evaluate(solution, bird, observations).overall
    print(config, overall)  # noqa: T201
    return overall


def test_from_the_stored_starting_points(photographs, reference_dir):
    bird, observations, reached = photographs
    start = load_initial_poses(reference_dir / "cub" / f"{SPECIES}.init.npz", observations, bird)
    result = measured(photographs, "aves", start)
    assert result["pck@0.05"] >= reached["pck05"] - 0.01
    assert result["pck@0.10"] >= reached["pck10"] - 0.01
    assert result["iou"] >= reached["iou"] - 0.015


def test_without_a_starting_point(photographs):
    reached = photographs[2]
    result = measured(photographs, "photo")
    assert result["pck@0.05"] >= reached["pck05"]
    assert result["iou"] >= reached["iou"] - 0.015
