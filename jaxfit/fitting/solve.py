"""The solver Adam, and the compiled programs of a stage: begin, take steps, report."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfit.config.fit import FitConfig, InitialiseConfig, Parameter, StageConfig
from jaxfit.fitting.initial_poses import InitialPoses
from jaxfit.fitting.keypoint_offsets import PRIOR_SHARE, longest_distance, offset_directions
from jaxfit.fitting.levenberg_marquardt import LEVENBERG_MARQUARDT
from jaxfit.fitting.problem import Hyperparameters, Problem, Program, Solver, problem_loss, problem_window
from jaxfit.fitting.stored_programs import StoredProgram
from jaxfit.model.bird import Bird
from jaxfit.model.camera import CROP_PX, CropCamera
from jaxfit.model.kinematics import Pose, Rig, fold_bird, move_keypoints, with_detector
from jaxfit.objective.curvature import (
    SHARED_PARAMETERS,
)
from jaxfit.objective.objective import evaluate_terms
from jaxfit.objective.posed_window import Priors, Raster, priors_of
from jaxfit.objective.registry import find_terms
from jaxfit.raster.silhouette_reference import Blur
from jaxfit.raster.zbuffer import vertex_normals

if TYPE_CHECKING:
    from optimistix import OptaxMinimiser


class _AdamState(NamedTuple):
    minimiser: Any
    """The state of the optimistix minimiser, with Adam's moments. This module does not access its fields."""
    loss: Float[Array, ""]
    """The loss before the last step."""
    rejected: Int[Array, ""]
    """Number of rejected steps in this stage."""


def _minimiser(hyperparameters: Hyperparameters) -> OptaxMinimiser:
    # imported here, because the import takes as long as two steps of Levenberg-Marquardt, which does not need them
    import optax
    from optimistix import OptaxMinimiser

    def scale(updates, _):
        return jax.tree.map(lambda update, step: -step * update, updates, hyperparameters.step_size)

    # with tolerances of 0 a stage takes all its steps, as in the paper
    return OptaxMinimiser(optax.chain(optax.scale_by_adam(), optax.stateless(scale)), rtol=0.0, atol=0.0)


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


ADAM = Solver(_adam_init, _adam_step)


class StageState(NamedTuple):
    """The current poses and solver states of a batch of B problems in one stage."""

    pose: Pose
    solver: Any
    """The state of the solver, with leading axis B."""
    started: Bool[Array, ""]
    """Whether the preparing steps of the solver were taken."""


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
    # `advance` reuses the memory of its state, so the state must not share memory with the anchor. Its results are not
    # weakly typed. A weakly typed first state, as of Adam's counter, would compile the same program once more.
    copies = jax.tree.map(lambda x: jnp.array(x, x.dtype), (problems.anchor, solver))
    return StageState(*copies, started=jnp.bool_(False))


@functools.partial(StoredProgram, structure=lambda fixed, state: (state, 0, 0), reuses_state=True)
def advance(
    fixed: tuple[Program, Problem, Int[Array, ""]], state: StageState
) -> tuple[StageState, Float[Array, "B"], Int[Array, "B"]]:
    """Take some steps, after the preparing steps of the solver where the state has not started.

    Args:
        fixed: the program, the problems (B, …) and the number of steps (traced).
        state: the current state. Its memory is reused, so the caller must use the returned state instead.

    Returns:
        The new state, and loss (B,) and number of rejected steps (B,) of the problems.
    """
    program, problems, steps = fixed
    count = steps + jnp.where(state.started, 0, program.solver.preparing_steps)

    def step(_, at: tuple[Pose, Any]) -> tuple[Pose, Any]:
        return jax.vmap(functools.partial(program.solver.step, program))(problems, *at)

    # the loop outside: to batch a loop, JAX traces its body a second time
    pose, solver = jax.lax.fori_loop(0, count, step, (state.pose, state.solver))
    return StageState(pose, solver, jnp.bool_(True)), solver.loss, solver.rejected


class Report(NamedTuple):
    """The objective and the keypoints at a batch of poses; the keypoints are without offsets that were learnt."""

    loss: dict[str, Float[Array, "B"]]
    """Weighted value of each term in the objective."""
    keypoints_cam: Float[Array, "B T K 3"]
    keypoints_px: Float[Array, "B T K 2"]
    """Crop pixels."""


@functools.partial(
    StoredProgram, structure=lambda program, problems, pose: Report._make((dict.fromkeys(program.terms, 0), 0, 0))
)
def report(program: Program, problems: Problem, pose: Pose) -> Report:
    """Evaluate the objective at a batch of poses. A solver's state has only the loss before its last step."""

    def one(problem: Problem, pose: Pose) -> Report:
        window, settings = problem_window(program, problem, pose), problem.hyperparameters.settings
        values = evaluate_terms(window, program.terms, settings)
        weighted = {name: jnp.asarray(settings[name]["weight"]) * value for name, value in values.items()}
        if program.rig.of_detector:
            betas = jnp.asarray(pose.betas).at[program.rig.num_shapes :].set(0)
            window = problem_window(program, problem, replace(pose, betas=betas))
        return Report(weighted, window.keypoints_cam, window.keypoints_px)

    return jax.vmap(one)(problems, pose)


SOLVERS: Mapping[str, Solver] = {"adam": ADAM, "levenberg_marquardt": LEVENBERG_MARQUARDT}
"""Solvers by their name in `StageConfig.solver`."""
STEP_SHAPES: Mapping[Parameter, tuple[int, ...]] = {
    "global_orient": (3,),
    "body_pose": (1, 3),
    "transl": (3,),
    "scale": (),
    "bone_length": (1,),
    "betas": (1,),
}
"""Shapes of the step sizes: all frames, bones and shape coefficients have the same step size."""


class FitModel(NamedTuple):
    """What all tasks of a fit share: the bird, its folded arrays, its priors, the crop camera, and initial poses."""

    bird: Bird
    rig: Rig
    """With the keypoints of the config (`keypoint_offsets`)."""
    priors: Priors
    camera: CropCamera
    initial_poses: InitialPoses | None = None
    """Initial poses of all tracks and frames, from a file. None: a search."""


def fit_model(bird: Bird, config: FitConfig, initial_poses: InitialPoses | None = None) -> FitModel:
    """Return the model of a fit: the bird, folded, with the keypoints of the config, and its crop camera.

    If the config learns `keypoint_offsets` with the bodies, the last shape coefficients are those of the detector.
    """
    rig, priors = fold_bird(bird), priors_of(bird)
    if config.keypoint_offsets:
        offsets = [config.keypoint_offsets.get(name, (0.0, 0.0, 0.0)) for name in bird.keypoint_names]
        rig = move_keypoints(rig, np.array(offsets, np.float32))
    if config.learns_offsets:
        rig = with_detector(rig, vertex_normals(bird.vertices, bird.faces), offset_directions(bird))
        offset_sd = np.full(rig.of_detector, PRIOR_SHARE * longest_distance(bird), np.float32)
        priors = priors._replace(shape_sd=jnp.concatenate([priors.shape_sd, offset_sd]))
    return FitModel(bird, rig, priors, crop_camera(config), initial_poses)


def with_offsets(model: FitModel, pose: Pose) -> Pose:
    """Return a pose with all shape coefficients of the model; offsets of keypoints that it lacks are 0."""
    free = len(model.rig.keypoint_shape_map) - np.shape(pose.betas)[-1]
    return replace(pose, betas=np.pad(pose.betas, [(0, 0)] * (np.ndim(pose.betas) - 1) + [(0, free)]))


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

    A config that has no other stages keeps its stages, without the terms that compare masks. If no term is left, the
    config is returned unchanged.

    A stage that shares the body, and the stages after it, only lose the terms that compare masks.
    """
    only_masks = all(map(needs_mask, config.stages))
    kept: list[StageConfig] = []
    for stage in config.stages:
        others = tuple(name for name, term in find_terms(stage.terms).items() if not term.compares_masks)
        carry = stage.carry_moments and bool(kept) and kept[-1].solver == "adam"
        shares = stage.share_body or any(before.share_body for before in kept)
        if kept and needs_mask(stage) and not (only_masks or shares):
            kept.append(_continuation(kept[-1], stage))
        elif others and (only_masks or shares or not needs_mask(stage)):
            kept.append(replace(stage, terms=others, carry_moments=carry))
    return replace(config, stages=tuple(kept)) if kept else config


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

    def step_size(name: Parameter, shape: tuple[int, ...]) -> np.ndarray:
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
        # learnt offsets are further shape coefficients
        learn_weights=("keypoint_offsets",) if config.learns_offsets else (),
        crop=replace(config.crop, padding=0.0),
        initialise=InitialiseConfig(hypotheses=config.initialise.hypotheses),
    )
