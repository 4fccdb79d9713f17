"""Overlays and reports refuse footage that is not the footage of the result, accept its copies, and can be forced."""

import dataclasses
import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from support.cli_files import rejected
from support.overlays import BIRD, FIRST, FPS, HEIGHT, WIDTH, T, solution

from jaxfit import overlay
from jaxfit.cli.main import main
from jaxfit.data.footage import FootageIdentity, read_footage
from jaxfit.data.solution import save_solution
from jaxfit.foundation.errors import InputError
from jaxfit.video.reader import probe_video, read_frames
from jaxfit.video.writer import VideoWriter
from jaxfit.view.overlay import overlay_frame

FRAMES = FIRST + T + 2


def film(path, seed=0, frames=FRAMES, size=(WIDTH, HEIGHT)):
    """Grey patches that fade slowly; every seed has other patches."""
    patches = np.random.default_rng(seed).integers(60, 200, (5, 8, 3), dtype=np.uint8)
    with VideoWriter(path, size, FPS) as writer:
        for t in range(frames):
            writer.write(cv2.resize(patches + np.uint8(t), size, interpolation=cv2.INTER_LINEAR))
    return path


def result(folder, video=None, **footage):
    """Write a result of `video`; `footage` replaces the entry of the summary."""
    made = dataclasses.replace(solution(), status=["ok", "ok"])
    entries = read_footage(video, probe_video(video).frames).entries() if video else footage
    save_solution(made, BIRD, "", {"video": entries} if entries else {}, folder)
    return folder


def copied(video, path, codec=None, **options):
    """Copy the packets of a video into another container, or encode its pictures again."""
    with av.open(str(video)) as source, av.open(str(path), "w") as target:
        own = source.streams.video[0]
        stream = target.add_stream_from_template(own) if codec is None else target.add_stream(codec, rate=12)
        if codec is None:
            for packet in source.demux(own):
                if packet.dts is not None:
                    packet.stream = stream
                    target.mux(packet)
            return path
        stream.width, stream.height, stream.pix_fmt, stream.options = own.width, own.height, "yuv420p", options
        for number, picture in enumerate(source.decode(own)):
            again = av.VideoFrame.from_ndarray(picture.to_ndarray(format="rgb24"), "rgb24")
            again.pts = number
            target.mux(stream.encode(again))
        target.mux(stream.encode(None))
    return path


def pictures(video, folder, suffix):
    folder.mkdir()
    for number, picture, _ in read_frames(video):
        cv2.imwrite(str(folder / f"{number}{suffix}"), picture)
    return folder


def test_another_recording_is_refused_in_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a long path shortens the message
    tmp_path = Path()
    own = film(tmp_path / "own.mp4")
    folder = result(tmp_path / "result", own)

    def refused(name, *words, seed=1, **changes):
        other = str(film(tmp_path / name, seed, **changes))
        for command in ("overlay", "report"):
            out = tmp_path / f"out.{'mp4' if command == 'overlay' else 'html'}"
            call = [command, str(folder), "--video", other, "--out", str(out)]
            rejected(capsys, call, f"{name}: is not the video of the result", *words, "--force")
            assert not out.exists()

    refused("same_size.mp4", "it has another first frame")
    refused("longer.mp4", f"it has {FRAMES + 3} frames instead of {FRAMES}", seed=0, frames=FRAMES + 3)
    size = f"images of 240×160 instead of {WIDTH}×{HEIGHT} pixels"
    refused("all.mp4", size, f"{T} frames instead of {FRAMES}, another first frame", frames=T, size=(240, 160))


def test_copies_are_accepted(tmp_path):
    own = film(tmp_path / "own.mp4")
    known = read_footage(own, FRAMES)
    made = dataclasses.replace(solution(), footage=known)
    copies = [
        copied(own, tmp_path / "remuxed.mkv"),
        copied(own, tmp_path / "again.mp4", "mpeg4", b="60000"),
        copied(own, tmp_path / "again.avi", "mpeg4", b="200000"),
        pictures(own, tmp_path / "lossless", ".png"),
        pictures(own, tmp_path / "jpeg", ".jpg"),
    ]
    for copy in copies:
        overlay_frame(made, BIRD, copy, FIRST + 1, tmp_path / "o.png", overwrite=True)
    other = film(tmp_path / "other.mp4", 1)
    with pytest.raises(InputError, match="another first frame"):
        overlay_frame(made, BIRD, other, FIRST + 1, tmp_path / "o.png", overwrite=True)


def test_force_draws_all_the_same(tmp_path, capsys):
    folder = result(tmp_path / "result", film(tmp_path / "own.mp4"))
    other = str(film(tmp_path / "other.mp4", 1, FIRST + 2, (240, 160)))
    out = tmp_path / "o.mp4"
    assert main(["overlay", str(folder), "--video", other, "--out", str(out), "--force"]) == 0
    drawn = probe_video(out)
    assert (drawn.frames, drawn.size_px[0]) == (2, 240)  # the frames that the video has
    page = tmp_path / "report.html"
    assert main(["report", str(folder), "--video", other, "--out", str(page), "--force"]) == 0
    assert page.read_text().count("data:image/jpeg") == 2
    at = ["overlay", str(folder), "--video", other, "--frame", str(FIRST), "--out", str(tmp_path / "o.jpg"), "--force"]
    assert main(at) == 0
    at[at.index(str(FIRST))] = str(FIRST + T - 1)
    at[at.index(str(tmp_path / "o.jpg"))] = str(tmp_path / "none.jpg")
    rejected(capsys, at, f"has {FIRST + 2} frames, but the result has frames {FIRST} to {FIRST + T - 1}")
    short = str(film(tmp_path / "short.mp4", 1, FIRST))
    none = ["overlay", str(folder), "--video", short, "--out", str(tmp_path / "none.mp4"), "--force"]
    rejected(capsys, none, f"has {FIRST} frames, but the result has frames {FIRST} to {FIRST + T - 1}")
    assert not list(tmp_path.glob("none*"))


def test_older_results_are_checked_by_what_they_hold(tmp_path, capsys):
    other, longer = film(tmp_path / "other.mp4", 1), film(tmp_path / "longer.mp4", 1, FRAMES + 1)
    for name, entries in (("fit", {}), ("reconstruct", {"file": "own.mp4", "frames": FRAMES, "size_px": [1, 1]})):
        folder, out = result(tmp_path / name, **entries), tmp_path / f"{name}.mp4"
        assert main(["overlay", str(folder), "--video", str(other), "--out", str(out)]) == 0
        assert probe_video(out).frames == T
        again = ["overlay", str(folder), "--video", str(longer), "--out", str(out), "--overwrite"]
        if entries:
            capsys.readouterr()
            rejected(capsys, again, f"{FRAMES + 1} frames instead of {FRAMES}")
        else:
            assert main(again) == 0


def test_unknown_numbers_of_frames_are_not_compared(tmp_path):
    own = film(tmp_path / "own.mp4")
    made = dataclasses.replace(solution(), footage=FootageIdentity(FRAMES + 5, read_footage(own, None).first_frame))
    stream = copied(own, tmp_path / "stream.mkv")
    assert probe_video(stream).frames is None
    overlay(made, BIRD, stream, tmp_path / "o.mp4")
    with pytest.raises(InputError, match=f"{FRAMES} frames instead of {FRAMES + 5}"):
        overlay(made, BIRD, own, tmp_path / "o2.mp4")


@pytest.mark.parametrize("value", [7, "AAAA"])
def test_a_damaged_identity_is_one_error(tmp_path, capsys, monkeypatch, value):
    monkeypatch.chdir(tmp_path)  # a long path shortens the message
    tmp_path = Path()
    own = film(tmp_path / "own.mp4")
    folder = result(tmp_path / "result", own)
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"video": {"first_frame": value}}))
    call = ["overlay", str(folder), "--video", str(own), "--out", str(tmp_path / "o.mp4")]
    rejected(capsys, call, "summary.json", "video.first_frame")
