"""Several views in the objective: against one view, against NumPy, and the curvature against the gradient."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit.model.camera import CropCamera
from jaxfit.objective.curvature import add_rows, frame_rows
from jaxfit.objective.objective import evaluate_curvature, evaluate_terms
from jaxfit.objective.posed_window import ViewMaps
from jaxfit.objective.registry import find_terms
from tests.support import terms_by_hand
from tests.support.terms_by_hand import BIRD, SIZE, T, posed_window, random_targets, window_pose

NAMES = ("keypoints", "keypoint_likelihood", "mask", "mask_smooth_l1")
RNG = np.random.default_rng(3)


def identity_maps(views, px_per_unit=5.0):
    linear = np.broadcast_to(np.eye(3, dtype=np.float32), (T, views, 3, 3))
    return ViewMaps(jnp.asarray(linear), jnp.zeros((T, views, 3)), jnp.float32(px_per_unit))


def repeated(targets, views):
    """The targets of one view, seen by several equal views."""

    def again(x, axis):
        return jnp.concatenate([x] * views, axis=axis)

    return dataclasses.replace(
        targets,
        keypoints_px=again(targets.keypoints_px, 1),
        confidence=again(targets.confidence, 1),
        mask=jnp.stack([targets.mask] * views, axis=1),
        has_mask=jnp.stack([targets.has_mask] * views, axis=1),
        views=identity_maps(views),
    )


@functools.partial(jax.jit, static_argnums=2)
def values(pose, targets, names=NAMES):
    settings = {name: {"weight": 1.0, **find_terms([name])[name].settings} for name in names}
    return evaluate_terms(posed_window(pose, targets), find_terms(names), settings)


def test_equal_views_add_up():
    pose, targets = window_pose(), random_targets()
    one, three = values(pose, targets), values(pose, repeated(targets, 3))
    for name in NAMES:
        assert float(three[name]) == pytest.approx(3 * float(one[name]), rel=1e-5), name


def test_a_view_that_sees_nothing_costs_nothing():
    pose, targets = window_pose(), random_targets()
    two = repeated(targets, 2)
    K = BIRD.num_keypoints
    blind = dataclasses.replace(
        two, confidence=two.confidence.at[:, K:].set(0), has_mask=two.has_mask.at[:, 1].set(False)
    )
    one, both = values(pose, targets), values(pose, blind)
    for name in NAMES:
        assert float(both[name]) == pytest.approx(float(one[name]), rel=1e-5), name


def test_view_maps_give_the_pixels_of_their_cameras():
    """The affine map of a camera with another focal length, principal point, skew and pose."""
    camera: CropCamera = terms_by_hand.CAMERA
    F, c = camera.focal_px, camera.centre_px
    K = np.array([[1.3 * F, 4.0, c + 7], [0, 1.2 * F, c - 5], [0, 0, 1]])
    angle = 0.3
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([1.0, -2.0, 60.0])
    to_crop = np.array([[1 / F, 0, -c / F], [0, 1 / F, -c / F], [0, 0, 1]]) @ K
    maps = identity_maps(1)
    maps = dataclasses.replace(
        maps,
        linear=jnp.asarray(np.broadcast_to(to_crop @ R, (T, 1, 3, 3)), jnp.float32),
        offset=jnp.asarray(np.broadcast_to(to_crop @ t, (T, 1, 3)), jnp.float32),
    )
    pose = window_pose()
    window = posed_window(pose, dataclasses.replace(repeated(random_targets(), 1), views=maps))
    pixels = np.asarray(window.keypoints_cam, np.float64) @ R.T + t
    pixels = pixels @ K.T
    np.testing.assert_allclose(window.keypoints_px, pixels[..., :2] / pixels[..., 2:], rtol=2e-5)
    assert window.place_acceleration_px.shape == (T - 2, 3)


@pytest.mark.parametrize("shared", [(), ("bone_length", "betas")])
def test_curvature_of_views_is_that_of_automatic_differentiation(shared):
    """H of a squared residual is 2JᵀJ; the Jacobian by formula and by JAX must agree, in two different views."""
    pose, targets = window_pose(), repeated(random_targets(), 2)
    linear = np.array(targets.views.linear) + 0.05 * RNG.normal(size=(T, 2, 3, 3))
    offset = 0.5 * RNG.normal(size=(T, 2, 3))
    maps = ViewMaps(jnp.asarray(linear, jnp.float32), jnp.asarray(offset, jnp.float32), jnp.float32(5))
    targets = dataclasses.replace(targets, views=maps)

    def pixels(rows):
        return posed_window(add_rows(pose, rows, shared), targets).keypoints_px

    zero = jnp.zeros_like(frame_rows(pose, shared))
    direction = jnp.asarray(RNG.normal(size=zero.shape), jnp.float32)
    if shared:  # all rows of a shared parameter must agree
        framewise = frame_rows(pose).shape[1]
        direction = direction.at[:, framewise:].set(direction[:1, framewise:])
    _, expected = jax.jvp(pixels, (zero,), (direction,))
    blocks = posed_window(pose, targets, shared=shared).keypoint_jacobian_px
    J = np.concatenate([np.asarray(block) for block in blocks], axis=-1)
    found = np.einsum("tri,ti->tr", J, direction).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize("name", ["mask", "mask_smooth_l1"])
def test_curvature_of_masks_adds_up_over_views(name):
    pose, targets = window_pose(), random_targets()
    settings = {name: {"weight": 1.0}}
    direction = jnp.asarray(RNG.normal(size=frame_rows(pose).shape), jnp.float32)

    @jax.jit
    def product(targets):
        H = evaluate_curvature(posed_window(pose, targets), find_terms([name]), settings)
        return H.product(direction), H.diagonal

    for one, two in zip(product(targets), product(repeated(targets, 2)), strict=True):
        np.testing.assert_allclose(two, 2 * one, rtol=1e-4, atol=1e-4 * float(jnp.abs(one).max()))
    assert targets.mask.shape[-1] == SIZE
