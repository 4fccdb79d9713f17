"""The reader of common_murre_temporal, on files made here: every reading that it accepts, and all that it refuses.

The real file's layout is not published, so these tests show that the reader says what it reads, not that it is right.
"""

import json

import cv2
import numpy as np
import pytest
from support.cli_files import rejected

from jaxfit.cli.main import main
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.common_murre import read_common_murre
from jaxfit.foundation.errors import InputError
from jaxfit.model.anatomy import MURRE_KEYPOINTS

N, T, K, WIDTH, HEIGHT = 3, 12, 20, 64, 40


def positions():
    """(T, N, K, 2): whole pixels in the picture, x up to the right edge."""
    rng = np.random.default_rng(0)
    xy = np.stack([rng.integers(1, WIDTH, (T, N, K)), rng.integers(1, HEIGHT, (T, N, K))], -1).astype(float)
    xy[0, 0, 0] = WIDTH, 1
    return xy


def flags():
    third = np.ones((T, N, K))
    third[:, 1, 4] = third[3, 2] = 0
    return third


def array(xy=None, third=None):
    xy, third = positions() if xy is None else xy, flags() if third is None else third
    return np.concatenate([xy, third[..., None]], axis=-1)


@pytest.fixture
def data_set(tmp_path):
    """Writes the folder: annotations, and pictures whose names sort as text in another order."""

    def write(annotations, pictures=T, size=(WIDTH, HEIGHT)):
        folder = tmp_path / "murres"
        (folder / "images").mkdir(parents=True)
        np.save(folder / "annotations.npy", annotations)
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        for t in range(pictures):
            cv2.imwrite(str(folder / "images" / f"img{t + 1}.png"), picture)
        return folder

    return write


def test_the_expected_layout(data_set):
    content = array()
    content[2, 0, 7] = 0  # no position and no flag
    content[2, 0, 8, :2] = np.nan
    found, readings = read_common_murre(data_set(content))
    assert found.keypoints_px.shape == (N, T, K, 2)
    known = (content[..., 2] > 0) & ~np.isnan(content[..., 0])
    np.testing.assert_array_equal(found.confidence, known.swapaxes(0, 1))
    expected = np.where(known[..., None], content[..., :2], 0).swapaxes(0, 1)
    np.testing.assert_array_equal(found.keypoints_px, expected)
    assert not found.present[2, 3]
    assert found.present.sum() == N * T - 1
    points = expected[0, 2][known[2, 0]]
    np.testing.assert_array_equal(found.box_px[0, 2], [*points.min(0), *np.ptp(points, axis=0)])
    assert found.masks == {}
    assert found.file_name[:2].tolist() == ["images/img1.png", "images/img2.png"]
    assert found.file_name[-1] == "images/img12.png"
    assert found.keypoint_names[0] == "keypoint_00"
    assert found.skeleton == ()
    assert readings["axes"].startswith(f"frames, birds: ({T}, {N}, 20, 3), inferred from the {T} images")
    assert readings["third number"].startswith("a flag")
    assert readings["position"].startswith("x, y in pixels of 64×40 (0.0% outside; y, x would not fit")
    # by hand: 12 + 20 flags, of which none lacks a position; one keypoint of zeros, one NaN that is flagged
    assert readings["missing"].startswith("34 of 720: third number 0 (33, 32 of them with a position)")
    assert readings["missing"].endswith("(1 more)")
    assert "not published" in readings["names"]
    assert "not the bird" in readings["boxes"]


def test_birds_first(data_set):
    content = array()
    found, readings = read_common_murre(data_set(content.swapaxes(0, 1)))
    np.testing.assert_array_equal(found.keypoints_px[1, 5, 3], content[5, 1, 3, :2])
    assert readings["axes"].startswith(f"birds, frames: ({N}, {T}, 20, 3)")


def test_shares_of_the_picture(data_set):
    found, readings = read_common_murre(data_set(array(positions() / [WIDTH, HEIGHT])))
    np.testing.assert_allclose(found.keypoints_px[0, 5], positions()[5, 0], rtol=1e-6)
    assert readings["position"].startswith("x, y as fractions of 64×40")


def test_y_before_x(data_set):
    found, readings = read_common_murre(data_set(array(positions()[..., ::-1])))
    np.testing.assert_array_equal(found.keypoints_px[0, 5], positions()[5, 0])
    assert readings["position"].startswith("y, x in pixels")


def test_an_order_that_cannot_be_told_is_called_assumed(data_set):
    """All keypoints in the square that both readings share."""
    found, readings = read_common_murre(data_set(array(np.minimum(positions(), HEIGHT))))
    assert found.keypoints_px.max() == HEIGHT
    assert "x first is assumed; y, x would fit too" in readings["position"]


@pytest.mark.parametrize(
    ("change", "reading", "expected"),
    [
        (lambda third: 2 * third, "COCO's visibility", 1),
        (lambda third: np.where(np.arange(K) == 2, 1, 2) * third, "COCO's visibility", 1),
        (lambda third: 0.25 * third, "a confidence, 0 to 0.25", 0.25),
        (lambda third: np.where(third == 0, np.nan, third), "a flag", 1),
    ],
)
def test_third_numbers(data_set, change, reading, expected):
    found, readings = read_common_murre(data_set(array(third=change(flags()))))
    assert readings["third number"].startswith(reading)
    np.testing.assert_array_equal(found.confidence, expected * flags().swapaxes(0, 1))
    hidden = change(flags()).swapaxes(0, 1) == 1
    np.testing.assert_array_equal(found.occluded, hidden if reading.startswith("COCO") else False & hidden)


def spoilt(**changes):
    content = array()
    for at, value in changes.values():
        content[at] = value
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (array()[:, :, :18], r"its shape \(12, 3, 18, 3\) is not \(frames, birds, 20, 3\) or"),
        (np.tile(array()[:, :1], (1, T, 1, 1)), r"its shape \(12, 12, 20, 3\) is not"),
        (array()[:10], r"its shape \(10, 3, 20, 3\) is not .* with 12 images"),
        (array() > 0, "it holds bool, not numbers"),
        (array(third=0 * flags()), "no visible keypoint"),
        (array(third=3 * flags()), "third numbers of 0 to 3 are neither flags of 0, 1, 2 nor fractions"),
        (array(xy=0 * positions()), "it holds no keypoint with a position"),
        (spoilt(x=((3, 1, 2, 0), np.nan)), "only one of two coordinates"),
        (spoilt(x=((3, 1, 2, 0), 1e300)), "keypoints_px must be finite|is no position"),
        (array(xy=10 * positions()), r"neither pixels of the images of 64×40 nor fractions"),
    ],
)
def test_what_no_reading_explains_is_refused(data_set, content, message):
    with pytest.raises(InputError, match=rf"annotations\.npy: .*{message}"):
        read_common_murre(data_set(content))


def test_a_few_keypoints_may_lie_outside(data_set):
    xy = positions()
    xy[:, 0, 0] = [WIDTH + 5, -2]  # 12 of 688
    found, readings = read_common_murre(data_set(array(xy)))
    assert (found.keypoints_px[0, :, 0] == [WIDTH + 5, -2]).all()
    assert "1.7% outside" in readings["position"]


def test_images_that_are_missing_or_broken(data_set):
    folder = data_set(array())
    (folder / "images" / "img7.png").write_bytes(b"none")
    with pytest.raises(InputError, match=r"img7\.png: cannot be read"):
        read_common_murre(folder)
    for file in (folder / "images").iterdir():
        file.unlink()
    with pytest.raises(InputError, match="images: has no images"):
        read_common_murre(folder)


def test_the_command(data_set, tmp_path, capsys):
    folder, out = data_set(array()), tmp_path / "murres.json"
    command = ["dataset", "murre", str(folder), "--out", str(out)]
    assert main(command) == 0
    said = capsys.readouterr().out
    for words in ("inferred, not published", "frames, birds", "a flag", "3 tracks, 12 frames", "CC-BY-NC-4.0"):
        assert words in said
    back = read_coco(out)
    np.testing.assert_array_equal(back.keypoints_px, read_common_murre(folder).observations.keypoints_px)
    info = json.loads(out.read_text())["info"]
    assert info["license"] == "CC-BY-NC-4.0"
    assert "inferred, not published" in info["description"]
    assert "third number: a flag" in info["description"]
    rejected(capsys, command, "murres.json", "exists already", "--overwrite")
    assert main([*command, "--overwrite", "--keypoints", "murre"]) == 0
    assert read_coco(out).keypoint_names == MURRE_KEYPOINTS
    assert "as given" in capsys.readouterr().out
    mine = [f"p{k}" for k in range(K)]
    assert main([*command, "--overwrite", "--keypoints", ",".join(mine)]) == 0
    assert read_coco(out).keypoint_names == tuple(mine)
    for names in (mine[:19], [*mine[:19], "p0"], [*mine[:19], ""]):
        rejected(capsys, [*command, "--overwrite", "--keypoints", ",".join(names)], "names of keypoints", "give 20")
