"""Projection agrees with stored numbers and is finite at the camera; the crop conversions are inverse."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfit.model.camera import CropCamera, crop_to_image, image_to_crop, project, to_screen


def test_stored_projection(reference_dir):
    with np.load(reference_dir / "reference" / "lbs.npz") as stored:
        camera = CropCamera(float(stored["camera/focal"]), float(stored["camera/center"]))
        pixels = project(jnp.asarray(stored["camera/points"]), camera)
        np.testing.assert_allclose(pixels, stored["camera/pixels"], atol=1e-3)
    assert camera == CropCamera()  # the defaults are the reference's camera


def test_projection_by_hand():
    camera = CropCamera(focal_px=100, centre_px=32, size_px=64)
    points = np.array([[0, 0, 5], [1, 0, 5], [0, -2, 10], [0.3, 0.4, 2]], np.float32)
    expected = [[32, 32], [52, 32], [32, 12], [47, 52]]
    np.testing.assert_allclose(project(points, camera), expected, rtol=1e-6)
    screen = to_screen(points, camera)
    np.testing.assert_allclose(screen[:, :2], expected, rtol=1e-6)
    np.testing.assert_array_equal(screen[:, 2], points[:, 2])


def test_projection_at_and_behind_the_camera_is_finite():
    for depth in [0.0, -0.0, 1e-12, -1e-3, -5.0, -1e6]:
        point = jnp.array([0.5, -2.0, depth])
        value, pullback = jax.vjp(lambda p: project(p, CropCamera()), point)
        assert np.isfinite(value).all()
        assert np.isfinite(pullback(jnp.ones(2))[0]).all()
        # a point on the right stays on the right: the projection does not mirror points behind the camera
        assert value[0] > 128 > value[1]


number = st.floats(-2000, 2000, width=32)


@settings(max_examples=50, deadline=None)
@given(
    points=st.lists(st.tuples(number, number), min_size=1, max_size=5),
    x0=number,
    y0=number,
    size=st.floats(16, 4000, width=32),
    size_px=st.sampled_from([64, 256]),
)
def test_crop_and_image_are_inverse(points, x0, y0, size, size_px):
    points, crop = np.array(points), np.array([x0, y0, size])
    there = crop_to_image(points, crop, size_px)
    np.testing.assert_allclose(image_to_crop(there, crop, size_px), points, atol=1e-4 * size_px)
    np.testing.assert_allclose(crop_to_image(np.zeros((1, 2)), crop, size_px), [[x0, y0]])
    corner = crop_to_image(np.full((1, 2), float(size_px)), crop, size_px)
    np.testing.assert_allclose(corner, [[x0 + size, y0 + size]])


def test_every_frame_has_its_own_crop():
    crops = np.array([[10.0, 20, 128], [30, 40, 512]])
    points = np.full((2, 3, 2), 128.0)
    expected = [[[74, 84]] * 3, [[286, 296]] * 3]
    np.testing.assert_allclose(crop_to_image(points, crops), expected)
