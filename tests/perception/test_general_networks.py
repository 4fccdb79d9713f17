"""The general segmenter: the folder of its two files, the check of the files, and its birds."""

import hashlib

import cv2
import numpy as np
import pytest
from support.saliency_graphs import BIRD_ROW, write_saliency, write_yolox, yolox_head

from jaxfit.config.perception import SegmenterConfig, TrackConfig
from jaxfit.foundation.errors import InputError
from jaxfit.perception import general_networks
from jaxfit.perception.detections import network_files, open_segmenter
from jaxfit.perception.segmentation import load_segmenter


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXFIT_NETWORKS", str(tmp_path))
    return tmp_path


@pytest.fixture
def files(folder, monkeypatch):
    """Small networks in place of the published ones."""
    detector = general_networks.DETECTORS["general"]
    for network, path in (
        (detector, write_yolox(folder / "yolox_nano.onnx", yolox_head(BIRD_ROW))),
        (general_networks.SALIENCY, write_saliency(folder / "u2netp.onnx")),
    ):
        network = network._replace(sha256=("0", hashlib.sha256(path.read_bytes()).hexdigest()))
        if path.name == "u2netp.onnx":
            monkeypatch.setattr(general_networks, "SALIENCY", network)
        else:
            monkeypatch.setitem(general_networks.DETECTORS, "general", network)
    return folder


def test_the_folder_is_that_of_the_variable_or_of_the_users_data(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXFIT_NETWORKS", "/some/where")
    assert [path.as_posix() for path in general_networks.general_files()] == [
        "/some/where/yolox_nano.onnx",
        "/some/where/u2netp.onnx",
    ]
    monkeypatch.delenv("JAXFIT_NETWORKS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert general_networks.networks_folder() == tmp_path / "jaxfit" / "networks"
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert general_networks.networks_folder() == tmp_path / ".local" / "share" / "jaxfit" / "networks"


@pytest.mark.usefixtures("files")
def test_the_birds_of_both_files():
    frame = np.full((416, 832, 3), (140, 0, 75), np.uint8)
    cv2.ellipse(frame, (336, 232), (60, 30), 0, 0, 360, (0, 0, 140), -1)
    config = TrackConfig(segmenter=SegmenterConfig("general"), threads=1)
    (bird,) = open_segmenter(config)(frame)
    assert (bird.label, pytest.approx(bird.score, abs=1e-6)) == ("bird", 0.72)
    assert network_files(config)["segmenter"] == general_networks.general_files()


def test_missing_files(folder):
    with pytest.raises(InputError) as error:
        load_segmenter("general")
    assert error.value.source == str(folder / "yolox_nano.onnx")
    assert "does not exist" in error.value.problem
    assert "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/" in error.value.problem
    assert "jaxfit networks get general" in error.value.remedy


@pytest.mark.parametrize("name", ["yolox_nano.onnx", "u2netp.onnx"])
def test_other_files_of_the_same_name(files, name):
    (files / name).write_bytes(b"<html>not found</html>")
    with pytest.raises(
        InputError, match=f"{name}: is not the published file: its SHA-256 differs .*jaxfit networks get general"
    ):
        load_segmenter("general")


def test_sizes_of_the_detector(files, monkeypatch):
    assert general_networks.installed_general() == "general"
    with pytest.raises(InputError, match=r"yolox_s.onnx: does not exist.*run `jaxfit networks get general-s`"):
        load_segmenter("general-s")
    # the small network in place of the largest one
    content = (files / "yolox_nano.onnx").read_bytes()
    (files / "yolox_s.onnx").write_bytes(content)
    largest = general_networks.DETECTORS["general-s"]._replace(sha256=(hashlib.sha256(content).hexdigest(),))
    monkeypatch.setitem(general_networks.DETECTORS, "general-s", largest)
    assert general_networks.installed_general() == "general-s"
    assert load_segmenter("general-s", threads=1).class_names == ("bird",)
    (files / "u2netp.onnx").unlink()
    assert general_networks.installed_general() is None


def test_another_kind_or_class(files):
    with pytest.raises(InputError, match="is two files, but kind yolo needs one file"):
        load_segmenter("general", kind="yolo")
    with pytest.raises(InputError, match="lacks murre; its classes are person"):
        load_segmenter("general", classes=["murre"])


def test_the_published_files_detect_a_real_bird(reference_dir, monkeypatch, tmp_path):
    published = reference_dir / "onnx"
    (tmp_path / "yolox_nano.onnx").symlink_to(published / "yolox_nano_coco.onnx")
    (tmp_path / "u2netp.onnx").symlink_to(published / "u2netp.onnx")
    monkeypatch.setenv("JAXFIT_NETWORKS", str(tmp_path))
    film = reference_dir / "video" / "mallard-water"
    picture = sorted((film / "frames").iterdir())[10]
    true = cv2.imread(str(sorted((film / "masks").iterdir())[10]), cv2.IMREAD_GRAYSCALE) > 0
    (bird,) = load_segmenter("general", threads=1)(cv2.imread(str(picture)))
    mask = np.zeros_like(true)
    height, width = bird.mask.shape
    mask[bird.y0 : bird.y0 + height, bird.x0 : bird.x0 + width] = bird.mask
    assert (mask & true).sum() / (mask | true).sum() > 0.85


@pytest.mark.parametrize(
    ("name", "words"),
    [("pigeons/pigeons_4_1.jpg", "upside down"), ("hawks/0234.jpg", "close"), ("auks/puffin_1.jpg", "large")],
)
def test_photographs_that_need_other_views(reference_dir, monkeypatch, tmp_path, name, words):
    published = reference_dir / "onnx"
    (tmp_path / "yolox_nano.onnx").symlink_to(published / "yolox_nano_coco.onnx")
    (tmp_path / "u2netp.onnx").symlink_to(published / "u2netp.onnx")
    monkeypatch.setenv("JAXFIT_NETWORKS", str(tmp_path))
    (bird,) = load_segmenter("general", threads=1).photograph(cv2.imread(str(reference_dir / "pictures" / name)))
    assert bird.score > 0.5, words
