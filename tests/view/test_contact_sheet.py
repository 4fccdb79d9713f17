"""The contact sheet shows what was seen and what was fitted."""

import dataclasses

import cv2
import numpy as np
import pytest
from support.birds import toy_bird

from jaxfit import load_config
from jaxfit.evaluation.benchmarks.fit import bench_fit
from jaxfit.fitting.fit import fit
from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect
from jaxfit.view.colours import ON_PAPER_FITTED, OUTLINE, SEEN
from jaxfit.view.contact_sheet import TILE_PX, contact_sheet

BIRD = toy_bird(shapes=0)


def short(name: str):
    config = load_config(name)
    stages = tuple(dataclasses.replace(stage, steps=2) for stage in config.stages)
    return dataclasses.replace(config, stages=stages, window=4)


@pytest.mark.extended
def test_every_pair_of_tiles_is_drawn(tmp_path):
    observations = detect(BIRD, [smooth_motion(BIRD, 4, 0)])
    solution = fit(observations, BIRD, short("paper"))
    contact_sheet(solution, BIRD, observations, tmp_path / "sheet.png", columns=3, most=4)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    legend, sheet = sheet[: -2 * TILE_PX], sheet[-2 * TILE_PX :]
    assert sheet.shape == (2 * TILE_PX, 3 * 2 * TILE_PX, 3)
    for colour in (SEEN, OUTLINE, ON_PAPER_FITTED):
        assert (np.abs(legend.astype(int) - colour).sum(-1) < 60).any()
    tiles = sheet.reshape(2, TILE_PX, 3, 2, TILE_PX, 3).transpose(0, 2, 3, 1, 4, 5).reshape(6, 2, TILE_PX, TILE_PX, 3)
    for pair in range(4):
        evidence, mesh = tiles[pair]
        for colour in (SEEN, OUTLINE, ON_PAPER_FITTED):
            near = np.abs(evidence.astype(int) - colour).sum(-1) < 60  # thin lines are blended
            assert near.any()
        covered = (mesh != mesh[0, 0]).any(-1)
        grey = (evidence == SEEN).all(-1)
        assert (covered & grey).sum() > 0.5 * grey.sum()  # the mesh lies where the bird was seen
    assert (tiles[4:] == tiles[4, 0, 0, 0]).all()


@pytest.mark.extended
def test_the_benchmark_of_the_fit_reports_what_it_ran():
    result = bench_fit(BIRD, birds=2, frames=4, config=short("paper"))
    assert (result["birds"], result["frames"], result["steps"]) == (2, 4, [2, 2])
    assert result["faces"] == len(BIRD.faces)
    assert result["ms_per_frame_step"] == pytest.approx(60e3 * result["minutes"] / (2 * 4 * 4))
    assert 0 < result["iou"] <= 1
    assert result["pa_mpjpe"] < 2
