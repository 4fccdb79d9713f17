"""Problems, solvers (Adam, Levenberg-Marquardt), and the compiled program of a stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Float, Int

from jaxfit.config.fit import FitConfig, InitialiseConfig, StageConfig
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CROP_PX, CropCamera
from jaxfit.model.kinematics import Pose, Rig, fold_bird, move_keypoints
from jaxfit.objective.curvature import SHARED_PARAMETERS, Rows, add_rows, frame_rows, shared_columns
from jaxfit.objective.objective import evaluate_curvature, evaluate_terms, weighted_sum
from jaxfit.objective.posed_window import PosedWindow, Priors, Raster, Targets, priors_of
from jaxfit.objective.registry import Term, find_terms
from jaxfit.raster.silhouette_reference import Blur


class Program(NamedTuple):
    """The data that all problems of a stage share. `rig` and `priors` are traced; the other fields are static."""

    rig: Rig
    priors: Priors
    camera: CropCamera
    raster: Raster
    terms: Mapping[str, Term]
    """The stage's active terms, by name."""
    solver: Solver
    shared: tuple[str, ...] = ()
    """The parameters of `curvature.SHARED_PARAMETERS` that a solver with curvature optimises, in that order."""


class Hyperparameters(NamedTuple):
    """The values that may differ between the problems of a batch. All values are traced. A batch adds an axis B."""

    settings: dict[str, dict[str, Float[Array | np.ndarray, "*B"]]]
    """Weight and settings of the active terms."""
    step_size: Pose
    """Adam's step size for every parameter, in shapes that broadcast against the pose. 0 fixes a parameter, for every
    solver."""
    keypoints_on: Float[Array | np.ndarray, "*B K"]
    """1 for the keypoints that the stage uses, else 0."""


class Problem(NamedTuple):
    """The data of one problem, without the optimised pose. A batch adds a leading axis B to every array."""

    hyperparameters: Hyperparameters
    anchor: Pose
    """The pose at the beginning of the stage."""
    targets: Targets


class Solver(NamedTuple):
    """A method that improves the pose of one problem. All three functions are pure.

    A batch maps the functions over its problems.
    """

    init: Callable[[Program, Problem, Any], Any]
    """Return the state before the first step, at the anchor. The third argument is the state after the previous stage,
    whose moments the solver continues. None: the solver starts without moments."""
    step: Callable[[Program, Problem, Pose, Any], tuple[Pose, Any]]
    """Take one step. Return the next pose and state."""
    outcome: Callable[[Any], tuple[Float[Array, ""], Int[Array, ""]]]
    """Return, from a state, the last loss that the solver computed, and the number of steps of this stage that were
    rejected because the loss or its gradient was not finite. After the first rejected step, the pose is constant."""


def problem_window(program: Program, problem: Problem, pose: Pose) -> PosedWindow:
    """Return the posed window that the terms evaluate."""
    targets = problem.targets
    on = problem.hyperparameters.keypoints_on
    if targets.views is not None:  # the keypoints of the model, once for each view
        on = jnp.tile(on, targets.confidence.shape[-1] // on.shape[-1])
    active = targets.confidence * on
    targets = eqx.tree_at(lambda t: t.confidence, targets, active)
    rig, priors, camera, raster = program.rig, program.priors, program.camera, program.raster
    return PosedWindow(pose, problem.anchor, targets, rig, priors, camera, raster, program.shared)


def problem_loss(program: Program, problem: Problem, pose: Pose) -> Float[Array, ""]:
    """Return the objective. The gradient of fixed parameters is 0, so their moments stay 0."""
    optimised = jax.tree.map(
        lambda x, step: jnp.where(step > 0, x, jax.lax.stop_gradient(x)), pose, problem.hyperparameters.step_size
    )
    return weighted_sum(problem_window(program, problem, optimised), program.terms, problem.hyperparameters.settings)


class _AdamState(NamedTuple):
    minimiser: Any
    """The state of the optimistix minimiser, with Adam's moments. This module does not access its fields."""
    loss: Float[Array, ""]
    """The loss before the last step."""
    rejected: Int[Array, ""]
    """Number of rejected steps in this stage."""


def _minimiser(hyperparameters: Hyperparameters) -> optx.OptaxMinimiser:
    def scale(updates, _):
        return jax.tree.map(lambda update, step: -step * update, updates, hyperparameters.step_size)

    # with tolerances of 0 a stage takes all its steps, as in the paper
    return optx.OptaxMinimiser(optax.chain(optax.scale_by_adam(), optax.stateless(scale)), rtol=0.0, atol=0.0)


def _adam_init(program: Program, problem: Problem, carried: _AdamState | None) -> _AdamState:
    if carried is not None:
        # the minimiser's state has the moments but no step sizes: the step sizes of this stage apply
        return carried._replace(rejected=jnp.int32(0))
    scalar = jax.ShapeDtypeStruct((), jnp.float32)
    minimiser = _minimiser(problem.hyperparameters)
    state = minimiser.init(_loss_of(program), problem.anchor, problem, {}, scalar, scalar, frozenset())
    return _AdamState(state, jnp.float32(jnp.inf), jnp.int32(0))


def _adam_step(program: Program, problem: Problem, pose: Pose, state: _AdamState) -> tuple[Pose, _AdamState]:
    """Take a step of Adam, or reject the step if the loss or its gradient is not finite.

    A rejected step changes neither the pose nor the moments, so all later steps of the stage are rejected, too.
    """
    minimiser = _minimiser(problem.hyperparameters)
    moved, stepped, loss = minimiser.step(_loss_of(program), pose, problem, {}, state.minimiser, frozenset())
    # every component of the gradient changes the pose: if the new pose is finite, the gradient is finite
    finite = jnp.stack([jnp.isfinite(loss), *(jnp.isfinite(x).all() for x in jax.tree.leaves(moved))]).all()
    pose, kept = jax.tree.map(lambda a, b: jnp.where(finite, a, b), (moved, stepped), (pose, state.minimiser))
    return pose, _AdamState(kept, loss, state.rejected + ~finite)


def _loss_of(program: Program):
    def loss(pose: Pose, problem: Problem) -> tuple[Float[Array, ""], Float[Array, ""]]:
        value = problem_loss(program, problem, pose)
        return value, value  # optimistix minimises the first value, and `step` returns the second value

    return loss


def _adam_outcome(state: _AdamState) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state.loss, state.rejected


ADAM = Solver(_adam_init, _adam_step, _adam_outcome)


CG_STEPS, CG_TOLERANCE = 100, 0.01
"""Largest number of conjugate-gradient steps within one step, and the relative residual at which they end. The
first steps need few of them. A tolerance far below 1e-6 makes single precision underflow to 0/0."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-5, 1e8
"""The damping μ of the first step, and the bounds of μ."""
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 5.0
"""Factors on the damping after a step that lowered the loss, and after a step that did not lower the loss."""

MOST_RELAXATION, MOMENTUM, PESSIMISTIC = 1.5, 0.4, 0.9
"""Where the true curvature along the last step was less than `PESSIMISTIC` times that of H, the next step is longer by
at most the factor `MOST_RELAXATION`, and continues the last step by the share `MOMENTUM`."""


class _LevenbergState(NamedTuple):
    loss: Float[Array, ""]
    gradient: Rows
    damping: Float[Array, ""]
    change: Rows
    """The last step; 0 if the last step was not taken."""
    curvature_ratio: Float[Array, ""]
    """Curvature of the objective along the last step, over the curvature of H; 1 if the last step was not taken."""
    rejected: Int[Array, ""]
    """Number of steps from a pose whose loss or gradient is not finite."""


def _levenberg_init(program: Program, problem: Problem, carried: Any) -> _LevenbergState:
    assert carried is None  # `FitConfig` checks this: only Adam has moments
    loss, gradient = _loss_and_gradient(program, problem, problem.anchor)
    return _LevenbergState(
        loss=loss,
        gradient=gradient,
        damping=jnp.float32(FIRST_DAMPING),
        change=jnp.zeros_like(gradient),
        curvature_ratio=jnp.float32(1.0),
        rejected=jnp.int32(0),
    )


def _levenberg_step(
    program: Program, problem: Problem, pose: Pose, state: _LevenbergState
) -> tuple[Pose, _LevenbergState]:
    """Return x + c with c = ω·d + β·c_last and (H + μ·diag H)·d = −g if this lowers the objective, else x.

    The damping μ decreases after a step that lowered the objective, and increases otherwise. H is the curvature of
    the terms' quadratic bounds: JᵀJ within a frame, and one band between frames. Conjugate gradients need only products
    with H, so that the matrix itself is not computed.

    H is too large where it bounds an unsquared norm or leaves out second derivatives. The ratio κ of the true curvature
    along the last step to that of H measures this. For κ ≥ 0.9, ω = 1 and β = 0: a plain step. Else ω = 1/κ, at most
    1.5, and β = 0.4.

    Source: Marquardt 1963, An algorithm for least-squares estimation of nonlinear parameters; Polyak 1964, Some methods
    of speeding up the convergence of iteration methods (momentum).
    """
    window = problem_window(program, problem, pose)
    curvature = evaluate_curvature(window, program.terms, problem.hyperparameters.settings)
    step_size = jax.tree.map(lambda x, size: jnp.broadcast_to(size, x.shape), pose, problem.hyperparameters.step_size)
    optimised = frame_rows(step_size, program.shared) > 0
    is_shared = shared_columns(pose, program.shared)

    def allowed(rows: Rows) -> Rows:
        """Set the change of fixed parameters to 0, and the change of shared parameters to its mean."""
        rows = jnp.where(optimised, rows, 0.0)
        return jnp.where(is_shared, rows.mean(axis=0), rows)

    gradient = allowed(state.gradient)
    diagonal = allowed(curvature.diagonal)
    # a parameter without curvature has no gradient and does not change
    diagonal = jnp.where(diagonal > 0, diagonal, 1.0)
    newton, _ = cg(
        lambda d: allowed(curvature.product(d)) + state.damping * diagonal * d,
        -gradient,
        M=lambda d: d / diagonal,
        tol=CG_TOLERANCE,
        maxiter=CG_STEPS,
    )
    pessimistic = state.curvature_ratio < PESSIMISTIC
    relaxation = 1 / jnp.maximum(state.curvature_ratio, 1 / MOST_RELAXATION)
    change = jnp.where(pessimistic, relaxation * newton + MOMENTUM * state.change, newton)
    new_pose = add_rows(pose, change, program.shared)
    loss, new_gradient = _loss_and_gradient(program, problem, new_pose)
    not_finite = ~(jnp.isfinite(state.loss) & jnp.isfinite(state.gradient).all())
    lower = ~not_finite & (loss < state.loss) & jnp.isfinite(new_gradient).all()
    bend = jnp.vdot(change, curvature.product(change))
    ratio = 2 * (loss - state.loss - jnp.vdot(gradient, change)) / jnp.where(bend > 0, bend, 1.0)

    def choose(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda a, b: jnp.where(lower, a, b), new, old)

    factor = jnp.where(lower, DAMPING_DECREASE, DAMPING_INCREASE)
    return choose(new_pose, pose), _LevenbergState(
        loss=choose(loss, state.loss),
        gradient=choose(new_gradient, state.gradient),
        damping=jnp.clip(state.damping * factor, LEAST_DAMPING, MOST_DAMPING),
        change=choose(change, jnp.zeros_like(change)),
        curvature_ratio=choose(ratio, jnp.float32(1.0)),
        rejected=state.rejected + not_finite,
    )


def _loss_and_gradient(program: Program, problem: Problem, pose: Pose) -> tuple[Float[Array, ""], Rows]:
    """Return the objective and its gradient, one row per frame."""

    def loss(change: Rows) -> Float[Array, ""]:
        return problem_loss(program, problem, add_rows(pose, change, program.shared))

    return jax.value_and_grad(loss)(jnp.zeros_like(frame_rows(pose, program.shared)))


def _levenberg_outcome(state: _LevenbergState) -> tuple[Float[Array, ""], Int[Array, ""]]:
    return state.loss, state.rejected


LEVENBERG_MARQUARDT = Solver(_levenberg_init, _levenberg_step, _levenberg_outcome)


class StageState(NamedTuple):
    """The current poses and solver states of a batch of B problems in one stage."""

    pose: Pose
    solver: Any
    """The state of the solver, with leading axis B."""


@eqx.filter_jit
def begin(program: Program, problems: Problem, carried: Any) -> StageState:
    """Return the state at the beginning of a stage, at the anchor poses.

    Args:
        program: the program of the stage.
        problems: the problems, with leading axis B.
        carried: the solver state after the previous stage, whose moments continue. None: the moments start at 0.
    """

    def one(problem: Problem, carried: Any) -> Any:
        return program.solver.init(program, problem, carried)

    solver = jax.vmap(one)(problems, carried)
    # `advance` reuses the memory of its state, so the state must not share memory with the anchor
    return StageState(*jax.tree.map(jnp.copy, (problems.anchor, solver)))


@eqx.filter_jit(donate="all-except-first")
def advance(
    fixed: tuple[Program, Problem, Int[Array, ""]], state: StageState
) -> tuple[StageState, Float[Array, "B"], Int[Array, "B"]]:
    """Take some steps.

    Args:
        fixed: the program, the problems (B, …) and the number of steps (traced).
        state: the current state. Its memory is reused, so the caller must use the returned state instead.

    Returns:
        The new state, and `Solver.outcome` of each problem: loss (B,) and rejected steps (B,).
    """
    program, problems, steps = fixed

    def one(problem: Problem, state: StageState) -> StageState:
        def step(_, state: StageState) -> StageState:
            return StageState(*program.solver.step(program, problem, *state))

        return jax.lax.fori_loop(0, steps, step, state)

    state = jax.vmap(one)(problems, state)
    return state, *jax.vmap(program.solver.outcome)(state.solver)


class Report(NamedTuple):
    """The objective and the keypoints at a batch of poses."""

    loss: dict[str, Float[Array, "B"]]
    """Weighted value of each term in the objective."""
    keypoints_cam: Float[Array, "B T K 3"]
    keypoints_px: Float[Array, "B T K 2"]
    """Crop pixels."""


@eqx.filter_jit
def report(program: Program, problems: Problem, pose: Pose) -> Report:
    """Evaluate the objective at a batch of poses. A solver's state has only the loss before its last step."""

    def one(problem: Problem, pose: Pose) -> Report:
        window, settings = problem_window(program, problem, pose), problem.hyperparameters.settings
        values = evaluate_terms(window, program.terms, settings)
        weighted = {name: jnp.asarray(settings[name]["weight"]) * value for name, value in values.items()}
        return Report(weighted, window.keypoints_cam, window.keypoints_px)

    return jax.vmap(one)(problems, pose)


SOLVERS: Mapping[str, Solver] = {"adam": ADAM, "levenberg_marquardt": LEVENBERG_MARQUARDT}
"""Solvers by their name in `StageConfig.solver`."""
STEP_SHAPES = {
    "global_orient": (3,),
    "body_pose": (1, 3),
    "transl": (3,),
    "scale": (),
    "bone_length": (1,),
    "betas": (1,),
}
"""Shapes of the step sizes: all frames, bones and shape coefficients have the same step size."""


class FitModel(NamedTuple):
    """The bird, its folded arrays, its priors and the crop camera, for all stages of a fit."""

    bird: Bird
    rig: Rig
    """With the keypoints of the config (`keypoint_offsets`)."""
    priors: Priors
    camera: CropCamera


def fit_model(bird: Bird, config: FitConfig) -> FitModel:
    """Return the model of a fit: the bird, folded, with the keypoints of the config, and its crop camera."""
    rig = fold_bird(bird)
    if config.keypoint_offsets:
        offsets = [config.keypoint_offsets.get(name, (0.0, 0.0, 0.0)) for name in bird.keypoint_names]
        rig = move_keypoints(rig, np.array(offsets, np.float32))
    return FitModel(bird, rig, priors_of(bird), crop_camera(config))


def crop_camera(config: FitConfig) -> CropCamera:
    """Return the crop camera, in crop pixels."""
    return CropCamera(config.crop.focal_px, CROP_PX / 2, CROP_PX)


def needs_mask(stage: StageConfig) -> bool:
    """Return whether any term of a stage compares masks."""
    return any(term.compares_masks for term in find_terms(stage.terms).values())


def without_mask_stages(config: FitConfig) -> FitConfig:
    """Return a config whose stages compare no masks, for observations without masks.

    A stage that compares masks becomes a continuation of the stage before it: it has the terms, the keypoints, the
    optimised parameters and the solver of that stage, but its own steps and its own `override`. Without the
    continuation, the fit would end after a stage that another stage is meant to follow: its steps may end far from the
    minimum, and its `override` may be for the beginning of a fit only. A stage that compares masks is left out if no
    stage stands before it.

    A config that has no other stages keeps its stages, without the terms that compare masks.
    """
    if all(map(needs_mask, config.stages)):
        stages = [replace(stage, terms=_terms_without_masks(stage)) for stage in config.stages]
        return replace(config, stages=tuple(stages))
    kept: list[StageConfig] = []
    for stage in config.stages:
        if kept and needs_mask(stage):
            kept.append(_continuation(kept[-1], stage))
        elif not needs_mask(stage):
            carry = stage.carry_moments and bool(kept) and kept[-1].solver == "adam"
            kept.append(replace(stage, carry_moments=carry))
    return replace(config, stages=tuple(kept))


def _continuation(before: StageConfig, stage: StageConfig) -> StageConfig:
    """Return the stage that takes the place of `stage`, which compares masks, after the stage `before`."""
    return replace(
        before,
        name=stage.name,
        # a number of steps of one solver says nothing about the other solver
        steps=stage.steps if stage.solver == before.solver else before.steps,
        override=stage.override,
        carry_moments=before.solver == "adam",
        keep_best=stage.keep_best,
    )


def _terms_without_masks(stage: StageConfig) -> tuple[str, ...]:
    others = (name for name, term in find_terms(stage.terms).items() if not term.compares_masks)
    return tuple(others) or stage.terms


def stage_program(config: FitConfig, stage: StageConfig, model: FitModel) -> Program:
    """Return the program of one stage. The functions of the terms are part of the program."""
    blur = Blur.for_size(config.crop.size_px, stage.blur, config.edge)
    raster = Raster(blur, config.crop.size_px, config.backend)
    return Program(
        model.rig,
        model.priors,
        model.camera,
        raster,
        find_terms(stage.terms),
        SOLVERS[stage.solver],
        _shared_columns(stage),
    )


def _shared_columns(stage: StageConfig) -> tuple[str, ...]:
    """Return the shared parameters that Levenberg-Marquardt optimises; Adam does not need their names."""
    return () if stage.solver == "adam" else shared_parameters(stage)


def shared_parameters(stage: StageConfig) -> tuple[str, ...]:
    """Return the parameters of `curvature.SHARED_PARAMETERS` that a stage optimises."""
    return tuple(name for name in SHARED_PARAMETERS if name in stage.optimised)


def stage_hyperparameters(config: FitConfig, stage: StageConfig, keypoint_names: Sequence[str]) -> Hyperparameters:
    """Return the hyperparameters of one stage of one config, as NumPy arrays for one problem."""

    def step_size(name: str, shape: tuple[int, ...]) -> np.ndarray:
        scale = np.asarray(stage.step_scale.get(name, 1.0), np.float32)
        size = stage.learning_rate * scale if name in stage.optimised else 0.0
        return np.array(np.broadcast_to(size, shape), np.float32)

    return Hyperparameters(
        settings={
            name: {key: np.array(value, np.float32) for key, value in values.items()}
            for name, values in config.stage_settings(stage).items()
        },
        step_size=Pose(**{name: step_size(name, shape) for name, shape in STEP_SHAPES.items()}),
        keypoints_on=np.array([name not in stage.keypoints_off for name in keypoint_names], np.float32),
    )


def compiled_part(config: FitConfig) -> FitConfig:
    """Return the part of the config that determines the compiled program.

    Configs with an equal compiled part differ only in hyperparameters and in the preparation of the data.
    """
    stages = tuple(
        replace(
            stage,
            # `betas` sets the number of shape coefficients, and the solver may need columns for shared parameters; the
            # other names only set step sizes
            optimised=tuple(sorted({*_shared_columns(stage), *({"betas"} & set(stage.optimised))})),
            learning_rate=1.0,
            step_scale={},
            keypoints_off=(),
            override={},
        )
        for stage in config.stages
    )
    return replace(
        config,
        stages=stages,
        terms={},
        overlap=0,
        filter_window=1,
        min_keypoints=1,
        learn_weights=(),
        crop=replace(config.crop, padding=0.0),
        initialise=InitialiseConfig(hypotheses=config.initialise.hypotheses),
    )
