"""Six views of a bird: each from where it says, all at one scale."""

import cv2
import numpy as np
import pytest
from support.birds import toy_bird

from jaxfit.cli.main import main
from jaxfit.model.files import load_murre
from jaxfit.view.mesh_views import FOOT_PX, PAPER, TILE_PX, TITLE_PX, six_views


def tiles(path):
    sheet = cv2.imread(str(path)).astype(int)
    assert sheet.shape[1] == 3 * TILE_PX
    rows = np.split(sheet[:-FOOT_PX], [_second_row(sheet)])
    names = ("left", "front", "above", "right", "back", "below")
    cut = [tile[TITLE_PX:] for row in rows for tile in np.split(row, 3, axis=1)]
    return {name: np.abs(tile - PAPER).sum(-1) > 12 for name, tile in zip(names, cut, strict=True)}, sheet


def _second_row(sheet):
    """Rows differ in height: the views above and below, and the sides, are as high in both."""
    return (len(sheet) - FOOT_PX) // 2


def extent(mask, axis):
    return np.ptp(np.flatnonzero(mask.any(axis))) + 1


def test_each_is_seen_from_its_side(tmp_path):
    assert main(["model", "view", "murre", "--posture", "standing", "--out", str(tmp_path / "murre.png")]) == 0
    seen, _ = tiles(tmp_path / "murre.png")
    for one, other in (("left", "right"), ("front", "back")):
        np.testing.assert_allclose(seen[one].sum(), seen[other].sum(), rtol=0.01)  # mirror images
    assert seen["left"].any()
    # the same lengths from different sides
    assert extent(seen["left"], 1) == pytest.approx(extent(seen["front"], 1), abs=2)
    assert extent(seen["left"], 0) == pytest.approx(extent(seen["above"], 1), abs=2)
    assert extent(seen["front"], 0) == pytest.approx(extent(seen["below"], 0), abs=2)
    # a standing murre seen from its left has its bill at the upper left
    rows, columns = np.nonzero(seen["left"])
    bill = rows[columns.argmin()]
    assert bill < rows.min() + 0.3 * np.ptp(rows)
    rows, columns = np.nonzero(seen["right"])
    assert rows[columns.argmax()] < rows.min() + 0.3 * np.ptp(rows)


def test_other_models_and_postures(tmp_path):
    six_views(toy_bird(), tmp_path / "toy.png")
    seen, _ = tiles(tmp_path / "toy.png")
    assert all(mask.sum() > 500 for mask in seen.values())
    six_views(load_murre(), tmp_path / "flying.png", "wings_up")
    flying, _ = tiles(tmp_path / "flying.png")
    assert extent(flying["front"], 0) > 1.5 * extent(flying["front"], 1)
    with pytest.raises(ValueError, match="posture must be one of"):
        six_views(load_murre(), tmp_path / "no.png", "swimming")
    with pytest.raises(ValueError, match="body_pose"):
        six_views(toy_bird(), tmp_path / "no.png", "standing")
    assert not (tmp_path / "no.png").exists()
