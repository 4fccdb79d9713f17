"""The segmenter that `auto` stands for: every reason of a choice, with replaced networks."""

import logging

import cv2
import numpy as np
import pytest
from support.toy_footage import FRAMES, SIDE, Footage, TrueKeypoints, TrueSegmenter

from jaxfit.config.perception import FramesConfig, SegmenterConfig, TrackConfig
from jaxfit.foundation.errors import InputError
from jaxfit.perception import general_networks, segmenter_choice, track
from jaxfit.perception.segmenter_choice import choose_segmenter, with_chosen_segmenter
from jaxfit.perception.track import run_tracking

FOOTAGE = Footage()
AUTO = TrackConfig(min_track_frames=2)


class Mirrored(TrueSegmenter):
    """Detects the birds of the toy footage also in the mirror image, except the missed (frame, bird)."""

    def __init__(self, missed_in_mirror=(), missed=(), distance=None):
        super().__init__(FOOTAGE, missed)
        self.missed_in_mirror, self.distance = missed_in_mirror, distance
        if distance is not None:
            self.activations = self

    def take(self):
        return np.full(3, self.distance)

    def __call__(self, frame):
        if frame[0, 0, 0]:  # the number of the frame, from 1 on
            return super().__call__(frame)
        original = np.ascontiguousarray(frame[:, ::-1])
        t, width = int(original[0, 0, 0]), frame.shape[1]
        birds = [b for b in super().__call__(original) if (t, b.x0 // SIDE) not in self.missed_in_mirror]
        return [b._replace(mask=b.mask[:, ::-1], x0=width - b.x0 - b.mask.shape[1]) for b in birds]


ALL = [(t, n) for t in range(FRAMES) for n in range(3)]
FIRST = [(t, 0) for t in range(FRAMES)]


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """The toy footage without frame 0, whose number is not visible."""
    folder = FOOTAGE.write(tmp_path_factory.mktemp("film") / "frames")
    (folder / "0.png").unlink()
    return folder


@pytest.fixture
def networks(monkeypatch, tmp_path):
    """Replace the networks: name → segmenter; the files of the general segmenter exist."""
    opened = {"builtin": Mirrored(), "general": Mirrored()}
    monkeypatch.setattr(segmenter_choice, "installed_general", lambda: "general")
    monkeypatch.setattr(segmenter_choice, "check_general_files", lambda _: [])
    for module in (segmenter_choice, track):
        monkeypatch.setattr(module, "open_segmenter", lambda config, *_: opened[config.segmenter.file])
        monkeypatch.setattr(module, "open_keypoint_detector", lambda _: TrueKeypoints(FOOTAGE))
    return opened


def test_high_trust_in_the_builtin_segmenter_decides(video, networks):
    networks["builtin"] = Mirrored(FIRST, distance=0.5)
    del networks["general"]  # is not opened
    choice = choose_segmenter(video, AUTO)
    assert choice == ("builtin", "trust is high on 8 frames", True)


@pytest.mark.parametrize(
    ("builtin", "general", "name", "reason"),
    [
        # one bird of one frame is enough, and stable masks of the built-in segmenter do not count
        (
            {},
            {"missed": ALL[:-1]},
            "general",
            "trust in the built-in segmenter is low on 8 frames, and general detects",
        ),
        (
            {"missed": ALL},
            {},
            "general",
            "trust in the built-in segmenter is low on 8 frames, and general detects birds",
        ),
        ({}, {"missed": ALL}, "builtin", "trust is low, but general detects no bird on 8 frames"),
        # birds that are not detected in the mirror image
        ({}, {"missed_in_mirror": ALL}, "builtin", "trust is low, but general detects no bird on 8 frames"),
        ({"missed": ALL}, {"missed": ALL}, "builtin", "trust is low, but general detects no bird on 8 frames"),
    ],
)
def test_under_low_trust_a_bird_of_the_general_segmenter_decides(video, networks, builtin, general, name, reason):
    networks.update(builtin=Mirrored(distance=7.0, **builtin), general=Mirrored(**general))
    choice = choose_segmenter(video, AUTO)
    assert (choice.segmenter, choice.is_compared) == (name, True)
    assert choice.reason.startswith(reason)


def test_the_frames_are_spread_over_the_range(video, networks):
    networks["builtin"] = Mirrored(distance=0.5)
    choose_segmenter(video, AUTO)
    assert networks["builtin"].frames == [1, 3, 4, 5, 7, 8, 9, 11]
    networks["builtin"] = Mirrored(distance=0.5)
    choose_segmenter(video, TrackConfig(FramesConfig(1, 10, 4)))
    assert networks["builtin"].frames == [2, 6, 10]


def test_tracking_uses_the_chosen_segmenter(video, networks):
    networks["builtin"] = Mirrored(missed=ALL, distance=7.0)
    found = run_tracking(video, AUTO)
    assert found.observations.num_tracks == 3
    assert found.choice.segmenter == "general"
    assert found.info()["segmenter"] == "general"
    assert found.choice.sentence().startswith("segmenter: general (trust in the built-in")
    named = run_tracking(video, TrackConfig(segmenter=SegmenterConfig("builtin"), min_track_frames=2))
    assert (named.choice, named.observations.num_tracks) == (None, 0)


def test_a_segmenter_of_the_caller_needs_no_choice(video, networks):
    networks.clear()
    assert run_tracking(video, AUTO, Mirrored()).choice is None


@pytest.mark.parametrize(("distance", "trust"), [(7.0, "low"), (0.5, "high")])
def test_without_the_files_the_command_is_named(video, networks, monkeypatch, caplog, distance, trust):
    monkeypatch.setattr(segmenter_choice, "installed_general", lambda: None)
    networks["builtin"] = Mirrored(distance=distance)
    del networks["general"]  # is not opened
    config, choice = with_chosen_segmenter(video, AUTO)
    assert config == TrackConfig(segmenter=SegmenterConfig("builtin"), min_track_frames=2)
    assert choice.reason.startswith(f"trust is {trust} on 8 frames")
    for text in (choice.sentence(), choice.info()["segmenter_reason"], "".join(caplog.messages)):
        assert ("run `jaxfit networks get general` first" in text) == (trust == "low")


def test_a_wrong_file_is_reported(video, networks, monkeypatch, tmp_path, caplog):
    monkeypatch.setattr(segmenter_choice, "check_general_files", general_networks.check_general_files)
    monkeypatch.setenv("JAXFIT_NETWORKS", str(tmp_path))
    (tmp_path / "yolox_nano.onnx").write_text("<html>")
    networks["builtin"] = Mirrored(distance=7.0)
    with caplog.at_level(logging.WARNING):
        assert choose_segmenter(video, AUTO).segmenter == "builtin"
    (message,) = caplog.messages
    assert "is not the published file" in message
    assert message.endswith("`auto` uses the built-in segmenter")


@pytest.mark.parametrize("settings", [{"kind": "yolo"}, {"names": ("bird",)}])
def test_settings_of_one_network_need_no_choice(video, networks, settings):
    networks.clear()
    choice = choose_segmenter(video, TrackConfig(segmenter=SegmenterConfig(**settings)))
    assert (choice.segmenter, choice.is_compared) == ("builtin", False)


@pytest.mark.usefixtures("networks")
def test_no_readable_frame(video, tmp_path):
    assert choose_segmenter(video, TrackConfig(FramesConfig(50))).reason == "no frame of the video can be read"
    with pytest.raises(InputError, match="does not exist"):
        choose_segmenter(tmp_path / "absent.mp4", AUTO)
    folder = tmp_path / "damaged"
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), FOOTAGE.frame(1))
    for i in range(1, 9):
        (folder / f"{i}.png").write_bytes(b"damage")
    assert choose_segmenter(folder, AUTO).is_compared
