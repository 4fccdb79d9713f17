"""`suggest`: from a video, or a result of a video, to the folder of suggested frames."""

import csv
import dataclasses

import cv2
import numpy as np
import pytest
from support.cli_files import rejected
from support.toy_footage import BIRD, BIRDS, FRAMES, SIDE, Footage, TrueKeypoints, TrueSegmenter

from jaxfit.cli.main import main
from jaxfit.config.perception import FramesConfig, TrackConfig
from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.data.formats.recognise import read_observations
from jaxfit.foundation.errors import InputError
from jaxfit.perception.track import track_video
from jaxfit.review.suggest import suggest

CONFIG = TrackConfig(min_track_frames=3)


class Film(Footage):
    """Three ellipses that turn, with keypoints inside: footage that needs no model."""

    def __init__(self):
        self.masks, K = [[] for _ in range(FRAMES)], BIRD.num_keypoints
        self.keypoints_px = np.zeros((FRAMES, BIRDS, K, 2))
        for t, n in np.ndindex(FRAMES, BIRDS):
            mask, angle = np.zeros((SIDE, SIDE), np.uint8), 6 * t + 50 * n
            cv2.ellipse(mask, (SIDE // 2, SIDE // 2), (25, 12), angle, 0, 360, 1, -1)
            self.masks[t].append(mask.astype(bool))
            along = np.linspace(-20, 20, K)[:, None] * [np.cos(np.radians(angle)), np.sin(np.radians(angle))]
            self.keypoints_px[t, n] = along + SIDE / 2 + [SIDE * n, 0]


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """The toy footage as pictures, and its tracks with one uncertain frame."""
    film, folder = Film(), tmp_path_factory.mktemp("footage")
    video = film.write(folder / "ledge 7")
    networks = {"segmenter": TrueSegmenter(film), "keypoints": TrueKeypoints(film)}
    tracks = track_video(video, CONFIG, **networks)
    confidence = tracks.confidence.copy()
    confidence[:, 8] = 0.1
    write_coco(tracks.with_keypoints(tracks.keypoints_px, confidence), folder / "birds.json")
    return film, video, folder / "birds.json"


def test_labels_of_a_video(footage, tmp_path):
    """The birds are tracked, and every format holds the labels of the chosen frames."""
    film, video, _ = footage
    networks = {"segmenter": TrueSegmenter(film), "keypoints": TrueKeypoints(film)}
    done = suggest(video, tmp_path / "label", 5, config=CONFIG, **networks)
    numbers = [frame.frame_index for frame in done.frames]
    assert len(set(numbers)) == 5
    assert numbers == sorted(numbers) == done.observations.frame_index.tolist()
    truth = np.moveaxis(film.keypoints_px[numbers], 0, 1)
    (deeplabcut,) = (tmp_path / "label" / "deeplabcut" / "labeled-data").iterdir()
    assert deeplabcut.name == "ledge_7"
    files = ["coco.json", "cvat.json", "label_studio.json", "labels.slp"]
    for path in [*(tmp_path / "label" / name for name in files), *sorted(deeplabcut.glob("CollectedData_jaxfit.*"))]:
        seen = read_observations(path)
        assert seen.frame_index.tolist() == numbers, path
        assert seen.image_size_px[0].tolist() == [BIRDS * SIDE, SIDE]
        np.testing.assert_allclose(np.sort(seen.keypoints_px, axis=0), np.sort(truth, axis=0), atol=1e-3)
    pictures = sorted((tmp_path / "label" / "images").iterdir())
    assert [path.name for path in pictures] == [f"ledge_7_{number:06d}.png" for number in numbers]
    for path, number in zip(pictures, numbers, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(path)), film.frame(number))
        assert (deeplabcut / path.name).samefile(path)
    rows = list(csv.DictReader((tmp_path / "label" / "suggested.csv").open()))
    assert [int(row["frame"]) for row in rows] == numbers
    assert [row["picture"] for row in rows] == [path.name for path in pictures]


def test_an_uncertain_frame_of_a_result(footage, tmp_path):
    """The networks do not track again, and the frame with low confidence is chosen."""
    film, video, birds = footage
    keypoints = TrueKeypoints(film)
    config = dataclasses.replace(CONFIG, frames=FramesConfig(start=1, step=1))
    done = suggest(video, tmp_path / "label", 2, birds, config, keypoints=keypoints)
    chosen = {frame.frame_index: frame for frame in done.frames}
    assert chosen[8].reason == "low confidence"
    assert len(keypoints.counts) <= 4 * 2  # mirror images of the shortlist only
    again = suggest(video, tmp_path / "again", 2, birds, config, keypoints=TrueKeypoints(film))
    assert again.frames == done.frames


def test_without_birds_variety_decides(footage, tmp_path, caplog):
    """The labels are empty, the frames lie apart, and a line says so."""
    film, video, _ = footage
    missed = [(t, n) for t in range(FRAMES) for n in range(BIRDS)]
    done = suggest(video, tmp_path / "label", 3, None, CONFIG, TrueSegmenter(film, missed), TrueKeypoints(film))
    assert "chosen by variety alone" in caplog.text
    assert np.diff(done.observations.frame_index).min() >= 2
    assert {frame.reason for frame in done.frames} == {"variety"}
    assert read_coco(tmp_path / "label" / "coco.json").num_tracks == 0


def test_a_teacher_decides_by_its_disagreement(footage, tmp_path):
    """The teacher misses birds in two frames, and these frames are suggested, without a run of the keypoint network."""
    film, video, birds = footage
    keypoints, teacher = TrueKeypoints(film), TrueSegmenter(film, [(3, 0), (9, 1), (9, 2)])
    done = suggest(video, tmp_path / "label", 2, birds, CONFIG, keypoints=keypoints, teacher=teacher)
    assert [(frame.frame_index, frame.reason) for frame in done.frames] == [(3, "teacher"), (9, "teacher")]
    assert done.frames[1].score > done.frames[0].score
    assert not keypoints.counts


def other_size(observations):
    return dataclasses.replace(observations, image_size_px=np.tile([64, 64], (FRAMES, 1)), masks={})


def later_frames(observations):
    return dataclasses.replace(observations, frame_index=np.arange(FRAMES) + 5)


def test_empty_labels(footage, tmp_path, capsys):
    """Labels of a network that does not know the footage can be left out; the header has the names of the keypoints."""
    _, video, birds = footage
    command = ["suggest", str(video), "--result", str(birds), "--count", "3", "--empty", "--out", str(tmp_path / "a")]
    assert main(command) == 0
    assert f"name {', '.join(BIRD.keypoint_names)}; if your keypoints" in " ".join(capsys.readouterr().out.split())
    done = suggest(video, tmp_path / "label", 4, birds, CONFIG, empty=True)
    (table,) = (tmp_path / "label").glob("deeplabcut/labeled-data/*/CollectedData_jaxfit.csv")
    _, individuals, names, *_, row = csv.reader(table.open())
    assert individuals[3:] == ["bird1"] * 2 * BIRD.num_keypoints
    assert names[3::2] == list(BIRD.keypoint_names)
    assert set(row[3:]) == {""}
    assert all(frame.birds for frame in done.frames)
    assert not done.observations.num_tracks
    assert len(read_coco(tmp_path / "label" / "coco.json").frame_index) == 4


@pytest.mark.parametrize(
    ("change", "problem"), [(other_size, "says 64×64"), (later_frames, "has 12 frames, counted from 0")]
)
def test_the_result_of_another_video(footage, tmp_path, change, problem):
    _, video, birds = footage
    write_coco(change(read_coco(birds)), tmp_path / "other.json")
    with pytest.raises(InputError, match=problem):
        suggest(video, tmp_path / "label", 2, tmp_path / "other.json", CONFIG)
    assert not (tmp_path / "label").exists()


def test_the_command(footage, tmp_path, capsys, caplog):
    """A table names the frames. Bad options, and a folder with other files, are rejected in one line."""
    _, video, birds = footage
    command = ["suggest", str(video), "--result", str(birds), "--count", "3"]
    out = ["--out", str(tmp_path / "label")]
    assert main([*command, *out]) == 0
    printed = capsys.readouterr().out
    assert "3 frames with 9 birds" in printed
    assert BIRD.keypoint_names != read_coco(birds).keypoint_names or "mirror images are not compared" in caplog.text
    rejected(capsys, [*command, *out], "holds results already", "--overwrite")
    assert main([*command, *out, "--overwrite"]) == 0
    rejected(capsys, [*command[:-1], "13", "--out", str(tmp_path / "a")], "has 12 frames", "--count 13")
    rejected(capsys, [*command[:-1], "0", "--out", str(tmp_path / "a")], "--count: is 0")
    rejected(capsys, [*command, "--start", "11", "--out", str(tmp_path / "a")], "has 1 frames")
    rejected(capsys, [*command, "--out", str(video)], "holds the video")
    rejected(capsys, [*command, "--out", str(video / "label")], "lies among the video's images")
    rejected(capsys, ["suggest", str(tmp_path / "none.mp4"), "--out", str(tmp_path / "a")], "does not exist")
    assert not (tmp_path / "a").exists()
