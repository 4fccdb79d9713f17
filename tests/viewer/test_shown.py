"""What the page receives is the result: poses, outlines, regions, values; a copy of the film has the same frames."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import overlays
from support.birds import error_bars
from support.viewed import shown, unpacked, write_result

from jaxfit.data.flags import flags, keypoint_distances
from jaxfit.data.formats.coco import read_coco, write_coco
from jaxfit.data.masks import encode_mask
from jaxfit.data.projection import PosedBirds
from jaxfit.foundation.errors import InputError
from jaxfit.video.reader import read_frames
from jaxfit.view.birds import DrawnBird, Style, draw_birds
from jaxfit.viewer import shown as module
from jaxfit.viewer.arrays import in_steps, pack
from jaxfit.viewer.film import write_copy
from jaxfit.viewer.shown import regions


def test_arrays_come_back():
    arrays = {
        "a": np.arange(6, dtype=np.int16).reshape(2, 3),
        "b": np.array([1.5], np.float32),
        "c": np.zeros((0, 2), np.uint8),
    }
    facts, found = unpacked(pack(arrays, {"x": [1, "ü"]}))
    assert facts == {"x": [1, "ü"]}
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    steps = in_steps(np.array([0.26, -1e9, np.nan, np.inf]), 0.1)
    assert steps.tolist() == [3, -32767, -32768, 32767]


def test_poses_place_the_joints_where_the_flock_has_them(result):
    """Forward kinematics in NumPy, as the page does it by bones, against the joints that behaviour computes."""
    seen, _ = result
    facts, poses = unpacked(seen.part(0))
    rig_facts, rig = unpacked(seen.rig())
    birds = seen.flock.birds(slice(0, overlays.T))
    np.testing.assert_array_equal(poses["valid"], seen.solution.valid)
    parents, rest = rig_facts["parents"], rig["joints"].astype(float)
    for n, t in np.argwhere(seen.solution.valid):
        turns = Rotation.from_quat(poses["turns"][n, t] * facts["turn_step"])
        place, turn = [poses["place"][n, t].astype(float)], [turns[0]]
        for j in range(1, len(parents)):
            above = parents[j]
            bone = poses["bones"][n, t, j - 1] if "bones" in poses else 1.0
            offset = bone * (rest[j] - rest[above]) * poses["size"][n, t]
            place.append(place[above] + turn[above].apply(offset))
            turn.append(turn[above] * turns[j])
        np.testing.assert_allclose(place, birds.joints[n, t], atol=2e-3 * seen.flock.model_length)


def test_the_camera_of_the_page_sees_the_birds_where_the_film_does(result):
    seen, _ = result
    camera = unpacked(seen.rig())[0]["camera"]
    R, place = np.array(camera["R_world_cam"]), np.array(camera["place"])
    focal = seen.size_px[1] / 2 / np.tan(np.radians(camera["field_deg"]) / 2)
    for n, t in np.argwhere(seen.solution.valid):
        x, y, z = R.T @ (seen.flock.place[n, t] - place)
        middle = np.array(seen.size_px) / 2 + focal * np.array([x, y]) / z
        # the root joint is inside the box of the keypoints
        low, high = (f(seen.solution.keypoints.px[n, t], axis=0) for f in (np.min, np.max))
        assert (middle > low - 5).all()
        assert (middle < high + 5).all()


def test_outlines_are_those_of_the_overlay(result):
    seen, _ = result
    facts, arrays = unpacked(seen.outlines(0))
    posed, faces = PosedBirds(seen.solution, overlays.BIRD), np.asarray(overlays.BIRD.faces)
    style, none = Style.suited(overlays.WIDTH, 100, opacity=0.0), np.zeros((0, 2))
    for t in range(overlays.T):
        drawn = np.full((overlays.HEIGHT, overlays.WIDTH, 3), 7, np.uint8)
        birds = []
        for n in np.flatnonzero(seen.solution.valid[:, t]):
            screen = posed.vertices_screen(int(n), t)
            birds.append(DrawnBird(int(n), "", screen, np.zeros_like(screen), none, none))
        draw_birds(drawn, birds, faces, style, one_camera=False)
        line = np.zeros(drawn.shape[:2], np.uint8)
        starts = np.concatenate([[0], np.cumsum(arrays["lengths"])]).astype(int)
        for i in np.flatnonzero(arrays["poses"] % facts["frames"] == t):
            points = arrays["points"][starts[i] : starts[i + 1]] * facts["step_px"]
            line[tuple(np.round(points).astype(int).T[::-1])] = 1
        drawn_line = (drawn != 7).any(-1).astype(np.uint8)
        wide = np.ones((5, 5), np.uint8)
        assert line.sum() > 50 * len(birds)
        assert cv2.dilate(drawn_line, wide)[line > 0].mean() > 0.99
        assert cv2.dilate(line, wide)[drawn_line > 0].mean() > 0.99
        owners = {int(pose) // facts["frames"] for pose in arrays["poses"] if pose % facts["frames"] == t}
        assert owners == {bird.position for bird in birds}


def test_flags_and_facts(result):
    seen, _ = result
    found = unpacked(seen.flags())[1]["flags"]
    names = np.array(["", *seen.facts()["flags"]])
    np.testing.assert_array_equal(
        names[found], np.where(seen.solution.valid, flags(np.asarray(seen.solution.flags.doubts)), "")
    )
    facts = seen.facts()
    assert [track["id"] for track in facts["tracks"]] == [4, 11]
    assert facts["frames"] == list(range(overlays.FIRST, overlays.FIRST + overlays.T))
    assert facts["size_px"] == (overlays.WIDTH, overlays.HEIGHT)
    assert len({value["name"] for value in facts["values"]}) == len(facts["values"])


def test_values_over_time(result, tmp_path):
    seen, _ = result
    confidence = unpacked(seen.values("confidence"))[1]["values"]
    np.testing.assert_array_equal(np.isfinite(confidence), seen.solution.valid)
    residual = unpacked(seen.values("residual"))[1]["values"]
    assert np.nanmax(residual) < 0.01  # the detections are the projected keypoints
    folder, _ = write_result(tmp_path)
    (folder / "observations.json").unlink()
    without = shown(folder)
    assert not without.facts()["detected"]
    assert "confidence" not in [value["name"] for value in without.facts()["values"]]
    with pytest.raises(InputError, match="residual"):
        without.values("residual")
    with pytest.raises(InputError, match="is not known"):
        without.values("wing_spread")  # the toy bird has no wings


def test_why_names_the_wrong_keypoint_and_what_is_usual(tmp_path):
    """One detection is 12 px off, in a result whose other detections are the projected keypoints."""
    k, n, t, off = 3, 1, 4, np.array([12.0, 0])
    folder, _ = write_result(
        tmp_path, doubts=np.where(np.arange(overlays.T) == t, 1, 0)[None].repeat(2, 0).astype(np.int8)
    )
    seen = read_coco(folder / "observations.json")
    points = seen.keypoints_px.copy()
    points[n, t, k] += off
    write_coco(seen.with_keypoints(points, seen.confidence), folder / "observations.json")
    found = shown(folder)
    why = unpacked(found.why(n * overlays.T + t))[0]
    assert (why["flag"], why["doubts"]) == ("contradicted", ["keypoints far from the pose"])
    name, px, usual = (why["keypoints"][0][key] for key in ("name", "px", "usual_px"))
    assert name == overlays.BIRD.keypoint_names[k].replace("_", " ")
    assert px == pytest.approx(12, abs=0.1)
    assert usual < 0.1
    measures = {row["title"]: row for row in why["measures"]}
    weights = seen.confidence[n, t]
    share = 12 * weights[k] / weights.sum() / seen.box_px[n, t, 2:].max()
    assert measures["Keypoints off, of the box"] == {
        "title": "Keypoints off, of the box", "here": f"{share:.1%}", "usual": "0.0%", "bad": True,
    }  # fmt: skip
    # the flag counts a distance of half a box at most, so that one keypoint does not condemn a pose
    points[n, t, k] += 1000
    write_coco(seen.with_keypoints(points, seen.confidence), folder / "observations.json")
    far = shown(folder)
    why = unpacked(far.why(n * overlays.T + t))[0]
    assert why["keypoints"][0]["px"] > 1000
    expected = keypoint_distances(far.observations, far.solution)[n, t]
    assert expected == pytest.approx(0.5 * weights[k] / weights.sum(), abs=1e-3)
    assert why["measures"][0]["here"] == f"{expected:.1%}"
    assert unpacked(far.values("residual"))[1]["values"][n, t] == np.float32(expected)
    assert unpacked(found.why(overlays.T + 2))[0]["flag"] == "no pose"
    with pytest.raises(InputError, match="pose 12"):
        found.why(12)
    (folder / "observations.json").unlink()
    without = unpacked(shown(folder).why(0))[0]
    assert (without["flag"], without["keypoints"]) == ("ok", [])


def test_outline_agreement_is_the_iou_of_mesh_and_mask(tmp_path):
    """Masks are the meshes; the mask of one pose lacks its lower half."""
    folder, _ = write_result(tmp_path)
    seen, solution = read_coco(folder / "observations.json"), overlays.solution()
    posed, faces, masks = PosedBirds(solution, overlays.BIRD), np.asarray(overlays.BIRD.faces), {}
    for n, t in np.argwhere(solution.valid).tolist():
        mask = np.zeros((overlays.HEIGHT, overlays.WIDTH), np.uint8)
        for face in posed.vertices_screen(n, t)[:, :2][faces]:
            cv2.fillConvexPoly(mask, np.round(face - 0.5).astype(int), 1)
        masks[n, t] = mask > 0
    whole, (rows, _) = masks[0, 1].sum(), np.nonzero(masks[0, 1])
    masks[0, 1][int(np.median(rows)) :] = False
    seen = dataclasses.replace(seen, masks={cell: encode_mask(mask) for cell, mask in masks.items()})
    write_coco(seen, folder / "observations.json")
    measures = {row["title"]: row for row in unpacked(shown(folder).why(1))[0]["measures"]}
    here, usual = (float(measures["Outline agreement (IoU)"][key].rstrip("%")) for key in ("here", "usual"))
    assert here == pytest.approx(100 * masks[0, 1].sum() / whole, abs=6)
    assert usual > 85


def test_regions_are_the_axes_of_the_covariance(tmp_path):
    angle, long, short = np.radians(30), 3.0, 1.0
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = turn @ np.diag([long**2, short**2]) @ turn.T
    found = regions(np.stack([covariance, np.full((2, 2), np.nan)])[None, None])[0, 0]
    assert found[1].tolist() == [-32768] * 3
    assert found[0][:2] / 64 == pytest.approx([long, short], abs=0.01)
    assert found[0][2] / 100 % 180 == pytest.approx(30, abs=0.01)
    folder, _ = write_result(tmp_path, **error_bars(overlays.solution()))
    assert "regions" in unpacked(shown(folder).part(0))[1]


def test_parts_of_any_length_hold_all_frames(result, monkeypatch):
    seen, _ = result
    whole = unpacked(seen.part(0))[1]
    monkeypatch.setattr(module, "FRAMES", 4)
    monkeypatch.setattr(module, "POSED_FRAMES", 3)
    short = shown(seen.folder)
    assert short.parts == 2
    parts = [unpacked(short.part(i))[1] for i in range(2)]
    for name, values in whole.items():
        np.testing.assert_array_equal(np.concatenate([part[name] for part in parts], axis=1), values)
    outlines = [unpacked(short.outlines(i))[1] for i in range(2)]
    assert sum(len(part["points"]) for part in outlines) == len(unpacked(seen.outlines(0))[1]["points"])
    with pytest.raises(InputError, match="part 2"):
        short.part(2)


def test_a_copy_of_the_film_has_the_frames_of_the_result(result, tmp_path):
    _, video = result
    numbers = np.array([3, 5, 9])
    times = write_copy(video, numbers, tmp_path / "copy.mp4", max_width=160)
    copied = list(read_frames(tmp_path / "copy.mp4"))
    assert [frame.picture.shape[:2] for frame in copied] == [(100, 160)] * 4  # frame 7 is in a gap
    assert times * overlays.FPS / 2 == pytest.approx([0, 1, 3])
