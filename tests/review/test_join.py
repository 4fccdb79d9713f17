"""`join`: results of ranges of one video become one result, and tracks continue across the cuts."""

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
from support.cli_files import rejected
from support.fits import BIRD, config

import jaxfit
from jaxfit.cli.main import main
from jaxfit.config.yaml_file import config_to_yaml
from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.solution import LAYOUT, Solution
from jaxfit.review.join import join_results, link_tracks

CONFIG = config(window=6, steps=(5, 1))
SIDE, BODY = 640, 40.0


def birds(centres, frames, ids, sizes=None, first=0):
    """Return observations of birds at centres (N, T, 2) in pixels, NaN where a bird is absent."""
    centres = np.asarray(centres, float)
    present = np.isfinite(centres[..., 0])
    size = np.broadcast_to(BODY if sizes is None else np.asarray(sizes, float)[:, None], present.shape)
    box = np.concatenate([centres - size[..., None] / 2, np.repeat(size[..., None], 2, axis=-1)], axis=-1)
    points = np.repeat(centres[:, :, None], BIRD.num_keypoints, axis=2)
    t = len(frames)
    return Observations(
        track_id=np.array(ids),
        frame_index=np.asarray(frames),
        present=present,
        keypoints_px=np.nan_to_num(points),
        confidence=np.repeat(present[..., None], BIRD.num_keypoints, axis=2).astype(np.float32),
        box_px=np.nan_to_num(box),
        image_size_px=np.full((t, 2), SIDE),
        file_name=np.array([f"{number}.png" for number in frames]),
        keypoint_names=BIRD.keypoint_names,
        masks={
            (int(n), int(t)): encode_mask(np.ones((SIDE, SIDE), bool))
            for n, t in zip(*np.nonzero(present), strict=True)
        },
        fps=25.0,
        timestamp_s=np.asarray(frames) / 25,
    )


def walk(start, frames, seed):
    """A random walk of 0.3 pixels a frame."""
    steps = 0.3 * np.random.default_rng(seed).normal(size=(frames, 2))
    return np.asarray(start) + np.cumsum(steps, axis=0)


def scene(ids=((3, 5), (1, 9, 4)), cut=30, frames=60):
    """Two ranges of one scene: birds A and B stay, bird C comes in the second range. Ids are those of each range."""
    a, b, c = walk((100, 100), frames, 0), walk((400, 300), frames, 1), walk((200, 500), frames, 2)
    first = birds([a[:cut], b[:cut]], range(cut), ids[0])
    second = birds([b[cut:], c[cut:], a[cut:]], range(cut, frames), ids[1])
    return first, second


def solution_of(observed, seed):
    """A result with random poses where the bird is present, and a status for each track."""
    rng = np.random.default_rng(seed)
    sizes = {"N": observed.num_tracks, "T": observed.num_frames, "bones": BIRD.num_joints - 1, "S": BIRD.num_shapes}
    sizes |= {"K": BIRD.num_keypoints, "2": 2, "3": 3}
    cells = {}
    for name, (shape, dtype) in LAYOUT.items():
        if shape.startswith("N T") and dtype is np.float32:
            cells[name] = rng.uniform(0.5, 2, [sizes[axis] for axis in shape.split()]).astype(np.float32)
            cells[name][~observed.present] = np.nan
    image = np.where(observed.present[..., None], SIDE, 0) * np.ones(2, np.int64)
    return Solution.from_arrays(
        track_id=observed.track_id,
        frame_index=observed.frame_index,
        valid=observed.present,
        **cells,
        image_size_px=image,
        focal_px=2167.0,
        crop_px=256,
        keypoint_names=BIRD.keypoint_names,
        joint_names=BIRD.joint_names,
        loss={"keypoints": np.arange(1.0, observed.num_tracks + 1)},
        status=np.array(["ok"] * observed.num_tracks),
        timestamp_s=observed.timestamp_s,
        fps=25.0,
    )


VIDEO = {"file": "/data/clip.mp4", "size_px": [SIDE, SIDE], "frames": None, "fps": 25.0}


def write(folder, observed, seed=0, settings=CONFIG, summary=None, bird=BIRD):
    solution = solution_of(observed, seed)
    content = {"video": VIDEO, "trust": "high", "trust_reasons": []} | (summary or {})
    jaxfit.save_solution(solution, bird, config_to_yaml(settings), content, folder)
    jaxfit.write_coco(observed, folder / "observations.json")
    return solution


@pytest.fixture
def parts(tmp_path):
    first, second = scene()
    write(tmp_path / "a", first, 0, summary={"segmenter": "builtin", "corrections": ["swap 3,5@4:9"]})
    failures = {"failures": {"9": ["frames 30 to 35: not finite"]}, "trust": "low", "trust_reasons": ["dark"]}
    write(tmp_path / "b", second, 1, summary=failures | {"video": VIDEO | {"file": "/moved/clip.mp4"}})
    return tmp_path


def test_tracks_continue_and_everything_is_copied(parts, capsys):
    """The order of the folders does not matter."""
    assert main(["join", str(parts / "b"), str(parts / "a"), "--out", str(parts / "out")]) == 0
    printed = capsys.readouterr().out
    assert "3 tracks over 60 frames" in printed
    solution, _ = jaxfit.load_solution(parts / "out")
    observed = jaxfit.read_coco(parts / "out" / "observations.json")
    assert solution.track_id.tolist() == observed.track_id.tolist() == [3, 5, 6]  # A, B and C
    first, second = scene()
    own = solution_of(first, 0), solution_of(second, 1)
    for name in LAYOUT:
        if LAYOUT[name][0].startswith("N T"):
            joined = solution.arrays()[name]
            np.testing.assert_array_equal(joined[:2, :30], own[0].arrays()[name], err_msg=name)
            np.testing.assert_array_equal(joined[[1, 2, 0], 30:], own[1].arrays()[name], err_msg=name)
    assert not solution.valid[2, :30].any()
    assert np.isnan(solution.poses.scale[2, :30]).all()
    np.testing.assert_array_equal(solution.loss["keypoints"], [1 + 3, 2 + 1, 2])
    np.testing.assert_array_equal(observed.keypoints_px[[1, 2, 0], 30:], second.keypoints_px)
    np.testing.assert_array_equal(solution.timestamp_s, np.arange(60) / 25)
    assert set(observed.masks) == {(n, t) for n in range(3) for t in range(60) if n < 2 or t >= 30}
    summary = json.loads((parts / "out" / "summary.json").read_text())
    assert (summary["trust"], summary["trust_reasons"]) == ("low", ["dark"])
    assert summary["segmenter"] == "builtin"
    assert summary["corrections"] == [f"{parts / 'a'}: swap 3,5@4:9"]
    assert summary["failures"] == {"6": ["frames 30 to 35: not finite"]}
    became = {(row["folder"][-1], row["track"]): row for row in summary["joined"]}
    assert {key: row["joined"] for key, row in became.items()} == {
        ("a", 3): 3,
        ("a", 5): 5,
        ("b", 1): 5,
        ("b", 9): 6,
        ("b", 4): 3,
    }
    assert became["b", 4]["confidence"] > 0.99
    assert (became["b", 4]["missing"], became["b", 9]["confidence"]) == (0, None)
    assert main(["tracks", str(parts / "out")]) == 0


def test_a_long_gap_is_bridged_only_on_request(tmp_path):
    whole, _ = scene(cut=59)
    first, second = whole.select(frames=np.arange(59) < 20), whole.select(frames=np.arange(59) >= 40)
    write(tmp_path / "a", first)
    write(tmp_path / "b", second)
    solution, _ = join_results([tmp_path / "a", tmp_path / "b"], tmp_path / "apart")
    assert solution.track_id.tolist() == [3, 5, 6, 7]
    solution, table = join_results([tmp_path / "a", tmp_path / "b"], tmp_path / "bridged", bridge=20)
    assert solution.track_id.tolist() == [3, 5]
    assert [row.missing for row in table] == [None, None, 20, 20]
    assert table[2].confidence < link_tracks(first, whole.select(frames=np.arange(59) == 20), 0)[0].confidence


def test_a_third_range_continues_a_bird_that_the_second_lacks(tmp_path):
    a, b = walk((100, 100), 30, 0), walk((400, 300), 30, 1)
    for name, at, present in (("a", slice(0, 10), (0, 1)), ("b", slice(10, 14), (0,)), ("c", slice(14, 30), (0, 1))):
        chosen = [(a, b)[n][at] for n in present]
        write(tmp_path / name, birds(chosen, range(30)[at], range(len(chosen))))
    solution, table = join_results([tmp_path / name for name in "abc"], tmp_path / "out")
    assert solution.track_id.tolist() == [0, 1]
    assert [(row.joined, row.missing) for row in table] == [(0, None), (1, None), (0, 0), (0, 0), (1, 4)]


def test_place_and_size_decide():
    """Two birds beside each other swap their order; a bird of another size, or far away, is another bird."""
    left, right = walk((100, 100), 20, 0), walk((100 + BODY, 100), 20, 1)
    first = birds([left, right], range(20), (1, 2))

    def later(centres, sizes=None):
        return birds(np.asarray(centres)[:, None] + np.zeros((1, 3, 1)), range(20, 23), range(len(centres)), sizes)

    links = link_tracks(first, later([right[-1], left[-1]]), 0)
    assert {(link.before, link.after) for link in links} == {(0, 1), (1, 0)}
    assert all(link.confidence > 0.99 for link in links)
    assert not link_tracks(first, later([left[-1] + 5 * BODY]), 0)
    assert not link_tracks(first, later([left[-1]], sizes=[2 * BODY]), 0)


def test_a_bird_that_may_be_two_has_a_low_confidence():
    """Both birds are equally near, so neither is preferred."""
    place = walk((100, 100), 20, 0)
    first = birds([place - 2.0, place + 2.0], range(20), (1, 2))
    later = birds(np.broadcast_to(place[-1], (1, 3, 2)), range(20, 23), (1,))
    assert not link_tracks(first, later, 0)


def test_wrong_parts_are_refused(parts, capsys, tmp_path):
    _, second = scene()

    def refused(*words, names=("a", "c"), more=()):
        folders = [str(parts / name) for name in names]
        rejected(capsys, ["join", *folders, "--out", str(parts / "out"), *more], *words)

    refused("join: has one result", names=("a",))
    refused("--bridge: is -1", names=("a", "b"), more=("--bridge", "-1"))
    rejected(capsys, ["join", str(parts / "a"), str(parts / "b"), "--out", str(parts / "b")], "is one of the results")
    write(parts / "c", replace(second, frame_index=second.frame_index - 1))
    refused("begins at frame 29", "ends at frame 29")
    cases = {
        "c2": ({"summary": {"video": VIDEO | {"file": "/data/other.mp4"}}}, "another video", "name other.mp4"),
        "c3": ({"summary": {"video": VIDEO | {"size_px": [99, 640]}}}, "another video", "instead of [640, 640]"),
        "c4": ({"bird": dataclasses.replace(BIRD, vertices=BIRD.vertices * 2)}, "another model"),
        "c5": ({"summary": {"networks": {"keypoints": {"k.onnx": "1"}}}}, "other networks"),
        "c6": ({"settings": replace(CONFIG, window=7)}, "another config", "window"),
    }
    for name, (changes, *words) in cases.items():
        write(parts / name, second, **changes)
        refused(*words, names=("a", name))
    write(parts / "c7", second, settings=replace(CONFIG, memory_gb=9.0))
    assert main(["join", str(parts / "a"), str(parts / "c7"), "--out", str(parts / "joined")]) == 0
    (parts / "c7" / "observations.json").unlink()
    refused("holds no observations.json", names=("a", "c7"))
