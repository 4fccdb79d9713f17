"""Results that frames are chosen from: folders of `jaxfit fit` and `jaxfit reconstruct`, and their checks."""

import numpy as np
import pytest
from support.overlays import BIRD, FIRST, HEIGHT, WIDTH, N, T, film, solution

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.masks import box_of_keypoints
from jaxfit.data.observations import Observations
from jaxfit.data.solution import save_solution
from jaxfit.foundation.errors import InputError
from jaxfit.review.signals import frame_signals
from jaxfit.review.suggest import read_result

pytestmark = pytest.mark.extended  # the solution of the tests takes ten seconds


@pytest.fixture
def folder(tmp_path):
    save_solution(solution(), BIRD, "", {}, tmp_path / "result")
    return tmp_path / "result"


def observed(shift_px):
    """Return the projected keypoints as observations, moved by `shift_px` (T,) to the right."""
    fit = solution()
    points = fit.keypoints.px + np.asarray(shift_px)[:, None, None] * [1, 0]
    confidence = np.repeat(fit.valid[..., None], len(fit.keypoint_names), axis=-1)
    return Observations(
        track_id=fit.track_id,
        frame_index=fit.frame_index,
        present=fit.valid,
        keypoints_px=points,
        confidence=confidence * 0.7,
        box_px=box_of_keypoints(points, np.ones_like(confidence)),
        image_size_px=np.tile([WIDTH, HEIGHT], (T, 1)),
        file_name=np.array(["film.mp4"] * T),
        keypoint_names=fit.keypoint_names,
    )


def test_a_folder_of_fit_gives_its_projected_keypoints(folder, tmp_path):
    result = read_result(folder, film(tmp_path / "film.mp4"))
    assert result.solution is None
    seen, fit = result.observations, solution()
    assert seen.frame_index.tolist() == list(range(FIRST, FIRST + T))
    np.testing.assert_array_equal(seen.present, fit.valid)
    np.testing.assert_array_equal(seen.keypoints_px[fit.valid], fit.keypoints.px[fit.valid])
    assert seen.image_size(0, 0) == (WIDTH, HEIGHT)


def test_the_residual_of_a_folder_of_reconstruct(folder, tmp_path):
    """The residual is the distance as a share of the longer side of the box, in every frame."""
    shift = np.array([0, 1, 2, 0, 3, 0.5])
    birds = observed(shift)
    write_coco(birds, folder / "observations.json")
    result = read_result(folder, film(tmp_path / "film.mp4"))
    residual = frame_signals(result.observations, result.solution)["fit residual"]
    side = birds.box_px[..., 2:].max(-1)
    expected = [np.mean([shift[t] / side[n, t] for n in range(N) if birds.present[n, t]]) for t in range(T)]
    np.testing.assert_allclose(residual, expected, atol=1e-5)


def test_photographs_are_no_video(tmp_path):
    birds = observed(np.zeros(T)).select(tracks=[0], frames=[0])
    own = Observations(
        **{**vars(birds), "frame_index": np.array([0]), "own_images": {(0, 0): ("a.png", WIDTH, HEIGHT)}}
    )
    write_coco(own, tmp_path / "photographs.json")
    with pytest.raises(InputError, match="holds photographs"):
        read_result(tmp_path / "photographs.json", film(tmp_path / "film.mp4"))
