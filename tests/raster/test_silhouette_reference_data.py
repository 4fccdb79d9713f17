"""Agreement with PyTorch3D's soft silhouette, for the reference and for the kernels of every instruction set."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfit.raster import silhouette as raster
from jaxfit.raster import silhouette_reference

pytestmark = pytest.mark.usefixtures("optimised")

CASES = ("triangle", "triangle_edge_of_frame", "icosphere", "aves_template_a", "aves_template_b", "avian_mesh_a")
SLOW = pytest.param("aves_template_a", marks=pytest.mark.extended)  # 20 s, so one bird stands for all
CENTRE = 128


@pytest.fixture(scope="module")
def data(reference_dir):
    with np.load(reference_dir / "reference" / "pytorch3d_silhouette.npz") as file:
        return dict(file)


def relative_error(actual, expected):
    return np.linalg.norm(np.asarray(actual, np.float64) - expected) / np.linalg.norm(expected)


@functools.partial(jax.jit, static_argnames="backend")
def measured(vertices, faces, target, focal, backend):
    """The image, and the gradient of the loss through the image; of the kernels, also those of the loss itself."""

    def project(v):
        return jnp.concatenate([focal * v[:, :2] / v[:, 2:] + CENTRE, v[:, 2:]], 1)

    image, pull = jax.vjp(lambda v: raster.silhouette(project(v), faces, target.shape[0], backend=backend), vertices)
    through_image = jnp.sum(jnp.abs(image - target)), pull(jnp.sign(image - target))[0]
    if backend == "reference":
        return image, [through_image]
    loss = jax.value_and_grad(lambda v: raster.mask_loss(project(v), faces, target, backend=backend))
    return image, [through_image, loss(vertices)]


def check(data, case, backend):
    vertices, faces, target, expected, loss, gradient = (
        data[f"{case}/{name}"] for name in ("vertices", "faces", "target", "silhouette", "loss", "grad_vertices")
    )
    if len(faces) < 100:  # faces without area, so that the triangles share the program of the ball
        ball = data["icosphere/vertices"], data["icosphere/faces"]
        vertices, faces, gradient = (
            np.pad(own, ((0, len(other) - len(own)), (0, 0)), constant_values=fill)
            for own, other, fill in ((vertices, ball[0], 1), (faces, ball[1], 0), (gradient, ball[0], 0))
        )
    image, losses = measured(vertices, faces, target, data["focal"], backend)
    np.testing.assert_allclose(image, expected, atol=1e-4)
    for value, own_gradient in losses:
        assert value == pytest.approx(float(loss), rel=1e-5)
        assert relative_error(own_gradient, gradient) < 1e-4


def test_kernels_agree_with_pytorch3d(data, native):
    for case in CASES:
        check(data, case, native)


@pytest.mark.parametrize("case", [*CASES[:3], SLOW])
def test_reference_agrees_with_pytorch3d(data, case):
    check(data, case, "reference")


def test_default_blur_is_that_of_the_data(data):
    blur = silhouette_reference.Blur.for_size(256)
    assert blur.sigma == pytest.approx(float(data["sigma"]) * 128**2)
    assert blur.radius == pytest.approx(128 * float(data["blur_radius"]) ** 0.5)
