"""Small files of DeepLabCut and SLEAP, written by h5py in the layouts of PyTables and SLEAP."""

import json
import pickle

import h5py
import numpy as np

NAMES = ("beak", "tailTip", "L_wing")
T = 4
XY = np.random.default_rng(0).uniform(10, 90, (2, T, 3, 2)).round(3)
"""Positions of two birds with three keypoints over four frames."""
LIKELIHOOD = np.random.default_rng(1).uniform(0.7, 1, (2, T, 3)).round(3)


def columns(birds=("",), coords=("x", "y", "likelihood")):
    """Return the columns of DeepLabCut; an empty name of a bird means a file of one animal."""
    return [("net", *filter(None, [bird]), name, coord) for bird in birds for name in NAMES for coord in coords]


def values(birds=1, coords=("x", "y", "likelihood")):
    """Return the (T, columns) values of the first birds."""
    table = np.concatenate([XY, LIKELIHOOD[..., None]], -1)[:birds, :, :, : len(coords)]
    return table.transpose(1, 0, 2, 3).reshape(T, -1)


def write_csv(path, birds=("",), coords=("x", "y", "likelihood"), rows=None, index_cells=1):
    """Write the CSV of DeepLabCut; rows are frame numbers or pictures (with folders for three cells)."""
    head = columns(birds, coords)
    levels = ["scorer", *(["individuals"] if len(head[0]) == 4 else []), "bodyparts", "coords"]
    lines = [[level, *[""] * (index_cells - 1), *(c[i] for c in head)] for i, level in enumerate(levels)]
    for t, row in enumerate(values(len(birds), coords)):
        name = [str(t)] if rows is None else rows[t].split("/") if index_cells > 1 else [rows[t]]
        lines.append([*name, *("" if np.isnan(value) else repr(float(value)) for value in row)])
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return path


def write_table(path, birds=("",), names=None, index=None):
    """Write predictions in PyTables' layout `table`, whose attributes are pickles. `names` replaces the pickle."""
    head, numbers = columns(birds), values(len(birds))
    index = np.arange(T) if index is None else np.array(index, "S")
    rows = np.zeros(T, [("index", index.dtype), ("values_block_0", "f8", (len(head),))])
    rows["index"], rows["values_block_0"] = index, numbers
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_(b"frame_table")
        group.attrs["info"] = np.bytes_(pickle.dumps({1: {"names": ["scorer", "bodyparts", "coords"]}}, 0))
        table = group.create_dataset("table", data=rows, chunks=(64,), maxshape=(None,))
        table.attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(head, 0) if names is None else names)
    return path


def write_fixed(path, pictures):
    """Write labels in PyTables' layout `fixed`, with rows of three levels: `labeled-data`, the folder, the picture."""
    head, numbers = columns(coords=("x", "y")), values(1, ("x", "y"))
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"], group.attrs["nblocks"] = np.bytes_(b"frame"), 1
        group["block0_values"] = numbers
        for axis, entries in (("block0_items", head), ("axis1", [tuple(p.split("/")) for p in pictures])):
            group.attrs[f"{axis}_variety"], group.attrs[f"{axis}_nlevels"] = np.bytes_(b"multi"), 3
            for i in range(3):
                level = sorted({entry[i] for entry in entries})
                group[f"{axis}_level{i}"] = np.array(level, "S")
                group[f"{axis}_label{i}"] = np.array([level.index(entry[i]) for entry in entries], np.int8)
    return path


def write_analysis(path, dims=None, scores=True):
    """Write an analysis file of SLEAP; without `dims` and scores as its first versions did."""
    axes = ("track", "frame", "node", "xy")
    with h5py.File(path, "w") as file:
        for name, array in (("tracks", XY), ("point_scores", LIKELIHOOD), ("instance_scores", np.ones((2, T)))):
            if name == "tracks" or scores:
                used = [axis for axis in dims or ("track", "xy", "node", "frame") if axis in axes[: array.ndim]]
                file.create_dataset(name, data=array.transpose([axes.index(a) for a in used]), compression="gzip")
                if dims:
                    file[name].attrs["dims"] = json.dumps(used)
        file["node_names"], file["track_names"] = np.array(NAMES, "S"), np.array(["a", "b"], "S")
        file["track_occupancy"] = np.ones((T, 2), np.uint8)
        file["video_path"] = "clip.mp4"
        if dims:
            file.attrs["video_backend_metadata"] = json.dumps({"shape": [T, 100, 120, 3]})
    return path


INSTANCE = np.dtype(
    [
        *(("instance_id", "i8"), ("instance_type", "u1"), ("frame_id", "u8"), ("skeleton", "u4"), ("track", "i4")),
        *(("from_predicted", "i8"), ("score", "f4"), ("point_id_start", "u8"), ("point_id_end", "u8")),
        ("tracking_score", "f4"),
    ]
)
FRAME = np.dtype([(name, "u8") for name in ("frame_id", "video", "frame_idx", "instance_id_start", "instance_id_end")])


def project():
    """Return the parts of a SLEAP project: in every frame two predictions, with the tracks a and b."""
    instances, points = [], []
    for t in range(T):
        for n in range(2):
            start = len(points)
            points += [(*XY[n, t, k], True, True, LIKELIHOOD[n, t, k]) for k in range(3)]
            instances.append((2 * t + n, 1, t, 0, n, -1, 0.9, start, start + 3, 0))
    point = [("x", "f8"), ("y", "f8"), ("visible", "?"), ("complete", "?")]
    kind = {"py/reduce": [{"py/type": "sleap.skeleton.EdgeType"}, {"py/tuple": [1]}]}
    links = [{"source": 2, "target": 0, "type": kind}, {"source": 0, "target": 1, "type": {"py/id": 1}}]
    skeleton = {"graph": {"name": "bird"}, "links": links, "nodes": [{"id": 2}, {"id": 0}, {"id": 1}]}
    nodes = [{"name": NAMES[1]}, {"name": NAMES[2]}, {"name": NAMES[0]}]
    video = {"backend": {"filename": "clip.mp4", "shape": [50, 100, 120, 3]}}
    return {
        "frames": np.array([(t, 0, 10 * t, 2 * t, 2 * t + 2) for t in range(T)], FRAME),
        "instances": np.array(instances, INSTANCE),
        "points": np.zeros(0, point),
        "pred_points": np.array(points, [*point, ("score", "f8")]),
        "metadata": {"skeletons": [skeleton], "nodes": nodes},
        "videos_json": [json.dumps(video)],
        "tracks_json": [json.dumps([0, "a"]), json.dumps([0, "b"])],
        "format_id": 1.2,
    }


def write_project(path, parts=None):
    """Write a SLEAP project file."""
    parts = project() if parts is None else parts
    with h5py.File(path, "w") as file:
        for name in ("frames", "instances", "points", "pred_points"):
            file[name] = parts[name]
        for name in ("videos_json", "tracks_json"):
            file.create_dataset(name, data=parts[name], dtype=h5py.string_dtype())
        group = file.create_group("metadata")
        group.attrs["format_id"] = parts["format_id"]
        group.attrs["json"] = np.bytes_(json.dumps(parts["metadata"]).encode())
    return path
