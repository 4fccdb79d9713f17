"""The built-in network that detects keypoints from outlines: rendered murres, imperfect masks, observations."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.instances import rectangle_instance

from jaxfit.config.perception import KeypointsConfig, SegmenterConfig, TrackConfig
from jaxfit.data.masks import box_of_mask, encode_mask
from jaxfit.data.observations import FROM_OUTLINE, Observations
from jaxfit.model.anatomy import AVES_KEYPOINTS, mirror_pairs
from jaxfit.model.files import load_murre
from jaxfit.model.kinematics import fold_bird, joint_transforms, posed_keypoints, posed_vertices, rest_pose
from jaxfit.perception.detections import keypoint_name
from jaxfit.perception.keypoints import (
    OUTLINE_MARGIN,
    OUTLINE_PATH,
    crop_outline,
    load_keypoint_detector,
    with_outline_keypoints,
)
from jaxfit.perception.network import instance_of
from jaxfit.raster.zbuffer import hard_mask

SIDE = 200
NAMES = AVES_KEYPOINTS
PAIRS = np.array(mirror_pairs(NAMES))


@pytest.fixture(scope="module")
def detector():
    return load_keypoint_detector("outline")


@pytest.fixture(scope="module")
def murre():
    """Vertices and keypoints of the resting murre, model units."""
    bird = load_murre()
    rig, pose = fold_bird(bird), rest_pose(bird)
    A = joint_transforms(rig, pose)
    points = np.asarray(posed_keypoints(rig, A, pose))[[bird.keypoint_names.index(name) for name in NAMES]]
    return np.asarray(posed_vertices(rig, A, pose)), points, np.asarray(bird.faces)


def seen(murre, heading_deg, elevation_deg=5.0):
    """Return the mask and the keypoints of a standing murre; 0° is a murre with the bill away from the camera."""
    vertices, points, faces = murre
    turn = Rotation.from_euler("x", 90 + elevation_deg, degrees=True) * Rotation.from_euler(
        "zx", [heading_deg, 45], degrees=True
    )
    # x right, y down, z forward
    screen = [part @ turn.as_matrix().T * 7 + [SIDE / 2, SIDE / 2, 1000] for part in (vertices, points)]
    return hard_mask(screen[0].astype(np.float32), faces, SIDE, SIDE), screen[1][:, :2]


def detected(detector, mask):
    points_px, confidence = detector(np.zeros((*mask.shape, 3), np.uint8), [instance_of(mask, 1.0, "")])
    return points_px[0], confidence[0]


def test_the_file(detector):
    assert detector.keypoint_names == NAMES
    assert detector.sees_outlines
    assert detector.curve is not None
    assert OUTLINE_PATH.stat().st_size < 4_200_000


@pytest.mark.parametrize("heading_deg", [60, 90, 120, 240, 270, 300])
def test_head_and_tail_of_a_rendered_bird(detector, murre, heading_deg):
    mask, truth = seen(murre, heading_deg)
    points_px, _ = detected(detector, mask)
    length = max(box_of_mask(mask)[2:])
    error = np.linalg.norm(points_px - truth, axis=-1) / length
    for name in ("bill_tip", "crown", "tail_tip", "breast"):
        assert error[NAMES.index(name)] < 0.15, name


def test_a_mirrored_outline_has_exchanged_sides(detector, murre):
    mask, _ = seen(murre, 70)
    points_px, confidence = detected(detector, mask)
    mirrored_px, mirrored_confidence = detected(detector, mask[:, ::-1])
    other = np.arange(len(NAMES))
    other[PAIRS] = PAIRS[:, ::-1]
    back = (mirrored_px * [-1, 1] + [SIDE, 0])[other]
    assert np.median(np.linalg.norm(back - points_px, axis=-1)) < 0.05 * SIDE
    assert np.abs(mirrored_confidence[other] - confidence).mean() < 0.15


def test_masks_that_tell_little(detector, murre):
    """Five pixels, one pixel, and a mask that the border cuts: finite points, no confidence for nothing."""
    shape = (SIDE, SIDE, 3)
    dot, pixel = rectangle_instance(100, 100, 5, 1), rectangle_instance(0, SIDE - 1, 1, 1)
    points_px, confidence = detector(np.zeros(shape, np.uint8), [dot, pixel])
    assert np.isfinite(points_px).all()
    assert (confidence >= 0).all()
    assert confidence.mean() < 0.5
    whole, truth = seen(murre, 90)
    column = int(truth[NAMES.index("back"), 0])
    half = whole[:, column:] if truth[NAMES.index("bill_tip"), 0] > column else whole[:, :column]
    points_px, confidence = detected(detector, np.ascontiguousarray(half))
    assert np.isfinite(points_px).all()
    tail, crown = NAMES.index("tail_tip"), NAMES.index("crown")
    assert confidence[tail] < confidence[crown]


def test_the_picture_of_an_outline():
    """The bird, another bird, and what lies outside the frame, in three channels."""
    bird, other = rectangle_instance(0, 10, 20, 20), rectangle_instance(20, 10, 10, 20)
    picture, crop = crop_outline((40, 60), [bird, other], 0, (26, 26))
    margin = round(OUTLINE_MARGIN * 20)
    assert (crop.x0, crop.y0, crop.width) == (-margin, 10 - margin, 26)
    inside = np.zeros((26, 26, 3), bool)
    inside[margin:-margin, margin:-margin, 0] = inside[margin:-margin, -margin:, 1] = inside[:, :margin, 2] = True
    np.testing.assert_array_equal(picture > 0, inside)


def observations(masks):
    """Return two birds in one frame: one has a keypoint, the other one has a mask only."""
    confidence = np.zeros((2, 1, len(NAMES)))
    confidence[0, 0, 3] = 0.5
    return Observations(
        track_id=np.array([1, 2]),
        frame_index=np.array([0]),
        present=np.ones((2, 1), bool),
        keypoints_px=np.full((2, 1, len(NAMES), 2), 7.0),
        confidence=confidence,
        box_px=np.ones((2, 1, 4)),
        image_size_px=np.full((1, 2), SIDE),
        file_name=np.array(["0.png"]),
        keypoint_names=NAMES,
        masks={(n, 0): encode_mask(mask) for n, mask in enumerate(masks)},
    )


def test_keypoints_of_masks_alone(detector, murre):
    mask, _ = seen(murre, 90)
    given = observations([np.zeros_like(mask), mask])
    found = with_outline_keypoints(given)
    np.testing.assert_array_equal(found.confidence[0], given.confidence[0])
    points_px, confidence = detected(detector, mask)
    np.testing.assert_allclose(found.keypoints_px[1, 0], points_px, atol=1e-3)
    np.testing.assert_allclose(found.confidence[1, 0], confidence, atol=1e-5)
    assert found.keypoint_origin.tolist() == [[0], [FROM_OUTLINE]]
    empty = with_outline_keypoints(observations([np.zeros_like(mask)] * 2))
    assert not empty.confidence[1].any()
    assert not empty.keypoint_origin.any()
    renamed = dataclasses.replace(given, keypoint_names=tuple(f"p{k}" for k in range(len(NAMES))))
    assert with_outline_keypoints(renamed) is renamed


@pytest.mark.parametrize(
    ("segmenter", "keypoints", "name"),
    [
        ("auto", "auto", "builtin"),
        ("builtin", "auto", "builtin"),
        ("own.onnx", "auto", "builtin"),
        ("general-s", "auto", "outline"),
        ("boxes.onnx+masks.onnx", "auto", "outline"),
        ("general", "builtin", "builtin"),
        ("builtin", "outline", "outline"),
    ],
)
def test_which_network_auto_is(segmenter, keypoints, name):
    config = TrackConfig(segmenter=SegmenterConfig(file=segmenter), keypoints=KeypointsConfig(file=keypoints))
    assert keypoint_name(config) == name
