"""The contact sheet without footage shows what was detected and what was fitted."""

import dataclasses

import cv2
import numpy as np
from support.birds import solution_of, toy_bird

from jaxfit.simulation.flock import smooth_motion
from jaxfit.simulation.noise import detect
from jaxfit.view.colours import ON_PAPER_FITTED, OUTLINE, SEEN
from jaxfit.view.contact_sheet import TILE_PX, contact_sheet

BIRD = toy_bird(shapes=0)


def test_every_pair_of_tiles_is_drawn(tmp_path):
    poses = smooth_motion(BIRD, 4, 0)
    observations = detect(BIRD, [poses])
    solution = dataclasses.replace(solution_of(BIRD, [poses]), track_id=observations.track_id)
    contact_sheet(solution, BIRD, observations, tmp_path / "sheet.png", columns=3, most=4)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    legend, sheet = sheet[: -2 * TILE_PX], sheet[-2 * TILE_PX :]
    assert sheet.shape == (2 * TILE_PX, 3 * 2 * TILE_PX, 3)
    tiles = sheet.reshape(2, TILE_PX, 3, 2, TILE_PX, 3).transpose(0, 2, 3, 1, 4, 5).reshape(6, 2, TILE_PX, TILE_PX, 3)
    for picture in (legend, *tiles[:4, 0]):
        for colour in (SEEN, OUTLINE, ON_PAPER_FITTED):
            assert (np.abs(picture.astype(int) - colour).sum(-1) < 60).any()  # thin lines are blended
    for detected, mesh in tiles[:4]:
        covered = (mesh != mesh[0, 0]).any(-1)
        grey = (detected == SEEN).all(-1)
        assert (covered & grey).sum() > 0.5 * grey.sum()  # the mesh lies where the bird was detected
    assert (tiles[4:] == tiles[4, 0, 0, 0]).all()
