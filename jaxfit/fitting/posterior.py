"""The Laplace approximation of a window: curvature blocks and covariances.

The posterior of a window is approximated by a Gaussian at the fitted pose. Its precision H is the curvature of the
objective, in nats. All terms of the library link a frame with at most the next two frames, so H has a band of blocks,
and a border for the parameters that all frames share (common scale, bone lengths, shape coefficients):

    H = [A  U; Uᵀ  S],  A_tu = 0 for |t − u| > 2.

Products with H at structured probes give the blocks: frames t, t + 5, t + 10, … do not interact, so one probe gives one
column of all their blocks. A Cholesky factorisation forward in time and the selected inverse backward in time give the
blocks of H⁻¹ inside the band. `fitting/sandwich.py` widens H⁻¹ for errors that the objective
does not assume.

The curvature of a robust kernel includes its second derivative (`objective.residuals.residual_curvature`). Derivatives
of second order of the pose (of the residuals) are left out, as in Gauss-Newton.

The mask terms enter with their Gauss-Newton block times their weight, as in the solver. This is the curvature of
λ·Σ ½e², that is of `mask_smooth_l1`. For the L1 norm, this is a choice: its own second derivative depends on the
distance between outline and mask, and vanishes if they agree exactly. The block treats λ as the precision of a pixel.

Source: MacKay 1992, *A practical Bayesian framework for backpropagation networks* (the Laplace
approximation); Takahashi et al. 1973, *Formation of a sparse bus impedance matrix* (selected inverse).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxfit.config.fit import StageConfig
from jaxfit.fitting.problem import Problem, Program, problem_window
from jaxfit.fitting.solve import shared_parameters
from jaxfit.fitting.stored_programs import StoredProgram
from jaxfit.model.kinematics import Pose
from jaxfit.objective.curvature import frame_rows, shared_columns
from jaxfit.objective.objective import evaluate_curvature

BANDWIDTH = 2
"""Number of following frames that the terms of a frame may depend on."""
PERIOD = 2 * BANDWIDTH + 1
"""Frames at this distance do not interact, and share a probe."""
PROBES_AT_ONCE = 16
TOLERANCE = 1e-4
"""Relative error of a random product with the blocks (each row in units of √H_ii), above which the terms link frames
farther apart."""
RIDGES = 1e-6, 1e-5, 1e-4, 1e-3
"""Fractions of the diagonal that are added to H, until its factorisation exists. Products are in float32."""
BROAD_BONE_SD, BROAD_SHAPE_SD = 1.0, 10.0
"""Standard deviations of bone lengths and of shape coefficients in the broad prior."""
LARGEST_BYTES = 3e9
"""Memory of the blocks of a window, above which a window has no posterior."""


class Blocks(NamedTuple):
    """A symmetric matrix over the parameters of a window: a band over the frames, and a border.

    A frame has L parameters of its own; C parameters are shared by all frames. Arrays are NumPy, float64.
    """

    band: Float[np.ndarray, "3 T L L"]
    """Entry k, t: the block of frames t (rows) and t + k (columns); 0 where frame t + k does not exist."""
    border: Float[np.ndarray, "T L C"]
    """The block of each frame (rows) and the shared parameters (columns)."""
    corner: Float[np.ndarray, "C C"]
    """The block of the shared parameters."""

    @property
    def diagonal(self) -> tuple[Float[np.ndarray, "T L"], Float[np.ndarray, "C"]]:
        """The diagonals of the frames and of the corner."""
        return np.einsum("tii->ti", self.band[0]), np.diagonal(self.corner)

    def of_frames(self) -> Float[np.ndarray, "T P P"]:
        """Return the block of the P = L + C parameters of each frame: its own, then the shared ones."""
        shared = np.broadcast_to(self.corner, (len(self.border), *self.corner.shape))
        return np.block([[self.band[0], self.border], [self.border.transpose(0, 2, 1), shared]])

    def plus_diagonal(self, own: Float[np.ndarray, "T L"], shared: Float[np.ndarray, "C"]) -> Blocks:
        """Return the matrix plus a diagonal matrix."""
        band = self.band.copy()
        np.einsum("tii->ti", band[0])[...] += own
        return Blocks(band, self.border, self.corner + np.diag(shared))


class Factors(NamedTuple):
    """The block factorisation of a positive definite H, by elimination of the frames forward in time."""

    inverses: Float[np.ndarray, "T L L"]
    """Inverse of the block of each frame after the elimination of the frames before."""
    gains: Float[np.ndarray, "2 T L L"]
    """Entry k − 1, t: `inverses[t]` times the block of the frames t and t + k after the same elimination."""
    border: Float[np.ndarray, "T L C"]
    """A⁻¹U."""
    corner: Float[np.ndarray, "C C"]
    """The block of H⁻¹ of the shared parameters: the inverse of S − UᵀA⁻¹U."""


def factorise(H: Blocks) -> Factors:
    """Return the factorisation of H.

    Raises:
        numpy.linalg.LinAlgError: H is not positive definite.
    """
    (_, T, L, _), C = H.band.shape, len(H.corner)
    band = np.concatenate([H.band, np.zeros((3, BANDWIDTH, L, L))], axis=1)  # frames after the last: 0
    (invert_triangle,) = scipy.linalg.get_lapack_funcs(("trtri",), dtype=np.float64)
    inverses, gains = np.zeros((T, L, L)), np.zeros((2, T, L, L))
    # Block elimination. D_t, E_t, F_t are the blocks (t, t), (t, t + 1), (t, t + 2) after the elimination of the frames
    # before t. The elimination of frame t leaves its Schur complement in the frames that follow:
    #   D_{t+1} −= E_tᵀD_t⁻¹E_t,   E_{t+1} −= E_tᵀD_t⁻¹F_t,   D_{t+2} −= F_tᵀD_t⁻¹F_t
    for t in range(T):
        factor = np.linalg.cholesky(band[0, t])  # raises where D_t is not positive definite
        # products of L×L matrices only: linear algebra on several threads is slow for larger ones on a busy machine
        inverse_factor, _ = invert_triangle(factor, lower=1)
        inverses[t] = inverse_factor.T @ inverse_factor
        for k in (1, 2):
            gains[k - 1, t] = inverses[t] @ band[k, t]  # D_t⁻¹E_t and D_t⁻¹F_t
        band[0, t + 1] -= band[1, t].T @ gains[0, t]
        band[1, t + 1] -= band[1, t].T @ gains[1, t]
        band[0, t + 2] -= band[2, t].T @ gains[1, t]
    # the shared parameters last: their block of H⁻¹ is (S − UᵀA⁻¹U)⁻¹
    border = _solve_band(inverses, gains, H.border)
    schur = H.corner - np.einsum("tic,tid->cd", H.border, border)
    factor = np.linalg.cholesky((schur + schur.T) / 2)
    corner = scipy.linalg.cho_solve((factor, True), np.eye(C)) if C else np.zeros((0, 0))
    return Factors(inverses, gains, border, corner)


def _solve_band(inverses: np.ndarray, gains: np.ndarray, right: Float[np.ndarray, "T L R"]) -> np.ndarray:
    """Return A⁻¹ times some right-hand sides, (T, L, R)."""
    # A = GᵀDG, where G has ones on its diagonal and the gains right of it: two triangular systems
    T = len(inverses)
    rest = np.concatenate([right, np.zeros((BANDWIDTH, *right.shape[1:]))])
    for t in range(T):  # Gᵀy = b, forward in time
        for k in (1, 2):
            rest[t + k] -= gains[k - 1, t].T @ rest[t]
    found = np.zeros_like(rest)
    for t in reversed(range(T)):  # D·G·x = y, backward in time
        found[t] = inverses[t] @ rest[t] - gains[0, t] @ found[t + 1] - gains[1, t] @ found[t + 2]
    return found[:T]


def solve_blocks(
    factors: Factors, own: Float[np.ndarray, "T L R"], shared: Float[np.ndarray, "C R"]
) -> tuple[Float[np.ndarray, "T L R"], Float[np.ndarray, "C R"]]:
    """Return x with H·x = b for R right-hand sides b: the part of the frames and that of the shared parameters."""
    inside = _solve_band(factors.inverses, factors.gains, own)
    # With V = A⁻¹U and K the corner of H⁻¹: x_shared = K·(b_shared − Vᵀb_frames), x_frames = A⁻¹b_frames − V·x_shared.
    # UᵀA⁻¹b = Vᵀb needs no second solution.
    of_window = factors.corner @ (shared - np.einsum("tic,tir->cr", factors.border, own))
    return inside - factors.border @ of_window, of_window


def invert_blocks(H: Blocks, factors: Factors | None = None) -> Blocks:
    """Return the selected inverse: the blocks of H⁻¹ inside the band, the border and the corner.

    Args:
        H: the precision.
        factors: its factorisation (`factorise`), where it exists.

    Raises:
        numpy.linalg.LinAlgError: H is not positive definite.
    """
    (_, T, L, _) = H.band.shape
    inverses, gains, V, corner = factorise(H) if factors is None else factors
    # Takahashi: G·A⁻¹ = D⁻¹G⁻ᵀ, whose blocks right of the diagonal are 0. With Z = A⁻¹ and the gains G₁, G₂ of frame t,
    # the rows of frame t give the blocks inside the band from those of later frames only:
    #   Z_{t,t+1} = −G₁Z_{t+1,t+1} − G₂Z_{t+2,t+1},   Z_{t,t+2} = −G₁Z_{t+1,t+2} − G₂Z_{t+2,t+2},
    #   Z_{t,t} = D_t⁻¹ − Z_{t,t+1}G₁ᵀ − Z_{t,t+2}G₂ᵀ
    inside = np.zeros((BANDWIDTH + 1, T + BANDWIDTH, L, L))
    for t in reversed(range(T)):
        first, second = gains[:, t]
        inside[1, t] = -first @ inside[0, t + 1] - second @ inside[1, t + 1].T
        inside[2, t] = -first @ inside[1, t + 1] - second @ inside[0, t + 2]
        own = inverses[t] - inside[1, t] @ first.T - inside[2, t] @ second.T
        inside[0, t] = (own + own.T) / 2
    inside = inside[:, :T]
    # the border: the block of frames of H⁻¹ is A⁻¹ + V·K·Vᵀ, its border −V·K
    for k in range(BANDWIDTH + 1):
        inside[k, : T - k] += V[: T - k] @ corner @ V[k:].swapaxes(1, 2)
    return Blocks(inside, -V @ corner, corner)


class Products(NamedTuple):
    """Products of the curvature H of a window with structured changes of the pose."""

    own: Float[Array, "5 L T D"]
    """Entry c, l: with a change of parameter l of a frame in the frames c, c + 5, …"""
    shared: Float[Array, "C T D"]
    """With a change of each shared parameter."""
    change: Float[Array, "T D"]
    """A random change of all parameters."""
    product: Float[Array, "T D"]
    """H times `change`."""


@functools.partial(StoredProgram, structure=lambda program, problems, pose: Products._make([0, 0, 0, 0]))
def curvature_products(program: Program, problems: Problem, pose: Pose) -> Products:
    """Return the products from which `blocks_of` assembles the curvature of each of B problems."""

    def one(problem: Problem, pose: Pose) -> Products:
        window = problem_window(program, problem, pose)
        settings = {name: problem.hyperparameters.settings[name] for name in program.terms}
        curvature = evaluate_curvature(window, program.terms, settings, second_order=True)
        is_shared = shared_columns(pose, program.shared)
        T, D = frame_rows(pose, program.shared).shape
        own, shared = np.flatnonzero(~is_shared), np.flatnonzero(is_shared)
        change = jax.random.normal(jax.random.key(0), (T, D))
        change = jnp.where(is_shared, change[:1], change)
        # every probe: its column (−1: the random change), and its frames modulo PERIOD (−1: all frames)
        columns = np.array([*np.tile(own, PERIOD), *shared, -1])
        offsets = np.array([*np.repeat(np.arange(PERIOD), len(own)), *np.full(len(shared) + 1, -1)])
        frames, count = jnp.arange(T)[:, None], len(columns)
        # Column l of the blocks of frame t is H·e with e = 1 at (t, l). A frame links at most two frames before and
        # two after, so e may be 1 in the frames t, t + 5, … at once: every row of the product belongs to one of these
        # frames.

        def product(probe):
            column, offset = probe
            unit = (jnp.arange(D) == column) & ((offset < 0) | (frames % PERIOD == offset))
            return curvature.product(jnp.where(column < 0, change, jnp.float32(unit)))

        # of equal size, so that the product is compiled once
        chunks = [np.resize(each, (-(-count // PROBES_AT_ONCE), PROBES_AT_ONCE)) for each in (columns, offsets)]
        found = jax.lax.map(jax.vmap(product), tuple(map(jnp.asarray, chunks))).reshape(-1, T, D)[:count]
        of_frames, of_window = found[: PERIOD * len(own)], found[PERIOD * len(own) : -1]
        return Products(of_frames.reshape(PERIOD, -1, T, D), of_window, change, found[-1])

    return jax.vmap(one)(problems, pose)


def blocks_of(products: Products, is_shared: np.ndarray) -> Blocks:
    """Assemble the curvature of one window, over all its columns.

    Args:
        products: the products of one window.
        is_shared: (D,) bool, as `curvature.shared_columns`.

    Raises:
        ValueError: the curvature links frames that are more than `BANDWIDTH` frames apart.
    """
    own, by_shared, change, product = (np.asarray(each, np.float64) for each in products)
    T = own.shape[2]
    band = np.zeros((BANDWIDTH + 1, T, own.shape[1], own.shape[1]))
    frames = np.arange(T)
    for k in range(BANDWIDTH + 1):
        at, later = frames[: T - k], frames[k:]
        # H is symmetric up to rounding: the mean of a block from the column of frame t + k and its transpose from
        # frame t
        above = own[later % PERIOD, :, at][..., ~is_shared].transpose(0, 2, 1)
        below = own[at % PERIOD, :, later][..., ~is_shared]
        band[k, : T - k] = (above + below) / 2
    corner = by_shared[..., is_shared].sum(axis=1)
    H = Blocks(band, by_shared[..., ~is_shared].transpose(1, 2, 0), (corner + corner.T) / 2)
    expected = np.concatenate([product[:, ~is_shared].ravel(), product[:, is_shared].sum(axis=0)])
    found = np.concatenate([each.ravel() for each in multiply(H, change[:, ~is_shared], change[0, is_shared])])
    # angles, lengths and scales have different units: rows in units of √H_ii
    unit = np.sqrt(np.maximum(np.concatenate([each.ravel() for each in H.diagonal]), 1e-6))
    if not np.linalg.norm((found - expected) / unit) <= TOLERANCE * np.linalg.norm(expected / unit):
        raise ValueError(f"a term links frames that are more than {BANDWIDTH} frames apart, or is not finite")
    return H


def multiply(
    H: Blocks, own: Float[np.ndarray, "T L"], shared: Float[np.ndarray, "C"]
) -> tuple[Float[np.ndarray, "T L"], Float[np.ndarray, "C"]]:
    """Return H·x for a change x of the parameters of the frames and of the shared parameters."""
    T = len(own)
    result = np.einsum("tij,tj->ti", H.band[0], own) + H.border @ shared
    for k in range(1, BANDWIDTH + 1):
        result[: T - k] += np.einsum("tij,tj->ti", H.band[k, : T - k], own[k:])
        result[k:] += np.einsum("tij,ti->tj", H.band[k, : T - k], own[: T - k])
    return result, np.einsum("tic,ti->c", H.border, own) + H.corner @ shared


class Columns(NamedTuple):
    """The optimised columns of `curvature.frame_rows` of a window."""

    own: Float[np.ndarray, "L"]
    """Positions of the columns that each frame has for itself."""
    shared: Float[np.ndarray, "C"]
    """Positions of the columns that all frames share."""


class Posterior(NamedTuple):
    """The Gaussian approximation of the posterior of one window, and its columns."""

    columns: Columns
    precision: Blocks
    """H, with the broad prior."""
    factors: Factors
    """The factorisation of H."""
    body: BodySensitivity | None = None
    """How the parameters depend on a body that is given; None for a body that is fixed or optimised."""

    def covariance(self) -> Blocks:
        """Return the blocks of H⁻¹ inside the band. Blocks outside the band are not 0; they are not computed."""
        return invert_blocks(self.precision, self.factors)


class BodySensitivity(NamedTuple):
    """Derivatives of the fitted parameters by the P numbers of a given body, and the columns of the body."""

    own: Float[np.ndarray, "T L P"]
    shared: Float[np.ndarray, "C P"]
    columns: Float[np.ndarray, "P"]
    """Positions of the columns of the body."""


def optimised_columns(program: Program, step_size: Pose, pose: Pose) -> Columns:
    """Return the columns with a step size above 0; a fixed parameter (such as the depth) has no posterior.

    Args:
        program: the program, whose `shared` names the optimised shared parameters.
        step_size: the step sizes of one problem.
        pose: the pose of one problem.
    """
    full = jax.tree.map(lambda x, size: np.broadcast_to(size, np.shape(x)), pose, step_size)
    optimised = np.asarray(frame_rows(full, program.shared)).max(axis=0) > 0
    is_shared = shared_columns(pose, program.shared)
    return Columns(np.flatnonzero(optimised & ~is_shared), np.flatnonzero(optimised & is_shared))


def select_columns(H: Blocks, columns: Columns, is_shared: np.ndarray) -> Blocks:
    """Return the rows and columns of some parameters of a matrix over all columns."""
    own = np.searchsorted(np.flatnonzero(~is_shared), columns.own)
    shared = np.searchsorted(np.flatnonzero(is_shared), columns.shared)
    band = H.band[:, :, own[:, None], own]
    return Blocks(band, H.border[:, own[:, None], shared], H.corner[shared[:, None], shared])


def broad_precision(program: Program, pose: Pose, px_per_unit: float | None = None) -> Float[np.ndarray, "T D"]:
    """Return the precision of a prior so broad that it matters only without data, in the columns of `frame_rows`.

    Standard deviations: π/√3 rad for the components of an axis-angle (uniform within ±π), the uniform distribution over
    the crop for x and y, the distance of the bird for z, the size of the bird for its scale, `BROAD_BONE_SD` for bone
    lengths, `BROAD_SHAPE_SD` for shape coefficients. The prior keeps directions without data finite: no matrix is
    singular.

    Args:
        program: the program.
        pose: the pose of one window.
        px_per_unit: `ViewMaps.px_per_unit` of several views, whose crops bound x, y and z; None for one view.
    """
    # the width w of the crop at the depth of the bird, model units; a uniform distribution has the deviation w/√12
    depth = np.abs(np.asarray(pose.transl)[:, 2:])
    crop = depth * program.camera.size_px / program.camera.focal_px
    if px_per_unit is not None:
        crop = np.full_like(depth, program.camera.size_px / px_per_unit)
        depth = crop / np.sqrt(12)
    sd = Pose(
        global_orient=np.full(np.shape(pose.global_orient), np.pi / np.sqrt(3)),
        body_pose=np.full(np.shape(pose.body_pose), np.pi / np.sqrt(3)),
        transl=np.concatenate([crop / np.sqrt(12)] * 2 + [depth], axis=1),
        scale=np.abs(np.asarray(pose.scale)),
        bone_length=np.full(np.shape(pose.bone_length), BROAD_BONE_SD),
        betas=np.full(np.shape(pose.betas), BROAD_SHAPE_SD),
    )
    sd = jax.tree.map(np.float32, sd)
    return np.maximum(np.asarray(frame_rows(sd, program.shared), np.float64), 1e-6) ** -2


def window_blocks(
    program: Program, problems: Problem, pose: Pose, names: Sequence[str] | None = None
) -> list[tuple[Blocks, Columns] | str]:
    """Return the curvature of the objective of each of B problems over its optimised parameters, without broad prior.

    Args:
        program: the program of the stage. `shared` must name the shared parameters that the stage optimises, for every
            solver (`with_shared`).
        problems: B problems.
        pose: their poses.
        names: the terms that count. None: all terms of the program.

    Returns:
        Blocks and columns of each problem, or the reason why it has none.

    Raises:
        InputError: a term has no curvature; the error names the term.
    """
    if names is not None:
        program = program._replace(terms={name: program.terms[name] for name in names})
    frames, is_shared = pose.global_orient.shape[1], shared_columns(_row(pose, 0), program.shared)
    if 64 * PERIOD * frames * len(is_shared) ** 2 > LARGEST_BYTES:
        return [f"windows of {frames:,} frames are too long"] * len(pose.transl)
    products = jax.tree.map(np.asarray, curvature_products(program, problems, pose))
    found: list[tuple[Blocks, Columns] | str] = []
    for b in range(len(products.change)):
        columns = optimised_columns(program, _row(problems.hyperparameters.step_size, b), _row(pose, b))
        try:
            H = blocks_of(_row(products, b), is_shared)
            found.append((select_columns(H, columns, is_shared), columns))
        except ValueError as error:
            found.append(str(error))
    return found


def window_posteriors(program: Program, problems: Problem, pose: Pose, body: int = 0) -> list[Posterior | str]:
    """Return the posterior of each of B problems of a stage at its fitted pose, or the reason why it has none.

    Args:
        program, problems, pose: as for `window_blocks`.
        body: number of the last shared parameters that are given, as numbers of a body. The posterior is that of the
            other parameters for this body, with their derivatives by the body.

    Raises:
        InputError: a term has no curvature; the error names the term.
    """
    blocks, views = window_blocks(program, problems, pose), problems.targets.views

    def broad(b: int) -> Float[np.ndarray, "T D"]:
        return broad_precision(program, _row(pose, b), None if views is None else float(views.px_per_unit[b]))

    found: list[Posterior | str] = []
    for b, each in enumerate(blocks):
        if isinstance(each, str) or not body:
            found.append(each if isinstance(each, str) else posterior_of(*each, broad(b)))
            continue
        # H·x = b for a given body y: the parameters x of the minimum follow the body by dx/dy = −H⁻¹U, with the block
        # U of parameters (rows) and body (columns)
        H, (own, shared) = each
        free = len(shared) - body
        inside = Blocks(H.band, H.border[..., :free], H.corner[:free, :free])
        posterior = posterior_of(inside, Columns(own, shared[:free]), broad(b))
        if not isinstance(posterior, str):
            slopes = solve_blocks(posterior.factors, -H.border[..., free:], -H.corner[:free, free:])
            posterior = posterior._replace(body=BodySensitivity(*slopes, shared[free:]))
        found.append(posterior)
    return found


def posterior_of(H: Blocks, columns: Columns, broad: Float[np.ndarray, "T D"]) -> Posterior | str:
    """Return the posterior with the curvature H, or the reason why it has none.

    Args:
        H: the curvature over the optimised parameters.
        columns: the optimised parameters.
        broad: precision of the broad prior over all parameters (`broad_precision`), which is added to H.
    """
    own, shared = broad[:, columns.own], broad[0, columns.shared]
    of_frames, of_window = H.diagonal
    # a ridge relative to the diagonal has no unit, so that all parameters lose the same share of precision
    for ridge in RIDGES:
        precision = H.plus_diagonal(own + ridge * of_frames, shared + ridge * of_window)
        try:
            factors = factorise(precision)
        except np.linalg.LinAlgError:
            continue
        return Posterior(columns, precision, factors)
    return "the curvature of the objective is not positive definite"


def with_shared(program: Program, stage: StageConfig) -> Program:
    """Return the program of a stage whose derivatives have columns for all shared parameters, also for Adam."""
    return program._replace(shared=shared_parameters(stage))


def _row(tree, b: int):
    """Return row `b` of a pytree of arrays."""
    return jax.tree.map(lambda x: np.asarray(x)[b], tree)
