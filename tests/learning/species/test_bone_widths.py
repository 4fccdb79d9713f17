"""Widths of bone lengths: against the whole Hessian of the objective, and which bones count as determined."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from support.birds import tiny_bird

from jaxfit.cli.species import _undetermined_bones
from jaxfit.learning.species.photo_fit import (
    PLACE_UNITS,
    PRIOR_WEIGHT,
    BoneWidths,
    Data,
    Parameters,
    Weights,
    _model,
    _step_sizes,
    bone_widths,
)
from jaxfit.learning.species.photographs import MASK_PX
from jaxfit.learning.species.species import symmetric_bone_precision, with_offsets
from jaxfit.model.camera import CropCamera, project
from jaxfit.model.kinematics import joint_transforms, posed_vertices
from jaxfit.objective.posed_window import priors_of

IMAGES, INDIVIDUALS = 3, 2
BASE = tiny_bird(shapes=2)
BIRD = with_offsets(BASE, 1, 0.004)


def species(unseen=()):
    """Return model, images without errors, and parameters; two images show one individual."""
    random = np.random.default_rng(4)
    model = _model(BIRD)
    bones, shapes = model.symmetric.shape[1], BASE.num_shapes

    def small(*shape):
        return jnp.asarray(0.03 * random.standard_normal(shape), jnp.float32)

    p = Parameters(
        orient=jnp.asarray([[0.3, 0.1, 0.2], [1.2, 0.4, -0.3], [0.2, -1.4, 0.5]], jnp.float32),
        body_pose=jnp.asarray(BASE.pose_mean.reshape(-1, 3)) + small(IMAGES, BASE.num_joints - 1, 3),
        place=jnp.asarray([0, 0, 190], jnp.float32) / PLACE_UNITS + small(IMAGES, 3),
        own_bones=small(INDIVIDUALS, bones),
        own_shape=small(INDIVIDUALS, shapes),
        bones=small(bones),
        shape=small(BIRD.num_shapes),
    )
    confidence = np.array(random.uniform(0.5, 1, (IMAGES, BASE.num_keypoints)), np.float32)
    confidence[:, [BASE.keypoint_names.index(name) for name in unseen]] = 0
    data = Data(
        keypoints_px=jnp.zeros((IMAGES, BASE.num_keypoints, 2)),
        confidence=jnp.asarray(confidence),
        mask=jnp.zeros((IMAGES, MASK_PX, MASK_PX), jnp.uint8),
        has_mask=jnp.zeros(IMAGES),
        individual=jnp.array([0, 1, 0]),
        scale=jnp.ones(IMAGES),
    )
    return model, data._replace(keypoints_px=keypoints_px(model, p, data)), p


def keypoints_px(model, p, data):
    """Return the keypoints by the posed vertices; the code under test poses the keypoints directly."""
    rest = model.rig.vertices + jnp.tensordot(p.shape, model.rig.shape_basis, axes=1)
    own_basis = model.rig.shape_basis[: BASE.num_shapes]
    rig = eqx.tree_at(lambda r: (r.vertices, r.shape_basis), model.rig, (rest, own_basis))

    def image(pose):
        return project(model.keypoint_weights @ posed_vertices(rig, joint_transforms(rig, pose), pose), CropCamera())

    return jax.vmap(image)(model.pose(p, data))


def weights_of(p, fixed):
    bones, shapes = p.own_bones.shape[1], p.own_shape.shape[1]
    step = _step_sizes(p, BASE, fixed)
    image = jnp.array([1.0, 0.7, 0.4])
    return Weights(image, jnp.float32(0), 30 * jnp.eye(bones) + 5, jnp.full(shapes, 8.0), step)


@jax.jit
def energy_hessian(model, data, weights, p):
    """Return the Hessian of E/(2λ) by all parameters, without errors of the keypoints.

    The second derivative of the robust error e²σ²/(σ² + e²) at e = 0 is 2 for any σ, so that of the images is 2 JᵀwJ.
    """
    flat, unflatten = ravel_pytree(p)

    def priors(x):
        q = unflatten(x)
        pose = (q.body_pose.reshape(IMAGES, -1) - model.pose_mean) @ model.pose_whitener.T
        own = jnp.einsum("nq,qr,nr->", q.own_bones, weights.own_bones, q.own_bones)
        own += jnp.sum(q.own_shape**2 * weights.own_shape)
        mean = q.bones @ model.bone_precision @ q.bones + jnp.sum(q.shape**2 * model.shape_precision)
        return (jnp.sum(pose**2) + own + mean) / 2

    jacobian = jax.jacfwd(lambda x: keypoints_px(model, unflatten(x), data))(flat)
    weight = weights.image[:, None] * data.confidence
    images = jnp.einsum("nkca,nk,nkcb->ab", jacobian, weight, jacobian) / PRIOR_WEIGHT
    return images + jax.hessian(priors)(flat)


@pytest.mark.parametrize(
    ("fixed", "unseen"), [((), ()), (("shape", "offset"), ("bill_tip", "nape")), (("offset",), ())]
)
def test_the_widths_are_those_of_the_whole_hessian(fixed, unseen):
    """Without errors of the keypoints, the Gauss-Newton matrix is the Hessian of the objective."""
    model, data, p = species(unseen)
    weights = weights_of(p, fixed)
    hessian = np.asarray(energy_hessian(model, data, weights, p), np.float64)
    step = jax.tree.map(lambda x, s: jnp.broadcast_to(s, x.shape), p, weights.step)
    free = np.asarray(ravel_pytree(step)[0]) > 0
    bones = np.asarray(ravel_pytree(jax.tree.map(jnp.zeros_like, p)._replace(bones=jnp.ones_like(p.bones)))[0]) > 0
    covariance = np.linalg.inv(hessian[np.ix_(free, free)])[np.ix_(bones[free], bones[free])]
    symmetric = np.asarray(model.symmetric, np.float64)
    widths = bone_widths(model, priors_of(BIRD), data, weights, p)
    np.testing.assert_allclose(widths.posterior, np.sqrt(np.diag(symmetric @ covariance @ symmetric.T)), rtol=5e-3)
    prior = symmetric @ np.linalg.inv(symmetric_bone_precision(BASE)) @ symmetric.T
    np.testing.assert_allclose(widths.prior, np.sqrt(np.diag(prior)), rtol=1e-4)
    ratio = (widths.posterior / widths.prior)[BASE.joint_names.index("head") - 1]
    assert ratio == pytest.approx(1, abs=1e-3) if unseen else ratio < 0.95
    if not fixed:
        disc = (np.hypot(*(np.indices((MASK_PX, MASK_PX)) - MASK_PX / 2)) < 30).astype(np.uint8)
        masked = data._replace(mask=jnp.asarray(np.stack([disc] * IMAGES)), has_mask=jnp.ones(IMAGES))
        with_mask = bone_widths(model, priors_of(BIRD), masked, weights, p).posterior
        assert (with_mask <= widths.posterior + 1e-9).all()
        assert (with_mask < 0.97 * widths.posterior).any()


def test_the_photographs_say_less_than_the_prior_above_the_root_of_a_half():
    widths = BoneWidths(prior=np.full(3, 0.3), posterior=0.3 * np.array([0.69, 0.72, 1.0]))
    assert widths.undetermined == [1, 2]
    assert _undetermined_bones(BASE, widths) == ["wing"]  # the left and the right wing
