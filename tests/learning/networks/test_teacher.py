"""Labels by a teacher: tracked masks and unknown pixels of a toy film, doubtful teachers and labels."""

import cv2
import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from support.cli_files import rejected

from jaxfit.data.masks import decode_mask
from jaxfit.foundation.errors import InputError
from jaxfit.learning.networks import fine_tune, teacher
from jaxfit.learning.networks.label_data import LabelFiles, Scale, prepare_data, prepare_frames
from jaxfit.learning.networks.labelled_frames import UNKNOWN_OWNER
from jaxfit.learning.networks.labels import LabelledPicture, StoredPicture, mask_bird
from jaxfit.learning.networks.segmenter import _targets
from jaxfit.learning.networks.teacher import read_film, teach, track_labels
from jaxfit.perception.keypoints import CropSettings
from jaxfit.perception.network import instance_of

SIZE = 160, 120
FRAMES = 30
SIDE = 24


def place(t):
    """Return the corner of the bird, which moves by 3 pixels in a frame."""
    return 10 + 3 * t, 40 + t


def true_mask(t):
    mask = np.zeros(SIZE[::-1], bool)
    x, y = place(t)
    mask[y : y + SIDE, x : x + SIDE] = True
    return mask


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film of a bright square bird with texture on a ground with texture; the corner shows the frame number."""
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(20, 90, (30, 40, 3)).astype(np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    bird = cv2.resize(rng.integers(180, 250, (6, 6, 3)).astype(np.uint8), (SIDE, SIDE), interpolation=cv2.INTER_CUBIC)
    folder = tmp_path_factory.mktemp("film") / "frames"
    folder.mkdir()
    for t in range(FRAMES):
        picture = ground.copy()
        x, y = place(t)
        picture[y : y + SIDE, x : x + SIDE] = bird
        cv2.imwrite(str(folder / f"{t:03d}.png"), picture)
    return folder


class Bright:
    """A teacher that detects bright squares, except in some frames, which it recognises by the place of the bird."""

    class_names = ("bird",)

    def __init__(self, missed=()):
        self.missed = {place(t)[0] for t in missed}

    def __call__(self, frame):
        bright = cv2.morphologyEx((frame.min(-1) > 150).astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5)))
        bird = instance_of(bright.astype(bool), 0.9, "bird")
        return [] if bird is None or bird.x0 in self.missed else [bird]


class Fixed:
    """A teacher that is wrong throughout: the same rectangle in every picture."""

    class_names = ("bird",)

    def __call__(self, frame):
        mask = np.zeros(frame.shape[:2], bool)
        mask[:20, :50] = True
        return [instance_of(mask, 0.9, "bird")]


def iou(first, second):
    return (first & second).sum() / (first | second).sum()


def labelled(film, times, mask=true_mask):
    return [
        StoredPicture(LabelledPicture(film, f"{t:03d}.png", t, SIZE, (mask_bird(1, mask(t)),)), film) for t in times
    ]


def test_labels_of_a_teacher_are_the_birds(film, tmp_path):
    taught = teach(film, Bright(), tmp_path)
    assert taught.confirmed == taught.detected == teacher.SEEDS
    assert [picture.labels.frame for picture in taught.pictures] == list(range(FRAMES))  # 24 frames, and 6 tracked
    for picture in taught.pictures:
        (bird,) = picture.labels.birds
        assert iou(decode_mask(bird.mask), true_mask(picture.labels.frame)) > 0.85
        assert (picture.pixels()[..., 0] > 150).sum() == pytest.approx(SIDE**2, abs=20)


def test_masks_are_tracked_to_frames_that_the_teacher_misses(film, tmp_path):
    """The frames 0 to 9 have labels; from frame 12 on, the teacher misses every second frame."""
    taught = track_labels(labelled(film, range(0, 10, 3)), {film: film}, Bright(range(12, 30, 2)), tmp_path)
    frames = [picture.labels.frame for picture in taught.pictures]
    assert sorted(frames) == [1, 2, 4, 5, 7, 8, 10, 11, *range(13, FRAMES, 2)]
    assert not taught.wrong
    for picture in taught.pictures:
        assert iou(decode_mask(picture.labels.birds[0].mask), true_mask(picture.labels.frame)) > 0.9


def test_wrong_labels_are_found_by_the_other_labels(film, tmp_path):
    def mask(t):
        return np.roll(true_mask(t), -40, axis=0) if t in (6, 18) else true_mask(t)

    tracked = track_labels(labelled(film, range(0, 28, 3), mask), {film: film}, Bright(), tmp_path)
    assert [label.frame for label in tracked.wrong] == [6, 18]
    assert "confirms: 8; does not confirm: 2" in tracked.sentence()
    assert "006.png 0.00, 018.png 0.00" in tracked.sentence()


def test_nothing_is_tracked_by_a_teacher_that_does_not_know_the_labels(film, tmp_path):
    tracked = track_labels(labelled(film, range(0, 28, 3)), {film: film}, Fixed(), tmp_path)
    assert not tracked.pictures
    assert not tracked.wrong
    assert "confirms: 0; does not confirm: 6" in tracked.sentence()
    assert len(tracked.doubtful) == 6  # more than half of the 10 labels


@pytest.mark.parametrize(
    ("wrong", "problem"), [(Fixed(), "a second run on the smaller mirror"), (Bright(range(FRAMES)), "detects no bird")]
)
def test_no_labels_of_a_wrong_teacher_or_without_birds(film, tmp_path, wrong, problem):
    with pytest.raises(InputError, match=problem):
        teach(film, wrong, tmp_path)


def test_only_frames_near_the_labels_are_read(film, tmp_path, monkeypatch):
    monkeypatch.setattr(teacher, "FLOW_FRAMES", 8)
    monkeypatch.setattr(teacher, "EXAMINED", 4)
    read = read_film(film, [10, 20], tmp_path)
    assert list(read.grey) == [8, 9, 10, 11, 12, 18, 19, 20, 21, 22]
    assert list(read.files) == [9, 10, 12, 19, 20, 22]


def test_unknown_pixels_do_not_count(film, tmp_path):
    hidden = np.roll(true_mask(3), 40, axis=1)
    picture = read_film(film, [3], tmp_path).stored(3, [true_mask(3)], hidden)
    frames = prepare_frames(
        tmp_path / "frames", [picture], ("centre",), Scale(SIDE, 160, CropSettings(2, 2)), "segmenter"
    )
    assert np.array_equal(np.asarray(frames.owner[0]) == UNKNOWN_OWNER, hidden)
    _, weight, centre, _, offset_weight = _targets(np.pad(frames.owner[0], ((0, 200), (0, 160))))
    assert (weight[0][np.pad(hidden, ((0, 200), (0, 160)))[::2, ::2]] == 0).all()
    assert weight.astype(bool).sum() == weight.size - hidden[::2, ::2].sum()
    assert (offset_weight > 0).sum() == true_mask(3)[::2, ::2].sum()
    assert np.unravel_index(centre[0].argmax(), centre[0].shape) == pytest.approx((55 / 2, 31 / 2), abs=1)


def test_training_data_with_tracked_frames(film, tmp_path):
    """Tracked frames are training data; a fifth of them, and those among the held-out labels, are not."""
    masks = tmp_path / "masks"
    masks.mkdir()
    for t in range(0, 20, 2):
        cv2.imwrite(str(masks / f"{t:03d}.png"), true_mask(t).astype(np.uint8) * 255)
    files = LabelFiles((masks,), (film,))
    data = prepare_data("segmenter", files, 0.2, None, tmp_path / "training", teacher=Bright())
    held = [picture.labels.frame for picture in data.holdout]
    assert held == [16, 18]
    frames = {picture.labels.frame for picture in data.tracked}
    assert frames == {*range(1, 20, 2), *range(19, FRAMES)}
    tracked_holdout = {picture.labels.frame for picture in data.tracked_holdout}
    assert len(tracked_holdout) == 4
    assert len(data.frames.pictures) == len(data.split.training) + len(frames - {17} - tracked_holdout)
    assert "confirms: 10; other frames with tracked masks: 20" in data.teacher


@pytest.mark.parametrize(
    ("confirmed", "iou", "reasons"), [(20, 0.9, 1), (5, 0.9, 2), (5, 0.2, 3)], ids=["good", "unstable", "not learnt"]
)
def test_doubt(confirmed, iou, reasons):
    result = fine_tune.FineTuned({"trained": {"mean_iou": iou}}, "trained", [], {}, "", {}, 1, 1)
    doubt = fine_tune._doubt(teacher.Taught([], confirmed, 24), result)
    assert len(doubt.split("; ")) == reasons
    assert doubt.startswith("no label of a person")


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["segmenter", "--video", "film", "--labels", "a.json"], "--video: is given with labels"),
        (["keypoints", "--video", "film"], "--video: is given for keypoints"),
        (["segmenter", "--video", "film", "--teacher", "none"], "--teacher: is `none` without labels"),
        (["segmenter", "--teacher", "general"], "--teacher: is given without a film"),
        (["segmenter", "--video", "film"], "download"),
        (["segmenter", "--video", "film", "--teacher", "missing.onnx"], "missing.onnx"),
    ],
)
def test_wrong_use_is_one_line(arguments, problem, monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("JAXFIT_NETWORKS", str(tmp_path))
    rejected(capsys, ["train", *arguments, "--out", str(tmp_path / "n.onnx"), "--scenes", "0"], problem)
    assert not list(tmp_path.iterdir())


def test_photographs_are_no_film(film, tmp_path, caplog):
    """Pictures of several sizes cannot be tracked; a folder without other pictures has nothing to track."""
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for t in (3, 6):
        cv2.imwrite(str(photographs / f"{t:03d}.png"), cv2.imread(str(film / f"{t:03d}.png")))
    labels = [
        picture._replace(labels=picture.labels._replace(source=photographs)) for picture in labelled(film, (3, 6))
    ]
    assert track_labels(labels, {photographs: photographs}, Bright(), tmp_path / "one") == ([], [], 0, [])
    assert not caplog.text
    cv2.imwrite(str(photographs / "009.png"), np.zeros((8, 8, 3), np.uint8))
    assert track_labels(labels, {photographs: photographs}, Bright(), tmp_path / "two") == ([], [], 0, [])
    assert "no masks are tracked" in caplog.text
