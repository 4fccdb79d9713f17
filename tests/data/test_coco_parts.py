"""The binary copy of a long COCO file: equal to the file, used only while it belongs to the file, read lazily."""

import json

import numpy as np
import pytest
from support.observations import assert_same

from jaxfit.data.formats import coco_parts
from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.data.formats.coco_parts import parts_folder
from jaxfit.data.masks import LazyMasks, encode_mask
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.unfinished import Parts

N, T, K = 3, 8, 4
SIZE = (30, 20)


@pytest.fixture(autouse=True)
def short_parts(monkeypatch):
    monkeypatch.setattr(coco_parts, "PARTS_FROM", 1)
    monkeypatch.setattr(coco_parts, "_FRAMES", 3)


def observed(seed=0, **changes):
    """Birds with ids in no order; one bird is never there; some masks, scores and time stamps are missing."""
    rng = np.random.default_rng(seed)
    present = rng.random((N, T)) < 0.7
    present[1], present[:, 4] = False, False
    confidence = np.where(present[..., None], rng.random((N, T, K)) * (rng.random((N, T, K)) < 0.8), 0)
    box = np.where(present[..., None], rng.random((N, T, 4)) * 5 + 1, 0)
    masks = {
        (n, t): encode_mask(rng.random(SIZE[::-1]) < 0.3)
        for n, t in np.argwhere(present & (rng.random((N, T)) < 0.8)).tolist()
    }
    values = {
        "track_id": np.array([9, 4, 2]),
        "frame_index": np.arange(T) * 2 + 5,
        "present": present,
        "keypoints_px": rng.random((N, T, K, 2)) * 20,
        "confidence": confidence,
        "box_px": box,
        "image_size_px": np.tile(SIZE, (T, 1)),
        "file_name": np.array([f"{'film' * (t % 3)}.mp4#{t}" for t in range(T)]),
        "keypoint_names": ("a", "b", "c", "d"),
        "skeleton": ((0, 1), (2, 3)),
        "masks": masks,
        "amodal_masks": {(0, t): encode_mask(np.ones(SIZE[::-1])) for t in np.flatnonzero(present[0]).tolist()},
        "occluded": rng.random((N, T, K)) < 0.3,
        "score": np.where(present, 0.75, 0),
        "timestamp_s": np.where(np.arange(T) == 3, np.nan, np.arange(T) / 12.5),
        "fps": 12.5,
    }
    return Observations(**(values | changes))


@pytest.fixture
def path(tmp_path):
    write_coco(observed(), tmp_path / "birds.json")
    return tmp_path / "birds.json"


def read_both(path):
    """Return the observations of the copy and of the COCO file."""
    copy = read_coco(path)
    aside = parts_folder(path).rename(path.with_name("aside"))
    plain = read_coco(path)
    aside.rename(parts_folder(path))
    return copy, plain


@pytest.mark.parametrize("changes", [{}, {"masks": {}}, {"amodal_masks": {}, "fps": None, "skeleton": ()}])
def test_the_copy_equals_the_file(tmp_path, changes):
    path = tmp_path / "birds.json"
    write_coco(observed(**changes), path)
    copy, plain = read_both(path)
    assert len(list(parts_folder(path).glob("*.npz"))) == 3
    assert isinstance(copy.amodal_masks or copy.masks, LazyMasks)
    assert_same(copy, plain)
    assert {cell: (rle["size"], rle["counts"]) for cell, rle in copy.masks.items()} == {
        cell: (rle["size"], rle["counts"]) for cell, rle in plain.masks.items()
    }


def test_selected_tracks_and_frames_keep_their_masks_unread(path, monkeypatch):
    copy, plain = read_both(path)
    monkeypatch.setattr(Parts, "load", None)  # a mask that is read now is an error
    chosen = copy.select([1, 0], [0, 3, 5, 7]).select(None, [1, 2, 3])
    assert (0, 99) not in chosen.masks
    assert (0, -1) not in chosen.masks
    monkeypatch.undo()
    assert_same(chosen, plain.select([1, 0], [0, 3, 5, 7]).select(None, [1, 2, 3]))
    assert copy.mask(-1, -1) is None or (copy.mask(-1, -1) == plain.mask(-1, -1)).all()


def test_a_changed_file_is_read_itself(path):
    text = json.loads(path.read_text())
    text["annotations"][0]["score"] = 0.25
    path.write_text(json.dumps(text))
    changed = read_coco(path)
    assert 0.25 in changed.score
    write_coco(observed(1), path)  # replaces the copy
    assert_same(*read_both(path))
    assert isinstance(read_coco(path).masks, LazyMasks)


def test_short_files_and_photographs_have_no_copy(tmp_path, monkeypatch):
    own = {(0, int(np.flatnonzero(observed().present[0])[0])): ("own.png", *SIZE)}
    write_coco(observed(own_images=own), tmp_path / "photographs.json")
    monkeypatch.setattr(coco_parts, "PARTS_FROM", 10_000)
    write_coco(observed(), tmp_path / "short.json")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["photographs.json", "short.json"]


def test_a_folder_of_another_program_is_left_alone(tmp_path):
    other = tmp_path / "birds.parts"
    other.mkdir()
    (other / "record.json").write_text("{}")
    write_coco(observed(), tmp_path / "birds.json")
    assert [file.name for file in other.iterdir()] == ["record.json"]
    assert len(read_coco(tmp_path / "birds.json").masks)


def all_values(path):
    """Read everything, as a fit does."""
    copy = read_coco(path)
    return [rle["counts"] for masks in (copy.masks, copy.amodal_masks) for rle in masks.values()]


def test_every_damage_is_one_error_with_a_remedy(path):
    """A flipped bit anywhere in a part is found, or changes nothing; a truncated or missing part is named."""
    expected = all_values(path)
    part = parts_folder(path) / "000001.npz"
    whole = part.read_bytes()
    rng, errors = np.random.default_rng(0), []
    for at in rng.choice(len(whole), 60, replace=False):
        flipped = bytearray(whole)
        flipped[at] ^= 1 << int(rng.integers(8))
        part.write_bytes(flipped)
        try:
            assert all_values(path) == expected
        except InputError as error:
            errors.append(str(error))
    assert len(errors) > 40
    assert not [text for text in errors if "birds.parts" not in text or "(remove this .parts folder" not in text]
    for content in (whole[:-40], whole[: len(whole) // 2], b""):
        part.write_bytes(content)
        with pytest.raises(InputError, match=r"000001\.npz: .*\.parts folder; jaxfit then reads the COCO file"):
            all_values(path)
    part.unlink()
    with pytest.raises(InputError, match=r"birds\.parts: lacks parts: it holds 2 of 3 .*remove this \.parts folder"):
        read_coco(path)


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        ("track", lambda values: values + 7, "holds tracks or frames that do not exist"),
        ("frame", lambda values: values - 9, "holds tracks or frames that do not exist"),
        ("confidence", lambda values: values + 2, "confidence must lie in"),
        ("masks", lambda values: values + 1, "masks.counts is corrupt"),
        ("masks", lambda values: np.full_like(values, 200), "masks.counts is corrupt"),
        ("masks_length", lambda values: values * 3, "masks.counts is corrupt"),
        ("keypoints_px", lambda values: values[:-1], "D"),
    ],
)
def test_hostile_values_are_rejected(path, name, change, problem):
    part = parts_folder(path) / "000000.npz"
    with np.load(part) as file:
        arrays = dict(file)
    arrays[name] = change(arrays[name])
    np.savez(part, **arrays)
    with pytest.raises(InputError, match=problem):
        all_values(path)
