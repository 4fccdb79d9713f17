"""Pictures of a folder, and the pages of a TIFF file."""

import os

import cv2
import numpy as np
import pytest
from PIL import Image
from support.films import COUNT, SIZE, frames

from jaxfit.foundation.errors import InputError
from jaxfit.video.pictures import image_files, read_picture
from jaxfit.video.reader import VideoInfo, probe_video, read_frames

PICTURES = list(frames())


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".webp"])
def test_pixels_are_those_of_opencv(tmp_path, suffix):
    pictures = {"colour": PICTURES[0], "grey": PICTURES[0][..., 0]}
    if suffix in (".png", ".tiff"):
        pictures["deep"] = PICTURES[0][..., 0].astype(np.uint16) * 257
    for name, picture in pictures.items():
        cv2.imwrite(str(tmp_path / f"{name}{suffix}"), picture)
        file = tmp_path / f"{name}{suffix}"
        np.testing.assert_array_equal(read_picture(file), cv2.imread(str(file)))
    if "deep" in pictures:  # the numbers of birds in masks
        np.testing.assert_array_equal(read_picture(tmp_path / f"deep{suffix}", grey=True), pictures["deep"])


def test_pictures_of_cameras_and_print(tmp_path):
    """A flag turns the picture of a camera; print has four inks."""
    picture = Image.fromarray(PICTURES[0][..., ::-1].copy())
    exif = Image.Exif()
    exif[0x0112] = 6
    picture.save(tmp_path / "turned.jpg", exif=exif)
    np.testing.assert_array_equal(read_picture(tmp_path / "turned.jpg"), cv2.imread(str(tmp_path / "turned.jpg")))
    assert read_picture(tmp_path / "turned.jpg").shape[:2] == SIZE
    picture.convert("CMYK").save(tmp_path / "inks.jpg", quality=95)
    error = read_picture(tmp_path / "inks.jpg").astype(int) - PICTURES[0]
    assert np.abs(error).mean() < 5


def test_a_folder_of_images(tmp_path, caplog):
    for i, picture in enumerate(PICTURES[:12]):
        cv2.imwrite(str(tmp_path / f"frame{i}.png"), picture)  # 10 stands before 2 in plain order
    (tmp_path / "notes.txt").write_text("not a picture")
    (tmp_path / "._frame0.png").write_bytes(b"Mac OS X")
    assert len(image_files(tmp_path)) == 12
    assert probe_video(tmp_path) == VideoInfo(12, None, SIZE)
    read = list(read_frames(tmp_path, 1, None, 2))
    assert [frame.index for frame in read] == [1, 3, 5, 7, 9, 11]
    for frame in read:
        np.testing.assert_array_equal(frame.picture, PICTURES[frame.index])
    assert {frame.time_s for frame in read} == {None}
    assert [frame.time_s for frame in read_frames(tmp_path, 4, fps=4)] == [1 + i / 4 for i in range(8)]
    assert list(read_frames(tmp_path, 50)) == []
    assert caplog.records == []


def test_equal_numbers_are_ordered_by_their_text(tmp_path):
    for name in ("1.png", "01.png", "2.png", "001.png", "b1.png", "a01.png", "a1.png"):
        (tmp_path / name).touch()
    names = [file.name for file in image_files(tmp_path)]
    assert names == ["a01.png", "a1.png", "b1.png", "001.png", "01.png", "1.png", "2.png"]


def test_pages_of_a_tiff_file_are_frames(tmp_path):
    first, *others = [Image.fromarray(picture[..., ::-1].copy()) for picture in PICTURES]
    first.save(tmp_path / "stack.tif", save_all=True, append_images=others)
    assert probe_video(tmp_path / "stack.tif") == VideoInfo(COUNT, None, SIZE)
    for frame in read_frames(tmp_path / "stack.tif", 3, 20, 4, fps=2):
        np.testing.assert_array_equal(frame.picture, PICTURES[frame.index])
        assert frame.time_s == frame.index / 2


def test_images_that_cannot_be_read(tmp_path, caplog):
    for i, picture in enumerate(PICTURES[:12]):
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture)
    for i, content in ((0, b""), (3, b"no image"), (4, (tmp_path / "4.png").read_bytes()[:40])):
        (tmp_path / f"{i}.png").write_bytes(content)
    (tmp_path / "6.png").unlink()
    os.mkfifo(tmp_path / "6.png")
    reader = read_frames(tmp_path, fps=2)
    assert reader.info == VideoInfo(12, 2, SIZE)
    assert [(frame.index, frame.time_s) for frame in reader] == [(i, i / 2) for i in (1, 2, 5, *range(7, 12))]
    assert reader.damaged == [0, 3, 4, 6]
    assert caplog.messages == [f"{tmp_path}: 4 damaged frames skipped (0, 3–4, 6)"]
    cv2.imwrite(str(tmp_path / "7.png"), np.zeros((10, 20, 3), np.uint8))
    with pytest.raises(InputError, match=r"7\.png: is 20×10, but the images before are 64×48"):
        list(reader)
    (tmp_path / "6.png").unlink()
    for file in tmp_path.iterdir():
        file.write_bytes(b"")
    with pytest.raises(InputError, match="has no readable image"):
        read_frames(tmp_path)


def test_names_that_are_not_utf8(tmp_path):
    folder = tmp_path / os.fsdecode(b"\xc5land")
    folder.mkdir()
    for name in (b"\xc51.png", b"\xc510.png", b"\xc52.png"):
        (folder / os.fsdecode(name)).write_bytes(cv2.imencode(".png", PICTURES[0])[1].tobytes())
    assert [frame.index for frame in read_frames(folder)] == [0, 1, 2]
