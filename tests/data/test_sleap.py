"""Files of SLEAP: projects (`.slp`) with labels and predictions, and analysis files."""

import json

import h5py
import numpy as np
import pytest
from support.tracking_files import LIKELIHOOD, NAMES, XY, T, project, write_analysis, write_project, write_table

from jaxfit.data.formats.recognise import read_observations
from jaxfit.foundation.errors import InputError

SIZE = (120, 100)


def labelled(parts, rows, **changes):
    """Turn instances into labels of persons."""
    parts["points"] = parts["pred_points"][["x", "y", "visible", "complete"]]
    parts["instances"]["instance_type"][rows] = 0
    for name, value in changes.items():
        parts["instances"][name][rows] = value


def test_predictions_of_a_project(tmp_path):
    observed = read_observations(write_project(tmp_path / "birds.slp"))
    assert observed.keypoint_names == NAMES
    assert observed.skeleton == ((0, 1), (1, 2))
    assert observed.frame_index.tolist() == [0, 10, 20, 30]
    assert observed.image_size_px[0].tolist() == list(SIZE)
    assert observed.file_name[1] == "clip.mp4#10"
    np.testing.assert_allclose(observed.keypoints_px, XY, atol=1e-5)
    np.testing.assert_allclose(observed.confidence, LIKELIHOOD, atol=1e-6)
    np.testing.assert_allclose(observed.score, 0.9, atol=1e-6)


def test_the_box_holds_all_points_that_sleap_keeps(tmp_path):
    """SLEAP removes points by a threshold of 0.2, and good points have scores below 0.6."""
    parts = project()
    parts["pred_points"]["score"] = np.tile([0.7, 0.25, 0.1], 2 * T)
    observed = read_observations(write_project(tmp_path / "birds.slp", parts))
    low, high = XY[:, :, :2].min(2), XY[:, :, :2].max(2)
    np.testing.assert_allclose(observed.box_px, np.concatenate([low, high - low], -1), atol=1e-4)


def test_labels_replace_predictions(tmp_path):
    """A label of the same track, or made from a prediction, replaces this prediction; invisible points are missing."""
    parts = project()
    parts["instances"] = np.repeat(parts["instances"], 2)
    parts["frames"]["instance_id_start"], parts["frames"]["instance_id_end"] = np.arange(0, 16, 4), np.arange(4, 20, 4)
    parts["instances"]["instance_id"] = np.arange(16)
    labelled(parts, np.arange(0, 16, 2))
    parts["points"]["x"] += 1
    parts["points"]["visible"][::3] = False
    observed = read_observations(write_project(tmp_path / "birds.slp", parts))
    assert observed.num_tracks == 2
    assert (observed.confidence[..., 0] == 0).all()
    assert (observed.confidence[..., 1:] == 1).all()
    np.testing.assert_allclose(observed.keypoints_px[:, :, 1:, 0], XY[:, :, 1:, 0] + 1, atol=1e-5)


@pytest.mark.parametrize(
    ("numbers", "named", "height"), [((0, 3), 3, 103), ((3,), 0, 103), ((3,), 3, 103), ((0, 3), 0, 100)]
)
def test_frames_of_a_package_name_its_videos_by_number_or_position(tmp_path, numbers, named, height):
    parts = project()
    parts["frames"]["video"] = named
    parts["videos_json"] = [
        json.dumps({"backend": {"filename": ".", "dataset": f"video{i}/video", "shape": [9, 100 + i, 120, 3]}})
        for i in numbers
    ]
    path = write_project(tmp_path / "a.pkg.slp", parts)
    with h5py.File(path, "a") as file:
        for i in numbers:
            file[f"video{i}/video"] = np.zeros((1, 9), np.int8)
            file[f"video{i}/video"].attrs["format"] = "png"
    assert read_observations(path).image_size_px[0].tolist() == [120, height]


@pytest.mark.parametrize("labelled", [0, 1, 2])
def test_packages_that_were_merged(tmp_path, labelled):
    """The videos of the packages share the name of their data set; the frames name one of them."""
    parts = project()
    parts["frames"]["video"] = labelled
    names = [f"/films/nest{i}.pkg.slp" for i in range(3)]
    backends = [
        {"filename": name, "dataset": "video0/video", "shape": [9, 100 + i, 120, 3]} for i, name in enumerate(names)
    ]
    parts["videos_json"] = [json.dumps({"backend": backend}) for backend in backends]
    observed = read_observations(write_project(tmp_path / "merged.slp", parts))
    assert observed.image_size_px[0].tolist() == [120, 100 + labelled]
    assert observed.file_name[0] == f"nest{labelled}.pkg.slp#0"


@pytest.mark.parametrize("frames", [T, 50])
def test_a_trimmed_analysis_file_is_announced(tmp_path, caplog, frames):
    """SLEAP may leave out the frames before the first bird and after the last one."""
    path = write_analysis(tmp_path / "a.analysis.h5", ("track", "xy", "node", "frame"))
    with h5py.File(path, "a") as file:
        file.attrs["video_backend_metadata"] = json.dumps({"shape": [frames, 100, 120, 3]})
    assert read_observations(path).frame_index.tolist() == list(range(T))
    text = f"holds {T} rows for the 50 frames of its video; its first row is taken for frame 0"
    assert (text in caplog.text) == (frames != T)


def test_birds_without_a_track(tmp_path, caplog):
    """One bird per frame is one track; otherwise every bird is a track of its own."""
    parts = project()
    labelled(parts, slice(None), track=-1)
    assert read_observations(write_project(tmp_path / "a.slp", parts)).num_tracks == 2 * T
    assert "8 birds without a track" in caplog.text
    parts["frames"]["instance_id_end"] -= 1
    alone = read_observations(write_project(tmp_path / "b.slp", parts))
    np.testing.assert_allclose(alone.keypoints_px, XY[:1], atol=1e-5)


def test_positions_of_the_first_format(tmp_path):
    parts = project() | {"format_id": 1.0}
    parts["instances"] = parts["instances"][list(parts["instances"].dtype.names[:-1])]  # without the tracking score
    observed = read_observations(write_project(tmp_path / "a.slp", parts))
    np.testing.assert_allclose(observed.keypoints_px, XY - 0.5, atol=1e-5)


@pytest.mark.parametrize("dims", [None, ("track", "xy", "node", "frame"), ("frame", "track", "node", "xy")])
@pytest.mark.parametrize("scores", [True, False])
def test_analysis_files(tmp_path, dims, scores):
    path = write_analysis(tmp_path / "a.analysis.h5", dims, scores)
    observed = read_observations(path, size_px=None if dims else SIZE)
    np.testing.assert_allclose(observed.keypoints_px, XY, atol=1e-5)
    np.testing.assert_allclose(observed.confidence, LIKELIHOOD if scores else 1, atol=1e-6)
    assert observed.image_size_px[0].tolist() == list(SIZE)
    assert observed.file_name[2] == "clip.mp4#2"


def change(name, value, row=0):
    def changed(parts):
        table, _, column = name.partition(".")
        if column:
            parts[table][column][row] = value
        else:
            parts[table] = value

    return changed


def two_skeletons(parts):
    parts["metadata"]["skeletons"] *= 2
    parts["instances"]["skeleton"][3] = 1


def two_videos(parts):
    parts["videos_json"] = [json.dumps({"backend": {"filename": f"/films/{name}.mp4"}}) for name in "ab"]
    parts["frames"]["video"][2] = 1


BAD = {
    "several skeletons": (two_skeletons, "holds birds with 2 skeletons: bird, bird"),
    "several videos": (two_videos, "holds birds of 2 videos: a.mp4, b.mp4 .*--video"),
    "no video": (
        change("videos_json", ['{"backend": {"filename": "/x/clip.mp4"}}']),
        "its video clip.mp4 is not in the same folder",
    ),
    "no JSON": (change("videos_json", ["{"]), "is not a SLEAP project that can be read: Expecting property name"),
    "track": (change("instances.track", 7), "is not a SLEAP project that can be read"),
    "frame twice": (change("frames.frame_idx", 20), "holds frame 20 twice"),
    "nothing": (change("frames.instance_id_end", 0, slice(None)), "holds no labels and no predictions"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_projects(tmp_path, case):
    parts = project()
    BAD[case][0](parts)
    with pytest.raises(InputError, match=BAD[case][1]):
        read_observations(write_project(tmp_path / "birds.slp", parts))


def test_one_of_several_videos(tmp_path):
    parts = project()
    two_videos(parts)
    parts["videos_json"] = [text.replace("}}", ', "shape": [9, 100, 120, 3]}}') for text in parts["videos_json"]]
    path = write_project(tmp_path / "birds.slp", parts)
    with h5py.File(path) as file:
        assert len(file["frames"]) == T
    with pytest.raises(InputError, match="does not exist"):
        read_observations(path, video=tmp_path / "b.mp4")  # the birds of this video are chosen first


def damage(name, change_file, tmp_path, write):
    path = write(tmp_path / name)
    with h5py.File(path, "a") as file:
        change_file(file)
    return path


def external_link(file):
    del file["tracks"]
    file["tracks"] = h5py.ExternalLink("/etc/passwd", "/x")


def external_storage(file):
    shape = file["tracks"].shape
    del file["tracks"]
    file.create_dataset("tracks", shape, "u1", external=[("/etc/passwd", 0, 48)])


def virtual(file):
    layout = h5py.VirtualLayout((2, 2, 3, T), "f8")
    del file["tracks"]
    file.create_virtual_dataset("tracks", layout)


def huge(file):
    del file["tracks"]
    file.create_dataset("tracks", (10**5, 2, 10**5, 10**3), "f8", chunks=(1, 2, 3, 4))


HOSTILE = {
    "external link": (external_link, "tracks is stored outside the file"),
    "external storage": (external_storage, "tracks is stored outside the file"),
    "virtual": (virtual, "tracks is stored outside the file"),
    "huge": (huge, "tracks needs 160,000,000,000,000 bytes, too many for its file"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_hdf5(tmp_path, case):
    path = damage("a.analysis.h5", HOSTILE[case][0], tmp_path, write_analysis)
    with pytest.raises(InputError, match=HOSTILE[case][1]):
        read_observations(path, size_px=SIZE)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tracks", np.zeros((2, 3, 4))),
        ("tracks", np.zeros((1, 2, 2, 3, 4))),
        ("tracks", np.zeros((2, 3, 3, 4))),
        ("tracks", np.zeros((2, 2, 3, 0))),
        ("tracks", np.array([b"a", b"b"])),
        ("node_names", np.array([b"a"])),
        ("node_names", np.array([b"a", b"b", b"\xff"])),
        ("track_names", np.array([b"x"])),
        ("point_scores", np.zeros((1, 2))),
        ("instance_scores", np.zeros(3)),
        ("edge_inds", np.array([[0, 99]])),
    ],
)
def test_an_analysis_file_of_other_shapes(tmp_path, name, value):
    path = write_analysis(tmp_path / "a.analysis.h5")
    with h5py.File(path, "a") as file:
        if name in file:
            del file[name]
        file[name] = value
    with pytest.raises(InputError, match=r"a\.analysis\.h5: is not an .* that can be read") as error:
        read_observations(path, size_px=SIZE)
    assert str(error.value).isprintable()


def test_a_damaged_heap_of_texts_ends_with_an_error(tmp_path):
    """The HDF5 library never returns from an object without a size."""
    path = write_analysis(tmp_path / "a.h5", ("track", "xy", "node", "frame"))
    content = bytearray(path.read_bytes())
    heap = content.index(b"GCOL") + 16
    content[heap : heap + 16] = bytes(16)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"its heap of texts at byte [\d,]+ is not valid"):
        read_observations(path)


def test_other_hdf5_files(tmp_path):
    path = damage("a.h5", lambda file: file["df_with_missing"].attrs.pop("pandas_type"), tmp_path, write_table)
    with pytest.raises(InputError, match="is an HDF5 file of no known format: it holds df_with_missing"):
        read_observations(path, size_px=SIZE)
