"""Damaged files of every format are read as what they still hold, or refused with one line.

Each format has one valid file and 20 damaged variants, always the same ones: cut off, with flipped bits, zeros,
random bytes or bytes too many; and formats of arrays and of JSON with wrong shapes, types and values. The counts are
printed by ``pytest tests/test_damaged_files.py -rP``.
"""

import copy
import io
import json
import zlib

import cv2
import numpy as np
import pytest
import scipy.io
from support import onnx_graphs, tracking_files
from support.birds import toy_bird
from support.camera_files import ANIPOSE, camera_values, cell, matlab_values, write_storage
from support.checkpoints import write_legacy
from support.coco_files import content as coco_content
from support.exported import write_result
from support.films import encode
from support.label_files import labelled_birds, write_label_file

from jaxfit.cameras.files import read_cameras
from jaxfit.config.fit import load_config
from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.solution import load_solution
from jaxfit.foundation.errors import MAX_MESSAGE_CHARACTERS, InputError
from jaxfit.model.files import load_bird, save_bird
from jaxfit.model.torch_file import read_tensors
from jaxfit.perception.segmentation import load_segmenter
from jaxfit.video.pictures import read_picture
from jaxfit.video.reader import read_frames

VARIANTS, MAT_VARIANTS = 20, 2  # a .mat file is read in a process of its own, which takes a second
VALUES = (
    None,
    True,
    -1,
    0,
    2**63,
    10**30,
    1e300,
    6e9,
    float("nan"),
    "",
    "a",
    "x" * 5000,
    "../a",
    [],
    [[]],
    {},
    [1] * 99,
)
CONFIG = "base: paper\nwindow: 6\nterms: {keypoints: 1}\nstages: [{name: only, steps: 1, terms: [keypoints]}]\n"
YOLO = {"output0": np.zeros((37, 84)), "output1": np.zeros((32, 16, 16))}


def write_coco_file(path):
    path.write_text(json.dumps(coco_content()))


def write_mat(path):
    scipy.io.savemat(path, {"params": cell([matlab_values()] * 2), "camnames": cell(["a", "b"])})


def sized(path):
    return read_observations(path, size_px=(120, 100))


# Name → (name of the file, function that writes a valid file at a path, function that reads the file).
FORMATS = {
    "result": ("poses.npz", lambda path: write_result(path.parent), lambda path: load_solution(path.parent)),
    "bird model": ("bird.npz", lambda path: save_bird(toy_bird(), path), load_bird),
    "COCO": ("birds.json", write_coco_file, read_coco),
    "Label Studio": (
        "tasks.json",
        lambda path: write_label_file("label studio", labelled_birds(), path.parent),
        sized,
    ),
    "DeepLabCut CSV": ("birds.csv", lambda path: tracking_files.write_csv(path, ("b1", "b2")), sized),
    "DeepLabCut HDF5": ("birds.h5", tracking_files.write_table, sized),
    "SLEAP analysis": ("birds.h5", tracking_files.write_analysis, sized),
    "SLEAP project": ("birds.slp", tracking_files.write_project, sized),
    "video": ("a.mp4", lambda path: encode(path, "mpeg4", count=6, gop=3), lambda path: list(read_frames(path))),
    "picture": ("a.png", lambda path: cv2.imwrite(str(path), np.zeros((48, 64, 3), np.uint8)), read_picture),
    "config": ("mine.yaml", lambda path: path.write_text(CONFIG), load_config),
    "ONNX": (
        "net.onnx",
        lambda path: onnx_graphs.write_constant(path, (1, 3, 64, 64), YOLO, {"names": "{0: 'bird'}"}),
        lambda path: load_segmenter(path, threads=1),
    ),
    "PyTorch": ("a.pt", lambda path: write_legacy(path, {"V": np.ones((4, 3), "<f4")}), read_tensors),
    "anipose": ("a.toml", lambda path: path.write_text(ANIPOSE), lambda path: read_cameras(path, "mm")),
    "OpenCV": ("a.yml", lambda path: write_storage(path, camera_values()), lambda path: read_cameras(path, "mm")),
    "OpenCV XML": ("a.xml", lambda path: write_storage(path, camera_values()), lambda path: read_cameras(path, "mm")),
    "DANNCE": ("a.mat", write_mat, lambda path: read_cameras(path, "mm")),
}


def damaged_bytes(rng, content):
    """Return a file with one kind of damage."""
    damaged = bytearray(content)
    at, length = int(rng.integers(len(content))), int(rng.integers(1, 64))
    match rng.integers(6):
        case 0:
            return content[:at]
        case 1:
            damaged[at : at + length] = bytes(length)
        case 2:
            damaged[at : at + length] = rng.bytes(length)
        case 3:
            damaged[at:at] = rng.bytes(length)
        case _:
            for place in rng.integers(len(content), size=rng.integers(1, 9)):
                damaged[place] ^= 1 << rng.integers(8)
    return bytes(damaged)


def damaged_arrays(rng, content):
    """Return an .npz with an array of another shape, another type or another value, or without an array."""
    with np.load(io.BytesIO(content)) as stored:
        arrays = dict(stored)
    name = str(rng.choice(sorted(arrays)))
    array = arrays.pop(name)
    match rng.integers(5):
        case 0:
            arrays[name] = array[None]
        case 1:
            arrays[name] = array[:0] if array.ndim else np.zeros((0, 2))
        case 2:
            arrays[name] = np.zeros(array.shape, rng.choice(["U3", "c16", "i8", "?", "f4", "S3"]))
        case 3 if array.size and array.dtype.kind in "fi":
            with np.errstate(all="ignore"):
                changed = array.reshape(-1).copy()
                changed[rng.integers(array.size)] = np.array(rng.choice([np.nan, -1, 1e38])).astype(array.dtype)
            arrays[name] = changed.reshape(array.shape)
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def damaged_json(rng, content):
    """Return JSON with another value at some place."""
    tree = copy.deepcopy(json.loads(content))
    places = []

    def visit(part):
        for key, value in list(part.items() if isinstance(part, dict) else enumerate(part)):
            places.append((part, key))
            if isinstance(value, dict | list):
                visit(value)

    visit(tree)
    part, key = places[rng.integers(len(places))]
    if rng.integers(4):
        part[key] = VALUES[rng.integers(len(VALUES))]
    else:
        del part[key]
    return json.dumps(tree).encode()


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_read_or_refused_with_one_line(tmp_path, name):
    file_name, write, read = FORMATS[name]
    path = tmp_path / "folder" / file_name
    path.parent.mkdir()
    write(path)
    read(path)
    content = path.read_bytes()
    structural = {".npz": damaged_arrays, ".json": damaged_json}.get(path.suffix, damaged_bytes)
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    refused, variants = 0, MAT_VARIANTS if path.suffix == ".mat" else VARIANTS
    for variant in range(variants):
        path.write_bytes((structural if variant % 2 else damaged_bytes)(rng, content))
        try:
            read(path)
        except InputError as error:
            message = str(error)
            assert message.isprintable()
            assert len(message) <= MAX_MESSAGE_CHARACTERS
            refused += 1
    print(f"{name}: {variants} damaged files, {variants - refused} read, {refused} refused with one line")  # noqa: T201 - shown by -rP
    path.write_bytes(b"")
    if name != "picture":  # a folder of pictures skips them
        with pytest.raises(InputError, match=file_name):
            read(path)
