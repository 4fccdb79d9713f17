"""Files and videos that do not belong together, sizes of images, and files of no known format."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import sleap_io
from PIL import ExifTags, Image
from support.coco_files import content, saved
from support.films import encode
from support.tracking_files import T, write_analysis, write_csv, write_project, write_table

from jaxfit.data.formats import recognise
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.keypoint_table import check_table_size
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.observations import reorder_keypoints
from jaxfit.foundation.errors import InputError
from jaxfit.video.reader import probe_video
from jaxfit.video.writer import VideoWriter


def film(path, frames=T, size=(120, 100)):
    with VideoWriter(path, size, 25) as writer:
        for i in range(frames):
            writer.write(np.full((size[1], size[0], 3), 10 * i, np.uint8))
    return path


def pictures(folder, names, size=(120, 100)):
    folder.mkdir()
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((size[1], size[0]), np.uint8))
    return folder


def test_size_of_a_video_beside_the_file(tmp_path):
    write = {"clipDLC_net.csv": write_csv, "clipDLC_net.h5": write_table, "x.h5": lambda p: write_analysis(p)}
    paths = [function(tmp_path / name) for name, function in write.items()]
    for path in paths:
        with pytest.raises(InputError, match=r"stores no image size.* \(give --video VIDEO, or --size"):
            read_observations(path)
    film(tmp_path / "clip.mp4")
    other = write_csv(tmp_path / "clip10DLC_net.csv")  # of another film than clip1.mp4
    film(tmp_path / "clip1.mp4")
    with pytest.raises(InputError, match="stores no image size"):
        read_observations(other)
    (tmp_path / "clip1.mp4").rename(tmp_path / "clip10DLC_net.csv.mp4")
    assert read_observations(other).image_size_px[0].tolist() == [120, 100]
    (tmp_path / "clip10DLC_net.csv.mp4").unlink()
    other.unlink()
    for path in paths:
        assert read_observations(path).image_size_px[0].tolist() == [120, 100]
        assert read_observations(path).file_name[1] == "clip.mp4#1"


def test_times_come_from_the_video(tmp_path):
    """The video has a variable frame rate and begins late."""
    ticks = [5, 9, 60, 64]
    encode(tmp_path / "clip.mkv", count=4, ticks=ticks)
    for path, size in ((write_csv(tmp_path / "clipDLC.csv"), None), (write_table(tmp_path / "clip.h5"), (128, 80))):
        observed = read_observations(path, size_px=size)
        np.testing.assert_allclose(observed.timestamp_s, np.array(ticks)[observed.frame_index] / 100, atol=1e-3)
        assert observed.fps == probe_video(tmp_path / "clip.mkv").fps
    write_coco(replace(observed, timestamp_s=None, fps=None), tmp_path / "birds.json")
    assert np.isnan(read_observations(tmp_path / "birds.json").timestamp_s).all()
    np.testing.assert_array_equal(
        read_observations(tmp_path / "birds.json", tmp_path / "clip.mkv").timestamp_s, observed.timestamp_s
    )


def test_a_video_that_does_not_fit(tmp_path):
    path = write_csv(tmp_path / "a.csv")
    with pytest.raises(InputError, match=r"keypoints for frame 3, but .* has 2 frames"):
        read_observations(path, film(tmp_path / "short.mp4", 2))
    with pytest.raises(InputError, match=r"keypoints outside images of 64×48, such as x .* in the size that was label"):
        read_observations(path, film(tmp_path / "small.mp4", size=(64, 48)))
    with pytest.raises(InputError, match=r"small.mp4: is 64×48, but birds.slp was made from 120×100"):
        read_observations(write_project(tmp_path / "birds.slp"), tmp_path / "small.mp4")
    with pytest.raises(InputError, match="does not exist"):
        read_observations(path, tmp_path / "none.mp4")


def test_labels_and_a_folder_of_pictures(tmp_path):
    names = ["img9.png", "img10.png", "img40.png", "img700.png"]
    path = write_csv(tmp_path / "labels.csv", coords=("x", "y"), rows=names)
    folder = pictures(tmp_path / "clip", names)
    assert read_observations(path, folder).frame_index.tolist() == [0, 1, 2, 3]  # as everywhere for folders
    (folder / names[1]).unlink()
    with pytest.raises(InputError, match=r"lacks the picture img10.png"):
        read_observations(path, folder)


def test_pictures_of_another_size_than_the_labels_say(tmp_path):
    images = [{"id": 1, "width": 30, "height": 20, "file_name": "frame_1.png"}]
    category = {"id": 1, "name": "bird", "keypoints": ["beak"]}
    bird = {"id": 1, "image_id": 1, "category_id": 1, "keypoints": [3, 4, 2], "num_keypoints": 1, "bbox": [1, 1, 5, 5]}
    path = tmp_path / "export.json"
    path.write_text(json.dumps({"images": images, "categories": [category], "annotations": [bird]}))
    assert read_observations(path).frame_index.tolist() == [1]
    with pytest.raises(InputError, match=r"is 15×10, but export.json says 30×20"):
        read_observations(path, pictures(tmp_path / "half", ["frame_1.png"], (15, 10)))
    assert read_observations(path, pictures(tmp_path / "same", ["frame_1.png"], (30, 20))).frame_index.tolist() == [0]


def test_pictures_of_several_sizes(tmp_path):
    names = ["img1.png", "img2.png", "img3.png", "img4.png"]
    path = write_csv(tmp_path / "labels.csv", coords=("x", "y"), rows=names)
    for i, name in enumerate(names[:3]):
        cv2.imwrite(str(tmp_path / name), np.zeros((100, 120 + i), np.uint8))
    with pytest.raises(InputError, match=r"lacks the picture img4.png, and its pictures have several sizes"):
        read_observations(path)
    cv2.imwrite(str(tmp_path / names[3]), np.zeros((100, 99), np.uint8))
    assert read_observations(path).image_size_px[:, 0].tolist() == [120, 121, 122, 99]


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "is empty"), (b"\x80\x04K\x01.", "is of no known format"), (b"{", "is not valid JSON"), (b"[1", "JSON")],
)
def test_other_content(tmp_path, content, message):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_observations(tmp_path / "file")


def test_without_the_extra(tmp_path, monkeypatch):
    from jaxfit.foundation import extras

    monkeypatch.setattr(extras, "find_spec", lambda package: None)
    with pytest.raises(InputError, match=r"needs h5py, which this installation lacks \(run pip install .*formats"):
        recognise.read_observations(write_table(tmp_path / "a.h5"))


def test_tables_have_a_largest_size():
    check_table_size(Path("hour.h5"), 15, 90_000, 1)
    with pytest.raises(InputError, match=r"1,000 birds × 100,000 frames × 20 keypoints need .* \(split the file\)"):
        check_table_size(Path("large.h5"), 1000, 100_000, 20)


def test_other_files_that_sleap_io_reads(tmp_path):
    """The analysis CSV of SLEAP has the numbers of its project. Key points of AlphaTracker have numbers as names."""
    project = read_observations(write_project(tmp_path / "birds.slp"))
    labels = sleap_io.load_slp(str(tmp_path / "birds.slp"), open_videos=False)
    sleap_io.save_csv(labels, str(tmp_path / "sleap.csv"), format="sleap")
    table = read_observations(tmp_path / "sleap.csv", size_px=(120, 100))
    table = reorder_keypoints(table, project.keypoint_names)
    np.testing.assert_array_equal(table.frame_index, project.frame_index)
    np.testing.assert_allclose(table.keypoints_px, project.keypoints_px, atol=1e-4)
    np.testing.assert_allclose(table.confidence, project.confidence, atol=1e-4)
    points = [{"class": "Face", "x": 1, "y": 1, "width": 9, "height": 9}, {"class": "point", "x": 3.5, "y": 4}]
    frames = [{"filename": f"img{t}.png", "class": "image", "annotations": points} for t in (7, 12)]
    (tmp_path / "alpha.json").write_text(json.dumps(frames))
    alpha = read_observations(tmp_path / "alpha.json", size_px=(120, 100))
    assert alpha.frame_index.tolist() == [7, 12]
    np.testing.assert_array_equal(alpha.keypoints_px[0, :, 0], [[3.5, 4]] * 2)


def test_one_line_says_what_was_read(tmp_path, caplog):
    with caplog.at_level("INFO"):
        read_observations(write_project(tmp_path / "birds.slp"))
    assert (
        "birds.slp: a SLEAP project of clip.mp4, 120×100: 2 birds, 4 frames (0 to 30), 3 keypoints (24 of 24 known), 0"
        in caplog.text
    )
    with caplog.at_level("INFO"):
        read_observations(write_csv(tmp_path / "a.csv"), size_px=(120, 100))
    assert "120×100: 1 bird, 4 frames (0 to 3), 3 keypoints (12 of 12 known), 0 masks" in caplog.text


def test_pictures_that_are_turned(tmp_path):
    """A picture that a camera stored on its side has the size of the upright picture."""
    path = write_csv(tmp_path / "labels.csv", coords=("x", "y"), rows=["img1.jpg", "img2.jpg", "img3.jpg", "img4.jpg"])
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    for t in range(1, 5):
        Image.new("CMYK", (100, 120)).save(tmp_path / f"img{t}.jpg", exif=exif)
    assert read_observations(path).image_size_px.tolist() == [[120, 100]] * 4


@pytest.mark.parametrize("name", ["clipshortDLC_net.csv", "clip_left_croppedDLC_net.csv", "clip-1DLC_net.csv"])
def test_a_film_that_is_guessed_is_named(tmp_path, caplog, name):
    """DeepLabCut names the tables of shortened films by words after the name of the film."""
    film(tmp_path / "clip.mp4")
    read_observations(write_csv(tmp_path / name))
    assert f"{name}: takes clip.mp4, whose name begins its name" in caplog.text


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts"])
@pytest.mark.parametrize("frames", [T - 1, T, T + 2])
def test_rows_are_compared_with_the_frames(tmp_path, caplog, suffix, frames):
    """Also where the container does not store the number of frames."""
    encode(tmp_path / f"clip.{suffix}", count=frames)
    path = write_csv(tmp_path / "clipDLC_net.csv")
    if frames < T:
        with pytest.raises(InputError, match=r"keypoints for frame 3, but .* has 3 frames"):
            read_observations(path)
        return
    read_observations(path)
    text = "holds 4 rows for the 6 frames of its video; its first row is taken for frame 0"
    assert (text in caplog.text) == (frames > T)


def rewritten(path, change):
    """Change the cells of a CSV file by a function of the row, its number and the cells."""
    rows = [change(i, line.split(",")) for i, line in enumerate(path.read_text().splitlines())]
    path.write_text("\n".join(",".join(row) for row in rows))
    return path


def test_positions_in_space_with_likelihoods(tmp_path):
    def with_depth(i, row):
        keypoints = [row[k : k + 3] for k in range(1, len(row), 3)]
        depth = {0: "net", 2: "z"}
        return [row[0], *(cell for x, y, c in keypoints for cell in (x, y, depth.get(i, x if i == 1 else "5"), c))]

    with pytest.raises(InputError, match="holds positions in space"):
        read_observations(rewritten(write_csv(tmp_path / "a.csv"), with_depth), size_px=(120, 100))


def test_fractions_of_the_image(tmp_path):
    def divided(i, row):
        return row if i < 3 else [row[0], *(str(float(v) / 120) if k % 3 < 2 else v for k, v in enumerate(row[1:]))]

    with pytest.raises(InputError, match="the positions are fractions of the image, not pixels"):
        read_observations(rewritten(write_csv(tmp_path / "a.csv"), divided), size_px=(120, 100))


@pytest.mark.parametrize(
    ("factor", "message"), [(1 / 30, "fractions of the image"), (10, "7 of 7 keypoints outside images of 30×20")]
)
def test_coco_files_with_positions_that_are_no_pixels(tmp_path, factor, message):
    data = content()
    for bird in data["annotations"]:
        bird["keypoints"] = [v if k % 3 == 2 else factor * v for k, v in enumerate(bird["keypoints"])]
    with pytest.raises(InputError, match=message):
        read_observations(saved(tmp_path, data))


def test_rows_with_numbers_of_pandas(tmp_path):
    """A table that pandas has written again may number its rows 30.0, 31.0, …"""
    path = write_csv(tmp_path / "a.csv", rows=["30.0", "31.0", "33.0", "34.0"])
    assert read_observations(path, size_px=(120, 100)).frame_index.tolist() == [30, 31, 33, 34]
