"""Masks of pictures and COCO files go to the birds whose keypoints they cover."""

import json
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
from support.tracking_files import T, write_csv

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.mask_files import add_masks, mask_observations
from jaxfit.data.formats.recognise import read_observations
from jaxfit.foundation.errors import InputError

SIZE = (120, 100)


@pytest.fixture
def birds(tmp_path):
    """Two birds, the first in the left half of the image, the second in the right half."""
    path = write_csv(tmp_path / "a.csv", ("b1", "b2"), ("x", "y"))
    observed = read_observations(path, size_px=SIZE)
    x = np.array([10, 70])[:, None, None] + observed.keypoints_px[..., 0] * 0.3
    return observed.with_keypoints(np.stack([x, observed.keypoints_px[..., 1]], -1), observed.confidence)


def halves(left, right):
    picture = np.zeros((100, 120), np.uint8)
    picture[:, 5:45], picture[:, 65:110] = left, right
    return picture


@pytest.mark.parametrize(("left", "right", "suffix"), [(7, 3, "png"), (255, 255, "png"), (255, 255, "jpg")])
def test_pictures(tmp_path, birds, left, right, suffix):
    """Pictures hold one grey value per bird, or one value for all birds."""
    folder = tmp_path / "masks"
    folder.mkdir()
    for t in range(T - 1):
        cv2.imwrite(str(folder / f"mask_{t:04d}.{suffix}"), halves(left, right))
    masked = add_masks(birds, folder)
    assert masked.masks.keys() == {(n, t) for n in range(2) for t in range(T - 1)}
    np.testing.assert_array_equal(masked.mask(0, 0), halves(1, 0) > 0)
    np.testing.assert_array_equal(masked.mask(1, 2), halves(0, 1) > 0)
    write_coco(masked, tmp_path / "masks.json")
    content = json.loads((tmp_path / "masks.json").read_text())
    content["categories"] = [{"id": 1, "name": "bird"}]  # a file of masks needs no keypoints
    kept = ("id", "image_id", "segmentation")
    content["annotations"] = [{k: a[k] for k in kept if k in a} for a in content["annotations"]]
    (tmp_path / "masks.json").write_text(json.dumps(content))
    again = add_masks(birds, tmp_path / "masks.json")
    assert again.masks == masked.masks


def test_masks_with_the_names_of_the_pictures_belong_to_them(tmp_path, birds):
    """In a folder, frame 0 is the first picture, here frame_0001.png."""
    video, folder = tmp_path / "frames", tmp_path / "masks"
    video.mkdir()
    folder.mkdir()
    for t in range(T):
        cv2.imwrite(str(video / f"frame_{t + 1:04d}.png"), halves(0, 0))
        cv2.imwrite(str(folder / f"frame_{t + 1:04d}.png"), halves(7, 3 if t else 0))
    masked = add_masks(birds, folder, video=video)
    assert masked.masks.keys() == {(n, t) for n in range(2) for t in range(T)} - {(1, 0)}
    names = np.array([f"frame_{t + 1:04d}.png" for t in range(T)])
    numbered = replace(masked, file_name=names, frame_index=np.arange(1, T + 1))
    for suffix in ("png", "jpg"):  # COCO masks of other pictures with these names
        changed = replace(numbered, file_name=np.array([name.replace("png", suffix) for name in names]))
        write_coco(changed, tmp_path / "masks.json")
        assert add_masks(birds, tmp_path / "masks.json", video=video).masks.keys() == masked.masks.keys()
    # labels that name the pictures keep their numbers, whatever the positions in the folder, also of another type
    for suffix in ("png", "jpg"):
        named = replace(numbered, masks={}, file_name=np.array([name.replace("png", suffix) for name in names]))
        assert add_masks(named, folder, video=video).masks.keys() == masked.masks.keys()
    # frames of a video have its name and their number
    frames = replace(numbered, file_name=np.array([f"film.mp4#{t}" for t in range(T)]))
    write_coco(frames, tmp_path / "masks.json")
    assert add_masks(replace(frames, masks={}), tmp_path / "masks.json").masks == masked.masks
    cv2.imwrite(str(folder / "other.png"), halves(7, 3))
    assert add_masks(birds, folder, video=video).masks.keys() == masked.masks.keys()


def test_masks_without_numbers_of_their_own_are_in_order(tmp_path, birds):
    folder = tmp_path / "masks"
    folder.mkdir()
    later = replace(birds, frame_index=1 + 4 * np.arange(T))
    for t in range(T):
        cv2.imwrite(str(folder / f"img{1 + 4 * t:04d}_mask0.png"), halves(7, 3))
    assert add_masks(later, folder).masks.keys() == {(n, t) for n in range(2) for t in range(T)}
    (folder / "img0001_mask0.png").unlink()
    with pytest.raises(InputError, match="without frame numbers of their own"):
        add_masks(later, folder)


def test_masks_that_cover_no_bird_are_not_used(tmp_path, birds):
    (tmp_path / "m").mkdir()
    for t in range(T):
        cv2.imwrite(str(tmp_path / "m" / f"{t}.png"), halves(0, 9) if t else np.zeros((100, 120), np.uint8))
    notes = []

    @contextmanager
    def progress(_name, _total):
        yield lambda _done, note: notes.append(note)

    assert add_masks(birds, tmp_path / "m", progress).masks.keys() == {(1, t) for t in range(1, T)}
    assert notes[-1] == "3 of 8 labelled birds have a mask"


@pytest.mark.parametrize(("outside_px", "found"), [(1, True), (12, False)])
def test_keypoints_on_the_outline_belong_to_the_mask(tmp_path, outside_px, found):
    """Bill and tail lie on the outline, so a mask that is a little too small covers none of them."""
    path = write_csv(tmp_path / "a.csv", ("b1", "b2"), ("x", "y"))
    observed = read_observations(path, size_px=SIZE).select(tracks=[0])
    points = np.array([[30, 10 - outside_px], [30, 90 + outside_px], [10 - outside_px, 50]]) - 0.5
    observed = observed.with_keypoints(np.broadcast_to(points, (1, T, 3, 2)), observed.confidence)
    mask = np.zeros((100, 120), np.uint8)
    mask[10:90, 10:50] = 255
    cv2.imwrite(str(tmp_path / "0.png"), mask)
    assert bool(add_masks(observed, tmp_path).masks) == found


@pytest.mark.parametrize(
    ("name", "picture", "message"),
    [
        ("0.png", np.ones((50, 60), np.uint8), "has masks of 60×50, but the image is 120×100"),
        ("900.png", halves(1, 2), "holds no mask for any image"),
        ("0.png", np.tile([0, 255], (100, 60)).astype(np.uint8) * np.tile([[1], [0]], (50, 120)).astype(np.uint8),
         "holds 3,000 connected regions, more than 100"),
    ],
)  # fmt: skip
def test_unusable_masks(tmp_path, birds, name, picture, message):
    (tmp_path / "m").mkdir()
    cv2.imwrite(str(tmp_path / "m" / name), picture)
    with pytest.raises(InputError, match=message):
        add_masks(birds, tmp_path / "m")


def test_every_grey_value_of_a_folder_of_masks_is_a_bird(tmp_path):
    for frame, values in {12: (7, 3), 4: (7, 0)}.items():
        cv2.imwrite(str(tmp_path / f"mask_{frame}.png"), halves(*values))
    truth = mask_observations(tmp_path)
    assert truth.track_id.tolist() == [3, 7]
    assert truth.frame_index.tolist() == [4, 12]
    assert truth.present.tolist() == [[False, True], [True, True]]
    np.testing.assert_array_equal(truth.mask(1, 0), halves(1, 0) > 0)
    np.testing.assert_array_equal(truth.mask(0, 1), halves(0, 1) > 0)
    assert truth.box_px[1, 0].tolist() == [5, 0, 40, 100]
    assert truth.keypoint_names == ()


def test_a_folder_of_empty_masks_is_rejected(tmp_path):
    cv2.imwrite(str(tmp_path / "1.png"), halves(0, 0))
    with pytest.raises(InputError, match="holds no mask"):
        mask_observations(tmp_path)
