"""An overlay never takes the footage's place, and another file's only where it may."""

import cv2
import numpy as np
import pytest
from support.overlays import BIRD, FIRST, HEIGHT, WIDTH, T, film, solution

from jaxfit.foundation.errors import InputError
from jaxfit.video.reader import probe_video
from jaxfit.view.overlay import overlay, overlay_frame


@pytest.fixture
def video(tmp_path):
    return film(tmp_path / "mine.mp4")


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refuse(match, video, out, frame=None, **given):
    before = contents(video.parent)
    draw, which = (overlay, ()) if frame is None else (overlay_frame, (frame,))
    with pytest.raises(InputError, match=match):
        draw(solution(), BIRD, video, *which, out, **given)
    assert contents(video.parent) == before


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_footage_is_never_replaced(video, tmp_path, monkeypatch, overwrite):
    refuse(r"mine\.mp4: is the video itself", video, video, overwrite=overwrite)
    (tmp_path / "link.mp4").symlink_to(video)
    refuse(r"link\.mp4: is the video itself", video, tmp_path / "link.mp4", overwrite=overwrite)
    refuse(r"mine\.mp4: is the video itself", tmp_path / "link.mp4", video, overwrite=overwrite)
    monkeypatch.chdir(tmp_path)
    refuse(r"mine\.mp4: is the video itself", video, "mine.mp4", overwrite=overwrite)


@pytest.mark.parametrize("overwrite", [False, True])
def test_nothing_joins_a_folder_of_images(tmp_path, overwrite):
    images = tmp_path / "images"
    images.mkdir()
    for t in range(FIRST + T):
        cv2.imwrite(str(images / f"{t}.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    refuse("lies among the video's images", images, images / "o.mp4", overwrite=overwrite)
    refuse("lies among the video's images", images, images / "3.png", frame=FIRST, overwrite=overwrite)
    (tmp_path / "link").symlink_to(images)
    refuse("lies among the video's images", images, tmp_path / "link" / "o.png", frame=FIRST, overwrite=overwrite)


def test_other_files_are_replaced_only_where_asked(video, tmp_path):
    sheet, out = tmp_path / "o.png", tmp_path / "o.mp4"
    sheet.write_bytes(b"a drawing")
    refuse(r"o\.png: exists already \(.*--overwrite", video, out)
    refuse(r"o\.png: exists already", video, sheet, frame=FIRST)
    out.write_bytes(b"a film")
    refuse(r"o\.mp4: exists already", video, out)
    overlay_frame(solution(), BIRD, video, FIRST, sheet, overwrite=True)
    assert cv2.imread(str(sheet)).shape[1] == WIDTH
    assert out.read_bytes() == b"a film"
    overlay(solution(), BIRD, video, out, overwrite=True)
    assert probe_video(out).frames == T
    sheet.unlink()
    sheet.mkdir()
    refuse(r"o\.png: is a folder", video, out, overwrite=True)
