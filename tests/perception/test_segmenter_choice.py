"""The segmenter that `auto` stands for: agreement by hand, and every reason of a choice, with replaced networks."""

import logging

import cv2
import numpy as np
import pytest
from support.toy_footage import FRAMES, SIDE, Footage, TrueKeypoints, TrueSegmenter

from jaxfit.config.perception import FramesConfig, SegmenterConfig, TrackConfig
from jaxfit.foundation.errors import InputError
from jaxfit.perception import segmenter_choice, track
from jaxfit.perception.network import instance_of
from jaxfit.perception.segmenter_choice import agreements, choose_segmenter, with_chosen_segmenter
from jaxfit.perception.track import run_tracking

FOOTAGE = Footage()
AUTO = TrackConfig(min_track_frames=2)


def bird(x0, width=10):
    return instance_of(np.ones((4, width), bool), 0.9, "bird", x0)


def test_agreement_by_hand():
    def of(first, first_mirrored, second=(), second_mirrored=()):
        return agreements(([first], [first_mirrored]), ([second], [second_mirrored]), (100, 4))

    two = [bird(0), bird(50)]
    assert of(two, two[::-1], two, two) == (1, 1)
    assert of([], []) == (0, 0)
    assert of([bird(0)], []) == (0, 0)
    assert of([bird(0)], [bird(2)]) == pytest.approx((8 / 12, 0))
    assert of([bird(0)], [bird(4)]) == (0, 0)  # IoU 6/14
    assert of(two, [bird(0)]) == pytest.approx((1 / 2, 0))
    # only the second segmenter detects the other bird in both runs
    assert of([bird(0)], [bird(0)], two, two) == pytest.approx((1 / 2, 1))
    # what the second segmenter detects in one run does not count against the first
    assert of([bird(0)], [bird(0)], two, [bird(0)]) == pytest.approx((1, 1 / 2))
    # the sums over the frames are divided, not the frames
    runs = [[bird(0)], [bird(0, 30)]], [[bird(0)], []]
    assert agreements(runs, ([[], []], [[], []]), (100, 4)) == pytest.approx((10 / 40, 0))


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
    monkeypatch.setattr(segmenter_choice, "general_files", lambda: [tmp_path])
    monkeypatch.setattr(segmenter_choice, "check_general_files", lambda: [])
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
        ({"missed_in_mirror": FIRST}, {}, "general", "agreement with the mirror image 1.00, builtin 0.67, on 8 frames"),
        ({}, {"missed_in_mirror": FIRST}, "builtin", "agreement with the mirror image 1.00, general 0.67, on 8 frames"),
        ({}, {}, "builtin", "agreement with the mirror image 1.00, general 1.00, on 8 frames"),
        ({"missed": ALL}, {}, "general", "agreement with the mirror image 1.00, builtin 0.00, on 8 frames"),
        ({}, {"missed": ALL}, "builtin", "the general segmenter detects no bird on 8 frames"),
        ({"missed": ALL}, {"missed": ALL}, "builtin", "no bird was detected on 8 frames"),
    ],
)
def test_the_agreement_decides_under_low_trust(video, networks, builtin, general, name, reason):
    networks.update(builtin=Mirrored(distance=7.0, **builtin), general=Mirrored(**general))
    assert choose_segmenter(video, AUTO) == (name, reason, True)


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
    assert found.choice.sentence().startswith("segmenter: general (agreement")
    named = run_tracking(video, TrackConfig(segmenter=SegmenterConfig("builtin"), min_track_frames=2))
    assert (named.choice, named.observations.num_tracks) == (None, 0)


def test_a_segmenter_of_the_caller_needs_no_choice(video, networks):
    networks.clear()
    assert run_tracking(video, AUTO, Mirrored()).choice is None


def test_without_the_files_no_network_runs(video, monkeypatch, tmp_path):
    monkeypatch.setenv("JAXFIT_NETWORKS", str(tmp_path / "absent"))
    monkeypatch.setattr(segmenter_choice, "open_segmenter", None)
    config, choice = with_chosen_segmenter(video, AUTO)
    assert config == TrackConfig(segmenter=SegmenterConfig("builtin"), min_track_frames=2)
    assert not choice.is_compared
    assert choice.info() == {}
    assert "jaxfit networks get general" in choice.sentence()


def test_a_wrong_file_is_reported(video, monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("JAXFIT_NETWORKS", str(tmp_path))
    (tmp_path / "yolox_nano.onnx").write_text("<html>")
    monkeypatch.setattr(segmenter_choice, "open_segmenter", None)
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
