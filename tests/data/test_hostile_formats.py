"""Damaged files of DeepLabCut, SLEAP and annotation programs: a success or one clear error, within bounds."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.hostile import Isolated, many_examples
from support.label_files import labelled_birds, write_label_file
from support.mutations import HOSTILE_VALUES, damaged_arrays, damaged_bytes, damaged_tree
from support.tracking_files import project, write_analysis, write_csv, write_fixed, write_project, write_table

READER = "support.format_calls:read_sized"
PICTURES = [f"labeled-data/clip/img{i}.png" for i in range(4)]
WRITERS = {
    "csv": lambda path: write_csv(path, ("b1", "b2")),
    "labels csv": lambda path: write_csv(path, coords=("x", "y"), rows=PICTURES),
    "table": write_table,
    "fixed": lambda path: write_fixed(path, PICTURES),
    "analysis": lambda path: write_analysis(path, ("track", "xy", "node", "frame")),
    "project": write_project,
}


@pytest.fixture(scope="module")
def reader():
    with Isolated(READER) as reader:
        yield reader


@pytest.mark.parametrize("kind", WRITERS)
def test_damaged_bytes(tmp_path, reader, kind):
    path = WRITERS[kind](tmp_path / "file")

    @many_examples
    @given(damaged_bytes(path.read_bytes()))
    def check(content):
        path.write_bytes(content)
        outcome = reader(path)
        assert outcome.acceptable, outcome

    check()


@st.composite
def damaged_projects(draw):
    """Return the parts of a project with hostile cells in its tables, or hostile JSON."""
    parts = project()
    if draw(st.booleans()):
        parts["metadata"] = json.loads(json.dumps(draw(damaged_tree(parts["metadata"])), default=str))
        video = draw(damaged_tree(json.loads(parts["videos_json"][0])))
        parts["videos_json"] = [json.dumps(video, default=str)]
        parts["tracks_json"] = [json.dumps(draw(st.sampled_from(HOSTILE_VALUES)), default=str), "[0"]
        return parts
    if draw(st.booleans()):
        tables = {name: parts[name] for name in ("frames", "instances", "points", "pred_points")}
        damaged = draw(damaged_arrays(tables))
        return parts | {name: damaged.get(name, np.zeros(3)) for name in tables}
    for _ in range(draw(st.integers(1, 4))):
        table = parts[draw(st.sampled_from(("frames", "instances", "pred_points")))]
        column = draw(st.sampled_from(table.dtype.names))
        value = draw(st.sampled_from((0, 1, 2, 7, 255, 2**31 - 1, 2**62, np.nan, np.inf, -1, 1e300)))
        with np.errstate(all="ignore"):
            table[column][draw(st.integers(0, len(table) - 1))] = np.array(value).astype(table.dtype[column])
    return parts


def test_damaged_projects(tmp_path, reader):
    @many_examples
    @given(damaged_projects())
    def check(parts):
        try:
            path = write_project(tmp_path / "birds.slp", parts)
        except (TypeError, ValueError, OSError):  # HDF5 cannot hold the values
            return
        outcome = reader(path)
        assert outcome.acceptable, outcome

    check()


def test_damaged_exports(tmp_path, reader):
    image = {"id": 1, "width": 30, "height": 20, "file_name": "frame_01.png"}
    bird = {"id": 1, "image_id": 1, "category_id": 1, "keypoints": [3, 4, 2, 0, 0, 0], "num_keypoints": 1}
    bird |= {"bbox": [3, 4, 0, 0], "attributes": {"track_id": 2}, "iscrowd": 0, "segmentation": []}
    category = {"id": 1, "name": "bird", "keypoints": ["beak", "tail"], "skeleton": [[1, 2]]}
    images = [image, image | {"id": 2, "file_name": "frame_02.png"}]
    content = {"images": images, "categories": [category], "annotations": [bird, bird | {"id": 2, "image_id": 2}]}

    @many_examples
    @given(damaged_tree(content))
    def check(tree):
        (tmp_path / "export.json").write_text(json.dumps(tree, default=str))
        outcome = reader(tmp_path / "export.json")
        assert outcome.acceptable, outcome

    check()


def test_damaged_tasks_of_label_studio(tmp_path, reader):
    path = write_label_file("label studio", labelled_birds().select(frames=[0, 3]), tmp_path)

    @many_examples
    @given(damaged_tree(json.loads(path.read_text())))
    def check(tree):
        path.write_text(json.dumps(tree, default=str))
        outcome = reader(path)
        assert outcome.acceptable, outcome

    check()
