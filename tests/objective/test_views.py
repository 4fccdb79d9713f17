"""Several views in the objective: against one view, against NumPy, and the curvature against the gradient."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from support import terms_by_hand
from support.terms_by_hand import BIRD, T, posed_window, random_targets, window_pose

from jaxfit.objective.curvature import SHARED_PARAMETERS, add_rows, frame_rows
from jaxfit.objective.objective import evaluate_curvature, evaluate_terms
from jaxfit.objective.posed_window import ViewMaps
from jaxfit.objective.registry import find_term, find_terms

NAMES = ("keypoints", "keypoint_likelihood", "mask", "mask_smooth_l1")
SETTINGS = {name: {"weight": 1.0, **find_term(name).settings} for name in NAMES}
RNG = np.random.default_rng(3)
POSE, TARGETS = window_pose(), random_targets()


def seen_by(linear, offset):
    """The targets of one view, seen by several views with the same observations."""
    views = linear.shape[1]
    return dataclasses.replace(
        TARGETS,
        keypoints_px=np.concatenate([TARGETS.keypoints_px] * views, axis=1),
        confidence=np.concatenate([TARGETS.confidence] * views, axis=1),
        mask=np.stack([TARGETS.mask] * views, axis=1),
        has_mask=np.stack([TARGETS.has_mask] * views, axis=1),
        views=ViewMaps(np.float32(linear), np.float32(offset), np.float32(5)),
    )


TWO = seen_by(np.broadcast_to(np.eye(3), (T, 2, 3, 3)), np.zeros((T, 2, 3)))


@jax.jit
def values_and_curvature(pose, targets, direction):
    """The terms, and H·direction and the diagonal of H for each term."""
    window, found = posed_window(pose, targets), {}
    for name in NAMES:
        H = evaluate_curvature(window, find_terms([name]), {name: SETTINGS[name]})
        found[name] = H.product(direction), H.diagonal
    return evaluate_terms(window, find_terms(NAMES), SETTINGS), found


def test_equal_views_add_up_and_a_view_that_sees_nothing_costs_nothing():
    direction = np.float32(RNG.normal(size=frame_rows(POSE).shape))
    confidence, has_mask = TWO.confidence.copy(), TWO.has_mask.copy()
    confidence[:, BIRD.num_keypoints :], has_mask[:, 1] = 0, False
    blind = dataclasses.replace(TWO, confidence=confidence, has_mask=has_mask)
    one, both, half = (values_and_curvature(POSE, targets, direction) for targets in (TARGETS, TWO, blind))
    for name in NAMES:
        np.testing.assert_allclose(both[0][name], 2 * one[0][name], rtol=1e-5, err_msg=name)
        np.testing.assert_allclose(half[0][name], one[0][name], rtol=1e-5, err_msg=name)
        for own, expected in zip(both[1][name], one[1][name], strict=True):
            scale = float(np.abs(expected).max())
            np.testing.assert_allclose(own, 2 * expected, rtol=1e-4, atol=1e-4 * scale, err_msg=name)


def test_view_maps_give_the_pixels_of_their_cameras():
    """The affine map of a camera with another focal length, principal point, skew and pose."""
    F, c = terms_by_hand.CAMERA.focal_px, terms_by_hand.CAMERA.centre_px
    K = np.array([[1.3 * F, 4.0, c + 7], [0, 1.2 * F, c - 5], [0, 0, 1]])
    angle = 0.3
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([1.0, -2.0, 60.0])
    to_crop = np.array([[1 / F, 0, -c / F], [0, 1 / F, -c / F], [0, 0, 1]]) @ K
    targets = seen_by(np.broadcast_to(to_crop @ R, (T, 1, 3, 3)), np.broadcast_to(to_crop @ t, (T, 1, 3)))

    @jax.jit
    def seen(pose):
        window = posed_window(pose, targets)
        return window.keypoints_px, window.keypoints_cam, window.place_acceleration_px

    found, points, acceleration = seen(POSE)
    pixels = (np.asarray(points, np.float64) @ R.T + t) @ K.T
    np.testing.assert_allclose(found, pixels[..., :2] / pixels[..., 2:], rtol=2e-5)
    assert acceleration.shape == (T - 2, 3)


def test_curvature_of_views_is_that_of_automatic_differentiation():
    """H of a squared residual is 2JᵀJ; the Jacobian by formula and by JAX must agree, in two different views."""
    linear = np.eye(3) + 0.05 * RNG.normal(size=(T, 2, 3, 3))
    targets = seen_by(linear, 0.5 * RNG.normal(size=(T, 2, 3)))
    direction = np.float32(RNG.normal(size=frame_rows(POSE, SHARED_PARAMETERS).shape))
    framewise = frame_rows(POSE).shape[1]
    direction[:, framewise:] = direction[:1, framewise:]  # all rows of a shared parameter must agree

    @jax.jit
    def both(pose, direction):
        def pixels(rows):
            return posed_window(add_rows(pose, rows, SHARED_PARAMETERS), targets).keypoints_px

        _, change = jax.jvp(pixels, (jnp.zeros_like(direction),), (direction,))
        J = jnp.concatenate(posed_window(pose, targets, shared=SHARED_PARAMETERS).keypoint_jacobian_px, axis=-1)
        return change, jnp.einsum("tri,ti->tr", J, direction)

    expected, found = both(POSE, direction)
    np.testing.assert_allclose(
        found.reshape(expected.shape), expected, rtol=2e-3, atol=2e-3 * float(np.abs(expected).max())
    )


def test_skin_of_views_is_that_of_automatic_differentiation():
    """The change of the vertices on the screen by the factors of the skin and by JAX, in two different views."""
    targets = seen_by(np.eye(3) + 0.05 * RNG.normal(size=(T, 2, 3, 3)), 0.5 * RNG.normal(size=(T, 2, 3)))
    bones = ("bone_length",)
    direction = np.float32(RNG.normal(size=frame_rows(POSE, bones).shape))
    direction[:, frame_rows(POSE).shape[1] :] = direction[:1, frame_rows(POSE).shape[1] :]

    @jax.jit
    def both(pose, direction):
        def screen(rows):
            return posed_window(add_rows(pose, rows, bones), targets).vertices_screen

        skin = posed_window(pose, targets, shared=bones).skin
        return *jax.jvp(screen, (jnp.zeros_like(direction),), (direction,)), skin

    at, expected, skin = both(POSE, direction)
    B = np.pad(skin.transforms, ((0, 0), (0, 0), (0, 1), (0, 0))) + np.diag([0, 0, 0, 1])
    rest = np.pad(skin.rest, ((0, 0), (0, 1)), constant_values=1)
    points = np.einsum("vm,ivmcd,vd,vmp->ivcp", skin.weight, B[:, skin.joint], rest, skin.moved[skin.joint])
    moved = np.einsum("iab,ibcp,ivcp,ip->iva", skin.view, skin.generators, points, np.repeat(direction, 2, axis=0))
    camera = terms_by_hand.CAMERA
    moved_px = (camera.focal_px * moved[..., :2] - (at[..., :2] - camera.centre_px) * moved[..., 2:]) / at[..., 2:]
    np.testing.assert_allclose(moved_px, expected[..., :2], atol=1e-4 * float(np.abs(expected[..., :2]).max()))
