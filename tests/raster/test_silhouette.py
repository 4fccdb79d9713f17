"""Silhouette and mask loss: the kernels of every instruction set and the reference, both edges, by hand and alike."""

import functools
from types import SimpleNamespace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxfit.raster import kernels, silhouette_reference
from jaxfit.raster import silhouette as raster
from jaxfit.raster.silhouette_reference import KINDS, UNKNOWN, Blur
from jaxfit.raster.zbuffer import hard_mask

ISAS = kernels.available_isas()
needs_kernels = pytest.mark.skipif(not ISAS, reason="built without the kernels")
SIZE, VERTICES, FACES = 40, 72, 24
"""Sizes of all meshes and images, so that the tests share the compiled programs."""
SOFT, UNBIASED = Blur.for_size(SIZE), Blur(1.6, 4.0, "unbiased")
edges = pytest.mark.parametrize("blur", [SOFT, UNBIASED], ids=["soft_rasterizer", "unbiased"])
COTANGENT = np.random.default_rng(0).normal(size=(SIZE, SIZE)).astype(np.float32)
BLANK = np.zeros((SIZE, SIZE), np.uint8)


@functools.partial(jax.jit, static_argnames="edge")
def by_reference(vertices, faces, target, cotangent, sigma, radius, edge):
    """What `measured` returns, by automatic differentiation of the reference."""
    blur = UNBIASED if edge == "unbiased" else SimpleNamespace(sigma=sigma, radius=radius, edge=edge)
    masks = jnp.stack([jnp.zeros((SIZE, SIZE)), jnp.float32(target != 0)])
    known = jnp.stack([jnp.ones((SIZE, SIZE), bool), target != UNKNOWN])

    def differences(v):
        return jax.vmap(lambda *of: silhouette_reference.difference(v, faces, *of, blur))(masks, known)

    (image, error), pull = jax.vjp(differences, vertices)
    nothing = jnp.zeros_like(image)
    cotangents = jnp.stack([cotangent, nothing, nothing]), jnp.stack([nothing, jnp.sign(error), error])
    pulled, *gradients = jax.vmap(lambda *of: pull(jnp.stack(of))[0])(*cotangents)
    values = jnp.sum(jnp.abs(error)), jnp.sum(error**2) / 2  # no error exceeds 1
    return image, pulled, dict(zip(KINDS, zip(values, gradients, strict=True), strict=True))


@functools.partial(jax.jit, static_argnames=("blur", "backend"))
def measured(vertices, faces, target, cotangent, blur, backend="native"):
    """Return the image, the pulled cotangent, and value and gradient of the loss of each kind."""
    options = {"blur": blur, "backend": backend}
    image, pull = jax.vjp(lambda v: raster.silhouette(v, faces, target.shape[0], **options), vertices)
    losses = {
        kind: jax.value_and_grad(raster.mask_loss)(vertices, faces, target, kind=kind, **options) for kind in KINDS
    }
    return image, pull(cotangent)[0], losses


def results(vertices, faces, target=BLANK, blur=SOFT, backend="native", cotangent=COTANGENT):
    if backend != "reference":
        return jax.tree.map(np.asarray, measured(vertices, faces, target, cotangent, blur))
    found = by_reference(vertices, faces, target, cotangent, np.float32(blur.sigma), np.float32(blur.radius), blur.edge)
    return jax.tree.map(np.asarray, found)


def mesh_of(vertices, faces):
    """Add equal vertices, and faces without area, up to the shape of all meshes."""
    more = (0, VERTICES - len(vertices)), (0, FACES - len(faces))
    vertices, faces = np.pad(vertices, (more[0], (0, 0)), "edge"), np.pad(faces, (more[1], (0, 0)))
    return vertices.astype(np.float32), faces.astype(np.int32)


def random_mesh(seed, size=SIZE):
    """Faces of all sizes over and around the image, some behind the camera, far-flung or without area."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-0.1, 1.1, (FACES, 1, 2)) * size
    corners = centres + rng.normal(size=(FACES, 3, 2)) * size * rng.choice([0.01, 0.05, 0.3, 2.0], (FACES, 1, 1))
    depth = rng.uniform(1, 2, (FACES, 3, 1)) * np.where(rng.random((FACES, 3, 1)) < 0.03, -1, 1)
    triples = np.arange(VERTICES).reshape(-1, 3)
    triples[rng.random(FACES) < 0.1, 2] = 0
    triples[rng.random(FACES) < 0.05, 1] = triples[0, 0]
    same = rng.random(FACES) < 0.05
    triples[same, 2] = triples[same, 1]
    return mesh_of(np.concatenate([corners, depth], -1).reshape(-1, 3), triples)


def soup():
    """Faces between few vertices over and around the image, some behind the camera."""
    rng = np.random.default_rng(1)
    depth = np.where(rng.random(20) < 0.1, -1, rng.uniform(1, 2, 20))
    xy = rng.uniform(-10, SIZE + 10, (20, 2))
    return mesh_of(np.column_stack([xy, depth]), rng.integers(0, 20, (FACES, 3)))


def on_screen(mesh, place=(18.0, 21.0), scale=11.0):
    turned = Rotation.from_rotvec([0.3, 0.5, 0.2]).apply(mesh.vertices) * scale
    return (turned + np.array([*place, 50.0])).astype(np.float32), np.asarray(mesh.faces, np.int32)


BALL = mesh_of(*on_screen(trimesh.creation.icosphere(0)))
MESHES = {
    "ball": BALL,
    "ball at the border": mesh_of(*on_screen(trimesh.creation.icosphere(0), (2.0, 37.0))),
    "soup": soup(),
    **{f"random {seed}": random_mesh(seed) for seed in range(3)},
}


def random_target(size=SIZE):
    """A mask of background, bird, unknown pixels, and one other byte, which is bird."""
    return np.random.default_rng(3).choice([0, 1, UNKNOWN, 255], (size, size)).astype(np.uint8)


def changed(array, at, value):
    array = array.copy()
    array[at] = value
    return array


def assert_agree(found, expected, blur):
    sharpness = 4  # the smaller the image, the sharper its edges, and the more the last bit of a corner shows
    soft = blur.edge == "soft_rasterizer"
    np.testing.assert_allclose(found[0], expected[0], atol=4e-5 * sharpness if soft else 5e-6)
    for kind, (value, _) in found[2].items():
        assert value == pytest.approx(float(expected[2][kind][0]), rel=2e-5 if soft else 1e-5, abs=1e-3 * soft)
    for own, other in zip(
        [found[1], *(of[1] for of in found[2].values())],
        [expected[1], *(of[1] for of in expected[2].values())],
        strict=True,
    ):
        assert np.all(np.isfinite(own))
        assert np.all(own[:, 2] == 0)
        # in an image that is nearly all covered, what the kernels leave out of saturated pixels shows
        tolerance = 5e-5 * sharpness if soft else 3e-4
        assert np.linalg.norm(own - other) <= tolerance * np.linalg.norm(other) + 1e-3 * soft


@functools.cache
def expected(name, blur):
    return results(*MESHES[name], random_target(), blur, "reference")


@edges
@pytest.mark.parametrize("name", ["ball", "ball at the border", "soup"])
def test_kernels_equal_the_reference(name, native, blur):
    assert_agree(results(*MESHES[name], random_target(), blur), expected(name, blur), blur)


@pytest.mark.parametrize("seed", range(3))
def test_kernels_equal_the_reference_for_random_faces(seed, native):
    name = f"random {seed}"
    assert_agree(results(*MESHES[name], random_target()), expected(name, SOFT), SOFT)


@pytest.mark.parametrize("blur", [Blur(0.05, 0.7), Blur(30.0, 15.0), Blur(1.0, 60.0)])
def test_kernels_equal_the_reference_with_other_blurs(native, blur):
    mesh = random_mesh(5)
    assert_agree(*(results(*mesh, random_target(), blur, each) for each in ("native", "reference")), blur)


@needs_kernels
@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.sampled_from(ISAS or ("none",)))
def test_any_mesh(seed, isa):
    kernels.choose_isa(isa)
    try:
        mesh = random_mesh(seed)
        assert_agree(*(results(*mesh, random_target(), SOFT, each) for each in ("native", "reference")), SOFT)
    finally:
        kernels.choose_isa("auto")


@pytest.mark.parametrize("size", [3, 37])
def test_images_of_other_sizes_are_parts_of_a_larger_image(native, size):
    mesh, part = random_mesh(2, size), (slice(size),) * 2
    target, cotangent = np.full_like(BLANK, UNKNOWN), np.zeros_like(COTANGENT)
    target[part], cotangent[part] = random_target(size), COTANGENT[part]
    image, *others = results(*mesh, target, SOFT, "reference", cotangent)
    found = results(*mesh, target[part], SOFT, cotangent=cotangent[part])
    assert_agree(found, (image[part], *others), SOFT)


def test_the_public_reference_is_the_reference():
    """The other tests call the functions of the reference directly, with a traced blur."""
    options = {"kind": "smooth_l1", "blur": UNBIASED, "backend": "reference"}
    found = jax.jit(jax.value_and_grad(lambda v: raster.mask_loss(v, BALL[1], random_target(), **options)))(BALL[0])
    value, gradient = expected("ball", UNBIASED)[2]["smooth_l1"]
    assert found[0] == pytest.approx(float(value), rel=1e-5)
    assert np.linalg.norm(found[1] - gradient) <= 3e-4 * np.linalg.norm(gradient)


def test_silhouette_by_hand(backend):
    """One face whose edge runs along x = 8: the pixel at 8 + n/2 lies n/2 from it, on the outside."""
    mesh = mesh_of(np.array([[8.0, -40, 1], [8.0, 90, 1], [-90.0, 10, 1]]), np.array([[0, 1, 2]]))
    image = results(*mesh, BLANK, Blur(2.0, 2.0), backend)[0]
    d = np.array([-2.25, -0.25, 0.25, 2.25])  # signed squared distances of the pixels 6 to 9
    np.testing.assert_allclose(image[10, 6:10], 1 / (1 + np.exp(d / 2.0)), rtol=1e-4)
    assert np.all(image[:, 10:] == 0)  # beyond the radius


@edges
def test_losses_by_hand(backend, blur):
    image, _, losses = results(*BALL, BLANK, blur, backend)
    assert losses["l1"][0] == pytest.approx(image.sum(dtype=float), rel=1e-5)
    assert losses["smooth_l1"][0] == pytest.approx((image.astype(float) ** 2).sum() / 2, rel=1e-5)
    if blur is SOFT:
        target, known = random_target() != 0, random_target() != UNKNOWN
        error = np.abs(image.astype(float) - target)[known]
        losses = results(*BALL, random_target(), blur, backend)[2]
        assert losses["l1"][0] == pytest.approx(error.sum(), rel=1e-5)
        assert losses["smooth_l1"][0] == pytest.approx((error**2).sum() / 2, rel=1e-5)


@edges
def test_gradients_by_finite_differences(backend, blur):
    """The reference in the direction of its gradient: a wide blur has no pixel at its radius."""
    blur = blur if blur is UNBIASED else Blur(25.0, 100.0)
    vertices, faces = BALL
    _, pulled, losses = results(vertices, faces, BLANK, blur, backend)
    gradients = {None: pulled, **{kind: gradient for kind, (_, gradient) in losses.items()}}
    for kind, gradient in gradients.items():
        # not along the gradient alone, which a gradient with missing vertices would also pass
        aside = 0.3 * np.random.default_rng(1).normal(size=gradient.shape) * [1, 1, 0]
        step = np.float32(0.05 * (gradient / np.abs(gradient).max() + aside))
        after, before = (results(vertices + sign * step, faces, BLANK, blur, backend) for sign in (1, -1))
        values = (
            (COTANGENT * each[0]).sum(dtype=float) if kind is None else float(each[2][kind][0])
            for each in (after, before)
        )
        assert np.subtract(*values) == pytest.approx(2 * float((gradient * step).sum()), rel=1e-2)


@edges
def test_unknown_pixels_cost_nothing(backend, blur):
    """What lies in unknown pixels changes neither loss nor gradient, also not through the filter."""
    vertices, faces = BALL
    hidden = np.where(np.arange(SIZE) >= 18, UNKNOWN, results(*BALL, BLANK, blur, backend)[0] > 0.5).astype(np.uint8)
    blob = np.array([[26.0, 30, 1], [39, 31, 1], [34, 39, 1]], np.float32)
    with_blob = changed(vertices, slice(-3, None), blob), changed(faces, -1, range(VERTICES - 3, VERTICES))
    assert results(*with_blob, BLANK, blur, backend)[0][33, 33] > 0.9
    value, gradient = results(*BALL, hidden, blur, backend)[2]["smooth_l1"]
    other, of_both = results(*with_blob, hidden, blur, backend)[2]["smooth_l1"]
    assert other == pytest.approx(float(value), rel=1e-5)
    np.testing.assert_allclose(of_both[:-3], gradient[:-3], atol=1e-5)
    assert not np.any(of_both[-3:])
    for value, gradient in results(*BALL, np.full_like(BLANK, UNKNOWN), blur, backend)[2].values():
        assert value == 0
        assert not np.any(gradient)


@edges
def test_empty_and_full_masks_and_a_bird_out_of_the_frame(backend, blur):
    vertices, faces = BALL
    for target in (BLANK, np.ones_like(BLANK)):
        for value, gradient in results(*BALL, target, blur, backend)[2].values():
            assert value > 0
            assert np.all(np.isfinite(gradient))
            assert np.any(gradient[:, :2] != 0)
        value, gradient = results(vertices + np.float32([1000, 0, 0]), faces, target, SOFT, backend)[2]["l1"]
        assert value == target.sum()
        assert np.all(gradient == 0)


def test_orientation_and_order_of_the_faces_do_not_matter(backend):
    vertices, faces = MESHES["random 0"]
    image = results(vertices, faces, BLANK, SOFT, backend)[0]
    for other in (faces[:, ::-1], faces[::-1], faces[:, [1, 2, 0]]):
        np.testing.assert_allclose(results(vertices, other, BLANK, SOFT, backend)[0], image, atol=2e-5)


@edges
def test_faces_that_cannot_be_seen(backend, blur):
    corners = np.array([[8.0, 8, 1], [32, 16, 1], [16, 28, 1]])
    cases = {
        "behind the camera": changed(corners, (1, 2), -1.0),
        "at the camera": changed(corners, (1, 2), 1e-8),
        "outside": corners + np.array([500.0, 0, 0]),
        "just outside": corners - np.array([33.0 if blur is SOFT else 43.0, 0, 0]),
        "two equal corners": changed(corners, 2, corners[1]),
        "a line": changed(corners, 2, (corners[0] + corners[1]) / 2),
    }
    for name, vertices in cases.items():
        image, pulled, losses = results(*mesh_of(vertices, np.array([[0, 1, 2]])), BLANK, blur, backend)
        assert not np.any(image), name
        assert not np.any(pulled), name
        for value, gradient in losses.values():
            assert value == 0, name
            assert not np.any(gradient), name
    assert results(*mesh_of(corners, np.array([[0, 1, 2]])), BLANK, blur, backend)[0].max() > 0.99


def test_area_below_which_a_face_is_skipped(backend):
    least = 1e-8 * (SIZE / 2) ** 2
    for share, seen in ((0.99, False), (1.01, True)):
        # at y = 0, where so small a height is not rounded away
        flat = np.array([[20.5, 0, 1], [30.5, 0, 1], [25.5, share * least / 10, 1]])
        image = results(*mesh_of(flat, np.array([[0, 1, 2]])), BLANK, SOFT, backend)[0]
        assert (image.max() > 0) == seen, share


@edges
def test_a_coordinate_that_is_not_finite_makes_everything_nan(backend, blur):
    vertices, faces = MESHES["random 1"]
    for bad, at in ((np.nan, (0, 0)), (np.inf, (4, 1)), (-np.inf, (7, 2)), (np.nan, (7, 2))):
        image, pulled, losses = results(changed(vertices, at, bad), faces, random_target(), blur, backend)
        assert np.all(np.isnan(image))
        assert np.all(np.isnan(pulled[:, :2]))
        for value, gradient in losses.values():
            assert np.isnan(value)
            assert np.all(np.isnan(gradient[:, :2]))
            assert np.all(gradient[:, 2] == 0)


@edges
def test_huge_coordinates(native, blur):
    """So far away, float32 does not place the edges of a face, but nothing breaks, and clamped vertices do not move."""
    mesh, faces = MESHES["random 2"]
    for huge in (1e4, 1e5, 1e9, 1e20, -1e20, 3e38):
        far = changed(changed(mesh, (0, 0), huge), (4, 1), huge)
        found, own = (results(far, faces, random_target(), blur, each)[2]["l1"] for each in ("native", "reference"))
        if blur is SOFT:
            assert found[0] == pytest.approx(float(own[0]), rel=1e-3), huge
        for value, gradient in (found, own) if blur is SOFT else (found,):
            assert np.isfinite(value), huge
            assert np.all(np.isfinite(gradient)), huge
            assert abs(huge) <= 2**20 or gradient[0, 0] == gradient[4, 1] == 0, huge


def area_and_perimeter(vertices, faces, fine=16):
    """Return the area (px²) and the perimeter (px) of a mesh, counted on a finer grid."""
    mask = hard_mask((vertices * np.array([fine, fine, 1])).astype(np.float32), faces, fine * SIZE, fine * SIZE)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    # the staircase of the pixels is no part of the perimeter
    lengths = (cv2.arcLength(cv2.approxPolyDP(contour, 2, True), True) for contour in contours)
    return float(mask.sum()) / fine**2, sum(lengths) / fine


def test_the_unbiased_silhouette_has_the_area_of_its_mesh(backend):
    """Also of a thin needle, and of a sheet from either side; the soft rasteriser adds 1.4 px around the needle."""
    sheet = np.array([[10.0, 10, 1], [30, 12, 1], [28, 30, 1], [12, 33, 1]])
    x, y = sheet[:, 0], sheet[:, 1]
    area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    for turn in (slice(None), slice(None, None, -1)):
        faces = np.array([[0, 1, 2], [0, 2, 3]])[:, turn]
        image = results(*mesh_of(sheet, faces), BLANK, UNBIASED, backend)[0]
        assert image.sum() == pytest.approx(area, rel=1e-4)
    excess = {}
    needle = on_screen(trimesh.creation.cone(0.05, 2.0, sections=12))
    for name, mesh in {"ball": on_screen(trimesh.creation.icosphere(0)), "needle": needle}.items():
        area, perimeter = area_and_perimeter(*mesh)
        for blur in (UNBIASED, Blur(1.6, 4.0)):
            image = results(*mesh_of(*mesh), BLANK, blur, backend)[0]
            excess[name, blur.edge] = (float(image.sum()) - area) / perimeter  # mean distance outside the mesh, pixels
    assert abs(excess["ball", "unbiased"]) < 0.02
    assert abs(excess["needle", "unbiased"]) < 0.05
    assert excess["needle", "soft_rasterizer"] > 0.5


@functools.partial(jax.jit, static_argnames="backend")
def weighted(vertices, weight, backend):
    loss = functools.partial(raster.mask_loss, faces=BALL[1], target=random_target(), backend=backend)
    return jax.value_and_grad(lambda v, w: loss(v, weight=w), argnums=(0, 1))(vertices, weight)


@pytest.mark.parametrize("backend", ["native", "reference"][not ISAS :])
def test_weight(backend):
    one, (gradient, _) = weighted(BALL[0], 1.0, backend)
    three, by_weight = weighted(BALL[0], 3.0, backend)
    assert one == pytest.approx(float(results(*BALL, random_target())[2]["l1"][0]), rel=2e-5)
    assert three == pytest.approx(3 * float(one))
    np.testing.assert_allclose(by_weight[0], 3 * gradient, rtol=1e-5)
    assert by_weight[1] == pytest.approx(float(one))
    for vertices in (BALL[0], changed(BALL[0], (0, 0), np.nan)):
        value, gradients = weighted(vertices, 0.0, backend)
        assert value == 0
        assert np.all(gradients[0] == 0)
        assert gradients[1] == 0


@pytest.mark.parametrize("backend", ["native", "reference"][not ISAS :])
def test_targets_may_be_fractions_and_a_loss_needs_no_gradient(backend):
    target = np.random.default_rng(4).random((SIZE, SIZE), np.float32)
    loss = jax.jit(functools.partial(raster.mask_loss, faces=BALL[1], target=target, backend=backend))
    value, gradient = jax.jit(jax.value_and_grad(loss))(BALL[0])
    error = np.abs(results(*BALL, BLANK, SOFT, backend)[0].astype(float) - target)
    assert value == pytest.approx(error.sum(), rel=1e-5)
    assert np.any(gradient)
    assert loss(BALL[0]) == pytest.approx(float(value), rel=1e-6 if backend == "native" else 1e-5)
    assert np.isnan(loss(changed(BALL[0], (0, 0), np.nan)))


@needs_kernels
@edges
def test_a_mesh_without_faces(blur):
    for found in jax.tree.leaves(results(BALL[0], BALL[1][:0], BLANK, blur)):
        assert not np.any(found)


@pytest.mark.parametrize("backend", ["native", "reference"][not ISAS :])
def test_other_bytes_are_inside(backend):
    mask, loss = random_target() == 1, jax.jit(functools.partial(raster.mask_loss, *BALL, backend=backend))
    losses = [float(loss(each)) for each in (mask, np.uint8(255 * mask), mask.astype(np.float32))]
    assert max(losses) - min(losses) <= 1e-3
    assert min(losses) > 100


@needs_kernels
def test_results_do_not_depend_on_threads_or_company(native):
    """Nested batches in which each operand has the axes of one of the two batches; single images; repeated calls."""
    meshes = [random_mesh(seed) for seed in range(6)]
    vertices = np.stack([v for v, _ in meshes]).reshape(2, 3, VERTICES, 3)
    faces, weights = np.stack([meshes[0][1], meshes[3][1]]), np.float32([2.0, 0.5])
    targets = np.stack([random_target(), random_target().T, BLANK])

    def loss(v, f, t, w):
        return raster.mask_loss(v, f, t, w, backend="native")

    single = jax.jit(jax.value_and_grad(loss))
    frames = jax.vmap(jax.value_and_grad(loss), in_axes=(0, None, 0, None))
    together = jax.jit(jax.vmap(frames, in_axes=(0, 0, None, 0)))
    assert raster.silhouette(vertices[0, 0], faces[0][:0], 4, backend="native").tolist() == [[0] * 4] * 4
    values, gradients = together(vertices, faces, targets, weights)
    for _ in range(3):
        again = together(vertices, faces, targets, weights)
        np.testing.assert_array_equal(again[0], values)
        np.testing.assert_array_equal(again[1], gradients)
    for i, j in np.ndindex(2, 3):
        value, gradient = single(vertices[i, j], faces[i], targets[j], weights[i])
        assert values[i, j] == value
        np.testing.assert_array_equal(gradients[i, j], gradient)
    cotangents = np.stack([COTANGENT, COTANGENT.T])
    pulled = jax.jit(jax.vmap(jax.vmap(_pull, in_axes=(None, 0)), in_axes=(0, None)))(vertices[0], cotangents)
    for i, j in np.ndindex(3, 2):
        np.testing.assert_array_equal(pulled[i, j], _pull(vertices[0, i], cotangents[j]))


@jax.jit
def _pull(v, c):
    return jax.vjp(lambda v: raster.silhouette(v, MESHES["random 0"][1], SIZE, backend="native"), v)[1](c)[0]


@needs_kernels
def test_an_index_out_of_range_is_an_error():
    vertices, faces = random_mesh(0)
    for bad in (VERTICES, -1):
        with pytest.raises(Exception, match="faces: an index is not in"):
            raster.silhouette(vertices, changed(faces, (2, 1), bad), 16, backend="native").block_until_ready()


@needs_kernels
@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_only_the_cpu_program_holds_the_call(platform, monkeypatch):
    """On a machine with a second platform; where the CPU is alone, the reference is not even traced."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cuda")
    vertices, faces = random_mesh(0)
    gradient = jax.jit(jax.grad(lambda v: raster.mask_loss(v, faces, np.zeros((16, 16), bool))))
    checks = [jax.export.DisabledSafetyCheck.custom_call("jaxfit_mask_loss_and_gradient")]
    exported = jax.export.export(gradient, platforms=[platform], disabled_checks=checks)(vertices).mlir_module()
    assert ("jaxfit_mask_loss_and_gradient" in exported) == (platform == "cpu")


@needs_kernels
def test_the_gradient_of_a_mean_is_not_negligible():
    """The kernels leave out blocks whose gradient is small beside the greatest one, not those of a small loss."""
    pulls = [results(*random_mesh(0), cotangent=np.full((SIZE, SIZE), c, np.float32))[1] for c in (1.0, 2.0**-30)]
    assert np.any(pulls[0])
    np.testing.assert_allclose(pulls[1] * 2.0**30, pulls[0], rtol=1e-6, atol=1e-30)


@needs_kernels
def test_without_differentiation_only_the_loss_is_computed():
    vertices, faces = random_mesh(0)

    def loss(v):
        return raster.mask_loss(v, faces, np.zeros((16, 16), bool))

    assert "gradient" not in jax.jit(loss).lower(vertices).as_text()
    once = jax.jit(jax.value_and_grad(loss)).lower(vertices).compile().as_text()
    assert once.count('custom_call_target="jaxfit_mask_loss') == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices_screen": np.zeros((4, 2))}, r"vertices_screen: expected shape \(V, 3\), got \(4, 2\)"),
        ({"vertices_screen": np.zeros((4, 3), int)}, "vertices_screen: expected floats"),
        ({"faces": np.zeros((4, 4), int)}, r"faces: expected shape \(F, 3\), got \(4, 4\)"),
        ({"faces": np.zeros((4, 3))}, "faces: expected integers"),
        ({"target": np.zeros((4, 5), bool)}, r"target: expected shape \(size, size\), got \(4, 5\)"),
        ({"target": np.zeros((4, 4), int)}, "target: expected bool, uint8 or floats"),
        ({"weight": np.ones(2)}, r"weight: expected a scalar, got shape \(2,\)"),
        ({"kind": "l2"}, "kind: expected one of"),
        ({"backend": "gpu"}, "backend: expected one of"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        raster.mask_loss(**{"vertices_screen": BALL[0], "faces": BALL[1], "target": BLANK} | change)


def test_wrong_sizes_and_blurs_are_named():
    for size in (0, -1, 2.5, True, 2**14 + 1):
        with pytest.raises(ValueError, match="size: expected an integer"):
            raster.silhouette(*BALL, size)
    for name, blur in (("sigma", (0, 1)), ("sigma", (np.nan, 1)), ("radius", (1, -1)), ("edge", (1, 1, "sharp"))):
        with pytest.raises(ValueError, match=name):
            Blur(*blur)
