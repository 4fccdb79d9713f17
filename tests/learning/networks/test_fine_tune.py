"""Fine-tuning: comparison of networks, accuracy, the command."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from support.cli_files import rejected
from support.labelled_pictures import bird, coco, write_labels

torch = pytest.importorskip("torch", reason="needs the extra `train` (PyTorch)")

from jaxfit.cli.main import main  # noqa: E402
from jaxfit.foundation.errors import InputError  # noqa: E402
from jaxfit.learning.networks import fine_tune  # noqa: E402
from jaxfit.learning.networks.fine_tune import keypoint_accuracy, segmenter_accuracy  # noqa: E402
from jaxfit.learning.networks.label_data import LabelFiles, prepare_data  # noqa: E402
from jaxfit.learning.networks.labelled_frames import UNKNOWN, load_frames  # noqa: E402
from jaxfit.learning.networks.training import Trained, weights_of  # noqa: E402
from jaxfit.model.anatomy import MURRE_KEYPOINTS  # noqa: E402
from jaxfit.perception.network import OnnxModel, instance_of  # noqa: E402

TIMES = range(0, 400, 50)
started = []
"""Names of the trainings in progress messages."""


@pytest.fixture
def data(tmp_path):
    file = write_labels(tmp_path / "labels", coco({t: [bird(40 + t // 20, 30)] for t in TIMES}), list(TIMES))
    return prepare_data("segmenter", LabelFiles((file,)), 0.25, None, tmp_path / "training")


@pytest.fixture
def compared(tmp_path, monkeypatch):
    """Return a function that runs a fine-tuning of networks with given scores.

    It returns the result and all written files: their names, the longer side of the pictures that they expect, and
    whether their weights are trained.
    """
    file = write_labels(tmp_path / "labels", coco({t: [bird()] for t in TIMES}), list(TIMES))
    written = []
    started.clear()

    def training(model, *_others, **options):
        started.append(options["name"])
        trained = {name: value + 1 for name, value in weights_of(model).items()}
        return Trained(10, [(0, 0.5), (5, 0.6), (10, 0.4)], trained, {})

    def write(which, model, facts, path, names, longer_side_px, crops):
        is_trained = not torch.equal(model.state_dict()["heads.centre.bias"], initial)
        written.append((path.name, longer_side_px, is_trained))

    def compare(**scores):
        def accuracy(path, pictures):
            name = "base" if path.name != fine_tune.CHECKED else "trained" if written[-1][2] else "rescaled"
            return {"mean_iou": scores[name] - 0.1, "ap50": scores[name] + 0.1}

        monkeypatch.setattr(fine_tune, "segmenter_accuracy", accuracy)
        settings = fine_tune.Settings(scenes=0, holdout=0.25)
        result = fine_tune.fine_tune("segmenter", LabelFiles((file,)), tmp_path / "mine.onnx", "", settings)
        return result, written

    base = fine_tune.base_file("segmenter", "builtin")
    initial = fine_tune.load_segmenter_base(base).state_dict()["heads.centre.bias"]
    for name, function in (
        ("train", training),
        ("write_network", write),
        ("load_segmenter", lambda path, kind: path),
        ("store_training_activations", lambda *_sources, **_options: None),
    ):
        monkeypatch.setattr(fine_tune, name, function)
    return compare


@pytest.mark.parametrize(
    ("scores", "chosen", "longer_side_px", "is_trained"),
    [
        ({"base": 0.736, "rescaled": 0.907, "trained": 0.8}, "rescaled", 640, False),
        ({"base": 0.7, "rescaled": 0.2, "trained": 0.6}, "base", 864, False),
        ({"base": 0.7, "rescaled": 0.2, "trained": 0.8}, "trained", 640, True),
        ({"base": 0.7, "rescaled": 0.7, "trained": 0.7}, "trained", 640, True),
    ],
)
def test_the_best_score_decides_what_is_written(compared, scores, chosen, longer_side_px, is_trained):
    """The base network has one score at its own scale and another at the scale of the labels."""
    result, written = compared(**scores)
    assert {name: column["score"] for name, column in result.accuracy.items()} == pytest.approx(scores)
    assert result.chosen == chosen
    assert written[:-1] == [(fine_tune.CHECKED, 640, False), (fine_tune.CHECKED, 640, True)]
    assert written[-1] == ("mine.onnx", longer_side_px, is_trained)
    second = ["Training segmenter (2 of 2, on all labels)"] * is_trained
    assert started == ["Training segmenter (1 of 2)", *second]


@pytest.mark.parametrize(
    ("chosen", "sentences"),
    [
        ("base", ("The base network has the best score", "written without training, with its own scale")),
        ("rescaled", ("The base network at the new scale has the best", "with the scale of the labels")),
        ("trained", ("The trained network has the best score", "from step 8 of 10", "trained again")),
    ],
)
def test_the_command_says_which_networks_it_compares(tmp_path, monkeypatch, capsys, chosen, sentences):
    columns = {
        name: {"mean_iou": iou, "ap50": 0.9, "score": (iou + 0.9) / 2}
        for name, iou in (("base", 0.736), ("rescaled", 0.908), ("trained", 0.8))
    }
    names, parts = {"beak": "bill_tip", "neck_base": ""}, {"training": 7, "holdout": 2, "gap": 1}
    result = fine_tune.FineTuned(columns, chosen, [], parts, "held out by blocks of time", names, 8, 10)
    monkeypatch.setattr(fine_tune, "fine_tune", lambda *_files, **_options: result)
    command = ["train", "segmenter", "--labels", "labels.json", "--out", str(tmp_path / "mine.onnx")]
    assert main([*command, "--frames", str(tmp_path / "simulated")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    for sentence in (
        *("20 simulated scenes will be filmed into", "beak from bill_tip, neck_base from new weights"),
        *("score: mean of rows 1 and 2 │ 0.818 │ 0.904 │ 0.850", *sentences),
    ):
        assert sentence in said


def test_simulated_keypoints_take_the_names_of_the_labels(data, tmp_path):
    frames = load_frames(tmp_path / "training" / "frames")
    points = np.arange(6 * 2 * 20 * 2, dtype=np.float32).reshape(6, 2, 20, 2)
    visibility = np.stack([np.full((6, 20), 2, np.uint8), np.zeros((6, 20), np.uint8)], 1)
    mapped = frames._replace(keypoints_px=points, visibility=visibility, keypoint_names=MURRE_KEYPOINTS)
    mapped = mapped.with_keypoints(["beak", "own", "eyeR"])
    assert mapped.visibility[0].tolist() == [[2, UNKNOWN, 2], [0, 0, 0]]
    assert np.array_equal(mapped.keypoints_px[:, :, 2], points[:, :, MURRE_KEYPOINTS.index("right_eye")])


def test_accuracy_of_known_detections(data):
    holdout = data.holdout

    def shifted(pixels):
        white = np.roll(pixels[..., 0] == 250, 10, axis=1)  # a third of the square
        return [instance_of(white, 0.9, "bird")]

    found = segmenter_accuracy(shifted, holdout)
    assert found["mean_iou"] == pytest.approx(20 / 40, abs=0.03)
    assert segmenter_accuracy(lambda pixels: [], holdout) == {"mean_iou": 0.0, "ap50": 0.0}
    perfect = segmenter_accuracy(lambda pixels: [instance_of(pixels[..., 0] == 250, 0.9, "bird")], holdout)
    assert perfect["mean_iou"] > 0.93
    assert perfect["ap50"] == pytest.approx(1)

    class Detector:
        keypoint_names = ("here",)

        def __call__(self, frame, instances):
            centres = [bird.box_px[:2] + bird.box_px[2:] / 2 + (2.4, 0) for bird in instances]
            return np.array(centres, np.float32)[:, None], np.ones((len(instances), 1), np.float32)

    found = keypoint_accuracy(Detector(), holdout, {"centre": "here"})  # 8 % of the bird's length
    assert found["pck_05"] == 0
    assert found["pck_10"] == 1
    assert found["error"] == pytest.approx(8, abs=0.6)
    assert keypoint_accuracy(Detector(), holdout, {"centre": ""})["pck_10"] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--images", "film"], "--images: needs labels"),
        (["--encoder", "e.pth"], "--encoder: is no option any more"),
        (["--labels", "labels.json"], "has no bird"),
        (["--labels", "labels.json", "--base", "labels.json"], "cannot be loaded"),
        (["--labels", "labels.json", "--images", "one", "two"], "names 2 videos or folders for 1 files"),
        (["--labels", "labels.json", "--steps", "4"], "steps: is 4 (give 10 or more)"),
        (["--labels", "labels.json", "--holdout", "0.9"], "holdout: is 0.9 (give a share of 0 to 0.5)"),
        (["--labels", "labels.json", "--scenes", "-1"], "scenes: is -1 (give 0 to 900)"),
        (["--scenes", "0"], "scenes: is 0 (give 1 to 900)"),
        (["--scenes", "1", "--seed", "-1"], "seed: is -1 (give a whole number from 0)"),
    ],
)
def test_wrong_use_of_the_command(tmp_path, capsys, monkeypatch, options, message):
    write_labels(tmp_path, coco({0: [bird()]}), [0])
    monkeypatch.chdir(tmp_path)
    rejected(capsys, ["train", "segmenter", "--scenes", "0", "--out", "mine.onnx", *options], message, alone=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frame_0000.png", "labels.json"]


def test_other_files_in_the_folder_of_a_training_stay(tmp_path):
    (tmp_path / "mine.onnx.training").mkdir()
    (tmp_path / "mine.onnx.training" / "labels.json").write_text("precious")
    labels = fine_tune.LabelFiles((write_labels(tmp_path, coco({0: [bird()]}), [0]),))
    with pytest.raises(InputError, match=r"holds other files than those of a training: labels\.json"):
        fine_tune.fine_tune("segmenter", labels, tmp_path / "mine.onnx", tmp_path / "frames")
    assert (tmp_path / "mine.onnx.training" / "labels.json").read_text() == "precious"


def test_pictures_are_read_before_scenes_are_filmed(tmp_path, monkeypatch, caplog):
    """Pictures that do not fit the labels are reported at once, and an interruption says how to continue."""
    file = write_labels(tmp_path / "labels", coco({t: [bird()] for t in TIMES}), [])
    empty, out, scenes = tmp_path / "film", tmp_path / "mine.onnx", tmp_path / "scenes"
    write_labels(empty, coco({900: [bird()]}), [900])
    settings = fine_tune.Settings(holdout=0, scenes=1)

    def interrupted(*_arguments, **_options):
        (tmp_path / "mine.onnx.training" / fine_tune.CHECKPOINT).touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(fine_tune, "film_scenes", interrupted)
    with pytest.raises(InputError, match=r"no picture of the labels is in .*film, .*, for example frame_0000.png"):
        fine_tune.fine_tune("segmenter", LabelFiles((file,), (empty,)), out, scenes, settings)
    write_labels(file.parent, coco({t: [bird()] for t in TIMES}), list(TIMES)[1:])
    with pytest.raises(KeyboardInterrupt):
        fine_tune.fine_tune("segmenter", LabelFiles((file,)), out, scenes, settings)
    first, last = (record.getMessage() for record in caplog.records)
    assert first.startswith("1 of 8 labelled pictures are not used, for example labels.json: frame_0000.png")
    assert last.endswith("mine.onnx.training holds the work so far; the same command continues there")


def test_labels_with_too_few_visible_keypoints_are_one_error(tmp_path):
    points = [45, 35, 2, 65, 55, 1, 50, 40, 1, 55, 45, 1]
    labels = coco({t: [bird(keypoints=points)] for t in TIMES}, ["beak", "tail", "wingL", "wingR"])
    file = write_labels(tmp_path / "labels", labels, list(TIMES))
    settings = fine_tune.Settings(scenes=0)
    with pytest.raises(InputError, match="no bird of the training part has 4 visible keypoints"):
        fine_tune.fine_tune("keypoints", LabelFiles((file,)), tmp_path / "mine.onnx", "", settings)


@pytest.mark.extended
def test_command_after_a_kill(tmp_path):
    """A killed training continues, and the result is that of an uninterrupted training."""
    labels = write_labels(tmp_path / "labels", coco({t: [bird(40 + t // 20, 30)] for t in TIMES}), list(TIMES))
    # this network is not used, so it sees few pictures
    few = (
        "from jaxfit.learning.networks import fine_tune, network_files; network_files.MAX_PICTURES = 20; "
        "usual = fine_tune.default_schedule; fine_tune.default_schedule = lambda *x: usual(*x)._replace(batch=1)"
    )
    run = f"{few}; from jaxfit.cli.main import run; run()"
    options = ["train", "segmenter", "--labels", str(labels), "--holdout", "0", "--scenes", "0", "--steps", "10"]
    command = [sys.executable, "-c", run, *options]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    whole, parts = tmp_path / "whole.onnx", tmp_path / "parts.onnx"
    done = subprocess.run([*command, "--out", str(whole)], env=environment, capture_output=True, text=True, check=True)
    assert "torchvision" not in done.stderr  # a warning of the exporter
    assert "nothing is held out" in done.stdout
    state = tmp_path / "parts.onnx.training" / "checkpoint.pt"
    process = subprocess.Popen([*command, "--out", str(parts)], env=environment, start_new_session=True)
    while not state.exists() and process.poll() is None:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not parts.exists()
    assert torch.load(state, weights_only=True)["step"] < 10
    subprocess.run([*command, "--out", str(parts)], env=environment, check=True)
    assert parts.read_bytes() == whole.read_bytes()
    assert not state.parent.exists()
    assert OnnxModel(whole).metadata["trained_on"].startswith("8 labelled pictures")
