"""Check the terms before a fit, and name the terms that make a fit diverge."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from jaxfit.config.fit import FitConfig, StageConfig
from jaxfit.fitting.problem import Problem, Program, problem_window
from jaxfit.fitting.solve import FitModel, needs_mask, stage_hyperparameters, stage_program, with_offsets
from jaxfit.foundation.errors import InputError
from jaxfit.model.kinematics import Pose, rest_pose
from jaxfit.objective.objective import evaluate_curvature, sum_with_blocks, weighted_sum
from jaxfit.objective.posed_window import Targets
from jaxfit.objective.registry import Term, find_terms


def check_terms(config: FitConfig, model: FitModel) -> None:
    """Trace every term of every stage without computing values, so that a wrong term is reported before the fit.

    The derivatives are traced for the terms of others only: they take seconds, and the tests of jaxfit's own terms
    cover them.

    Raises:
        InputError: a term does not return a scalar, needs data that the model lacks, or raises. The error names the
            term.
    """
    pose = with_offsets(model, rest_pose(model.bird, config.window, config.common_size))
    terms = {name: term for stage in config.stages for name, term in find_terms(stage.terms).items()}
    ours = [name for name, term in terms.items() if term.function.__module__.startswith("jaxfit.")]
    try:  # one trace of all is faster; where it fails, a trace of each term alone names the term
        together = replace(config.stages[-1], terms=tuple(ours), override={})
        program, problem = _example(config, together, model, pose)
        jax.eval_shape(_share_of(program, *ours), pose, problem)
        checked = set(ours)
    except Exception:
        checked = set()
    for stage in config.stages if terms.keys() - checked else ():
        program, problem = _example(config, stage, model, pose)
        for name in stage.terms:
            term = program.terms[name]
            if name in ours:
                if name not in checked:
                    _trace(term, _share_of(program, name), pose, problem)
                checked.add(name)
                continue
            _trace(term, jax.grad(_share_of(program, name)), pose, problem)
            if stage.solver == "levenberg_marquardt" or (config.error_bars and stage is config.stages[-1]):
                _trace(term, _curvature_of(program, name), pose, problem)
                if term.with_blocks is not None:
                    _trace(term, jax.grad(_share_of(program, name, with_blocks=True)), pose, problem)


def _example(config: FitConfig, stage: StageConfig, model: FitModel, pose: Pose) -> tuple[Program, Problem]:
    """Return the program of a stage and a problem without a bird."""
    T, K = config.window, model.bird.num_keypoints
    side = config.crop.size_px if needs_mask(stage) else 0
    targets = Targets(
        keypoints_px=np.zeros((T, K, 2), np.float32),
        confidence=np.zeros((T, K), np.float32),
        mask=np.zeros((T, side, side), np.uint8),
        has_mask=np.zeros(T, bool),
        present=np.zeros(T, bool),
        corner_px=np.zeros((T, 2), np.float32),
        frame_s=np.ones((), np.float32),
    )
    hyperparameters = stage_hyperparameters(config, stage, model.bird.keypoint_names)
    return stage_program(config, stage, model), Problem(hyperparameters, pose, targets)


def _trace(term: Term, function: Callable[..., object], *arguments: object) -> None:
    """Trace a function of a term, and convert all errors to InputErrors that name the term."""
    try:
        jax.eval_shape(function, *arguments)
    except InputError as error:
        if error.source.startswith("term "):
            raise
        raise InputError(f"term {term.name!r}", f"{error.source} {error.problem}", error.remedy) from error
    except Exception as error:  # a user's term may raise any exception
        file = getattr(getattr(term.function, "__code__", None), "co_filename", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        where = f" at {file}:{lines[-1]}" if lines else ""
        # the first sentence, because JAX explains its errors on many lines
        message = f"{type(error).__name__}: {error}".split("\n")[0].split(". ")[0].strip()
        problem = f"cannot be traced or differentiated{where}: {message}"
        raise InputError(f"term {term.name!r}", problem, "the term must run under jax.jit and jax.grad") from error


def name_failures(
    known: np.ndarray, step: Int[np.ndarray, "B"], stage: str, program: Program, problems: Problem, pose: Pose
) -> np.ndarray:
    """Name the terms that made problems fail.

    A step is rejected if the loss or its gradient is not finite, and a rejected step does not change the pose. The pose
    after the stage is therefore the pose of the failure. Each term is evaluated separately at this pose.

    Args:
        known: (B,) text of the earlier failure of each problem, empty without failure. An earlier failure is kept.
        step: the step of the stage at which each problem failed, from 1; 0 without failure.
        stage: name of the stage.
        program: the program of the stage.
        problems, pose: of all problems, with leading axis B.

    Returns:
        (B,) text: `known`, with the new failures.
    """
    failure = known.copy()
    new = np.flatnonzero((step > 0) & (known == ""))
    if not len(new):
        return failure
    value, gradient = _not_finite(program, *jax.tree.map(lambda x: x[new], (problems, pose)))
    for i, b in enumerate(new):
        values = [name for name in value if value[name][i]]
        gradients = [name for name in gradient if gradient[name][i] and name not in values]
        parts = [f"the value of {', '.join(values)}"] if values else []
        parts += [f"the gradient of {', '.join(gradients)}"] if gradients else []
        # the sum of finite terms may exceed the range of float32
        subject = " and ".join(parts) or "the sum of all terms"
        failure[b] = f"{subject} was not finite at step {step[b]} of stage {stage}"
    return failure


@eqx.filter_jit
def _not_finite(
    program: Program, problems: Problem, pose: Pose
) -> tuple[dict[str, Bool[Array, "B"]], dict[str, Bool[Array, "B"]]]:
    """Return, for each term and problem, whether the weighted value is not finite, and the same for the gradient."""

    def one(problem: Problem, pose: Pose):
        results = {name: jax.value_and_grad(_share_of(program, name))(pose, problem) for name in program.terms}
        bad = jax.tree.map(lambda x: ~jnp.all(jnp.isfinite(x)), results)
        bad_value = {name: value for name, (value, _) in bad.items()}
        bad_gradient = {name: jnp.any(jnp.stack(jax.tree.leaves(gradient))) for name, (_, gradient) in bad.items()}
        return bad_value, bad_gradient

    return jax.vmap(one)(problems, pose)


def _share_of(program: Program, *names: str, with_blocks: bool = False) -> Callable[[Pose, Problem], Array]:
    """Return the weighted value of terms as a function of pose and problem.

    `with_blocks`: as Levenberg-Marquardt evaluates the term, together with its blocks.
    """

    def share(pose: Pose, problem: Problem) -> Array:
        settings = {name: problem.hyperparameters.settings[name] for name in names}
        arguments = problem_window(program, problem, pose), program.terms, settings
        return sum_with_blocks(*arguments)[0] if with_blocks else weighted_sum(*arguments)

    return share


def _curvature_of(program: Program, name: str) -> Callable[[Pose, Problem], Array]:
    """Return the diagonal of the curvature of one term as a function of pose and problem."""

    def diagonal(pose: Pose, problem: Problem) -> Array:
        settings = {name: problem.hyperparameters.settings[name]}
        return evaluate_curvature(problem_window(program, problem, pose), program.terms, settings).diagonal

    return diagonal
