"""`fit`: from observations to a solution.

The data passes each step once: observations → windows → targets and initial poses → stages → solution.
"""

from __future__ import annotations

import logging
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jaxfit.config.build import with_values
from jaxfit.config.fit import FitConfig
from jaxfit.data.flags import with_doubts
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution
from jaxfit.fitting.batch import bytes_per_frame
from jaxfit.fitting.bodies import Body, known_rows, with_bodies
from jaxfit.fitting.collect import blend_seams, collect_windows
from jaxfit.fitting.crops import square_images
from jaxfit.fitting.diagnose import check_terms
from jaxfit.fitting.initial_poses import InitialPoses
from jaxfit.fitting.learn import Learnt, learn, without_offsets_of_outlines
from jaxfit.fitting.side_views import seen_from_the_side, single_frame_config
from jaxfit.fitting.solve import FitModel, compiled_part, fit_model, needs_mask, without_mask_stages
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.fitting.tasks import FitTask, fit_windows
from jaxfit.fitting.windows import Windows, cut_windows, distant_birds, report_distant_birds, windows_key
from jaxfit.foundation.array_files import MAX_TABLE_GB, check_memory, observations_bytes
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.progress import ProgressTask, silent
from jaxfit.foundation.workers import Cluster
from jaxfit.model.bird import Bird

MAX_WINDOW_GB = 8.0
"""Largest memory of one window, by estimate, unless `memory_gb` is larger."""


def check_fit_memory(observations: Observations, bird: Bird, configs: Sequence[FitConfig], source: object) -> None:
    """Check that the tables of a fit, and one window, fit into memory.

    Args:
        observations: N tracks over T frames.
        bird: the model.
        configs: configs that share one compiled program.
        source: name of the observations in messages.

    Raises:
        InputError: the tables of poses, or one window, need more memory than `MAX_TABLE_GB` or `MAX_WINDOW_GB`, and
            than `memory_gb`.
    """
    config, N, T = configs[0], observations.num_tracks, observations.num_frames
    bones, K = bird.num_joints - 1, bird.num_keypoints
    # numbers of a pose, of its keypoints and of its crop; the validation of a solution copies them
    numbers = 4 * bones + 5 * K + bird.num_shapes + 16
    if config.error_bars:
        numbers += 4 * bones + 22 * K + bird.num_shapes + 8
    pose_bytes = 2 * 4 * numbers
    held = 2 * N * T * (26 + 13 * K)  # the observations as read, and with the keypoints in the order of the model
    needed = observations_bytes(N, T, K) + held + N * T * len(configs) * pose_bytes
    runs = f" in {len(configs)} runs" if len(configs) > 1 else ""
    remedy = "split the file into parts with fewer frames or tracks, or raise `memory_gb` in the config"
    tables = f"the poses of {N:,} tracks over {T:,} frames{runs}"
    check_memory(source, tables, needed, remedy, max(MAX_TABLE_GB, config.memory_gb))

    search = config.initialise
    orientations = search.turns * search.directions if search.method != "viewing_axis" else search.turns
    candidates = min(search.candidates, orientations)
    # the search compares every orientation with the keypoints, and every candidate with those of the next frame
    search_bytes = 450 * orientations + 12 * candidates**2
    needed = config.window * (search.hypotheses * bytes_per_frame(bird, config) + search_bytes)
    window = f"the arrays of a window of {config.window:,} frames"
    remedy = "lower `window`, `crop.size_px` or the numbers of `initialise`, or raise `memory_gb`"
    check_memory("config", window, needed, remedy, max(MAX_WINDOW_GB, config.memory_gb))


_logger = logging.getLogger(__name__)

LEARN_REMEDY = "set `learn_weights: []`, or use the learnt.yaml of a result as config"


def fit(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
    stored: StoredWindows | None = None,
    cluster: Cluster | None = None,
    bodies: Mapping[int, Body] | None = None,
) -> Solution:
    """Fit the poses of all birds of a video (or of a set of photographs).

    Args:
        observations: keypoints and masks. The keypoints must have the names of the model's keypoints, in any order.
        bird: the model.
        config: the config of the fit.
        initial_poses: initial poses from a file. None: a search with the settings `config.initialise`.
        progress: shows progress.
        source: name of the observations in error messages.
        stored: receives every fitted window, and holds the windows of an interrupted fit, which are not fitted again.
        cluster: worker processes that fit the windows. None: this process.
        bodies: track id → known body of a bird (`fitting.bodies.bodies_of`). Other bodies are estimated.

    Returns:
        The poses, and the status of every track: `ok`, `partly diverged`, `diverged` or `no usable frame`. A window
        whose task failed on the workers counts as diverged.

    Raises:
        InputError: no bird, other keypoints than the model's, no track with a usable frame, unusable crop settings, an
            unusable term, initial poses that do not match the windows, a fit that needs too much memory, or a cluster
            that ends.
    """
    if config.learns_first:
        config = learn_weights(observations, bird, config, initial_poses, progress, source).config
    several = fit_runs(
        observations, bird, [config], initial_poses, progress, source, stored=stored, cluster=cluster, bodies=bodies
    )
    return several[0]


def learn_weights(
    observations: Observations,
    bird: Bird,
    config: FitConfig,
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
) -> Learnt:
    """Learn weights and scales of the terms of a config from observations (`jaxfit.fitting.learn`).

    The work is done in this process, also where workers fit the windows.

    Args:
        observations, bird, config, initial_poses, progress, source: as for `fit`.

    Returns:
        The config with the learnt values and without `learn_weights`, the learnt values, and the reasons why values
        were not learnt.

    Raises:
        InputError: as for `fit`.
    """
    observations = check_observations(observations, bird, source)
    config, of_outlines = without_offsets_of_outlines(config, observations)
    if not config.learn_weights:
        return Learnt(config, {}, of_outlines)
    used = config if observations.masks else without_mask_stages(config)
    model = checked_model(observations, bird, [used], initial_poses, source)
    (windows,) = _windows_of_runs(observations, [used], model, source)
    values, remarks = learn(model, used, windows, progress, source)
    config = replace(config, learn_weights=())
    return Learnt(with_values(config, values) if values else config, values, (*of_outlines, *remarks))


def fit_runs(
    observations: Observations,
    bird: Bird,
    configs: Sequence[FitConfig],
    initial_poses: InitialPoses | None = None,
    progress: ProgressTask = silent,
    source: object = "observations",
    select: Int[np.ndarray, "rows"] | None = None,
    stored: StoredWindows | None = None,
    cluster: Cluster | None = None,
    bodies: Mapping[int, Body] | None = None,
) -> list[Solution]:
    """Fit the same birds under several configs at once, with one compiled program.

    Args:
        configs: configs with an equal `stages.compiled_part`.
        select: rows of the windows (`windows_of`) that are fitted; None fits all. Other windows have no valid pose.
        observations, bird, initial_poses, progress, source, stored, cluster, bodies: as for `fit`; `stored` is for one
            config.

    Returns:
        The solution of every config.

    Raises:
        InputError: as for `fit`.
        ValueError: the configs need different programs.
    """
    if any(config.learns_first for config in configs):
        raise InputError(
            "config", "`learn_weights` names terms, but several fits at once learn no weights", LEARN_REMEDY
        )
    observations = check_observations(observations, bird, source)
    configs = [without_offsets_of_outlines(config, observations)[0] for config in configs]
    skipped = report_distant_birds(observations, source)
    if not observations.masks:
        configs = _without_mask_stages(configs, source)
    if configs[0].crop.mode == "image":
        _report_other_images(observations, source)
    if any(compiled_part(config) != compiled_part(configs[0]) for config in configs):
        allowed = "weights, settings, step sizes and the preparation of the data"
        raise ValueError(f"configs: expected configs that share one compiled program and differ only in {allowed}")
    model = checked_model(observations, bird, configs, initial_poses, source)
    windows = _windows_of_runs(observations, configs, model, source)
    if select is not None:
        windows = [each[select] for each in windows]
    # each problem is one window of one run
    problems = [(r, w) for r, some in enumerate(windows) for w in range(len(some))]
    task = FitTask(list(configs), windows, problems)
    birds = len(np.unique(windows[0].track))
    subject = f"{birds} {'bird' if birds == 1 else 'birds'}" + (f" × {len(configs)} runs" if len(configs) > 1 else "")
    known = known_rows(bodies, observations.track_id)
    names = [observations.species.get(track, "") for track in observations.track_id.tolist()]
    species = np.unique(names, return_inverse=True)[1]
    results, found = fit_windows(
        task, model, observations.num_tracks, subject, progress, stored, cluster, known, species
    )
    solutions = []
    for r, (config, some) in enumerate(zip(configs, windows, strict=True)):
        fitted = [results.pop((r, w)) for w in range(len(some))]
        if config.overlap_frames:
            fitted = blend_seams(some, fitted, model)
        solution = collect_windows(observations, some, fitted, bird, model.camera, config.common_size, skipped)
        if found[r]:
            solution = with_bodies(solution, found[r], bird, config, source)
        solutions.append(with_doubts(solution, observations, bird, progress))
    return solutions


def checked_model(
    observations: Observations,
    bird: Bird,
    configs: Sequence[FitConfig],
    initial_poses: InitialPoses | None,
    source: object,
) -> FitModel:
    """Return the model of a fit, after checks of the memory and of the terms that the fit needs.

    Args:
        observations, bird, configs, initial_poses, source: as for `fit_runs`.

    Raises:
        InputError: the fit needs too much memory, a term is unusable, or a keypoint with an offset is unknown.
    """
    check_fit_memory(observations, bird, configs, source)
    return model_of_fit(bird, configs[0], initial_poses)


def model_of_fit(bird: Bird, config: FitConfig, initial_poses: InitialPoses | None = None) -> FitModel:
    """Return the model of a fit, after the checks that need no observations; call this function before long work.

    Raises:
        InputError: a term is unusable, or a keypoint with an offset is unknown.
    """
    unknown = set(config.keypoint_offsets) - set(bird.keypoint_names)
    if unknown:
        problem = f"`keypoint_offsets` names keypoints that the model lacks: {', '.join(sorted(unknown))}"
        raise InputError("config", problem, f"the model has {', '.join(bird.keypoint_names)}")
    model = fit_model(_fitted_bird(bird, config, initial_poses), config, initial_poses)
    check_terms(config, model)
    return model


def _report_other_images(observations: Observations, source: object) -> None:
    """Report the birds whose images are not square and of one size, so that their crops follow the birds."""
    sizes_px = observations.image_sizes_px()
    birds = sum(not square_images(sizes_px[n, seen]) for n, seen in enumerate(observations.present))
    if birds:
        text = "%s: the images of %d of %d birds are not square and of one size, so their crops follow the birds"
        _logger.warning(text, source, birds, observations.num_tracks)


def _without_mask_stages(configs: Sequence[FitConfig], source: object) -> list[FitConfig]:
    """Return the configs with stages that compare no masks, and report the changed stages once."""
    left = [without_mask_stages(config) for config in configs]
    if any(any(map(needs_mask, config.stages)) for config in left):
        problem = "holds no masks, but every term of the config compares masks"
        raise InputError(source, problem, "give masks, or choose a config with terms that compare keypoints")
    kept = {stage.name for stage in left[0].stages}
    changed = [stage.name for stage in configs[0].stages if needs_mask(stage)]
    for stages, what in (
        (kept.intersection(changed), "run without the terms that compare masks"),
        (set(changed) - kept, "are skipped"),
    ):
        if stages:
            names = ", ".join(name for name in changed if name in stages)
            _logger.warning("%s: no masks, so these stages %s: %s", source, what, names)
    return left


def check_observations(observations: Observations, bird: Bird, source: object) -> Observations:
    """Return the observations with their keypoints in the order of the model.

    Raises:
        InputError: no bird, or other keypoints than the model's.
    """
    if not observations.num_tracks:
        raise InputError(source, "holds no bird", "look whether birds are visible; if so, use another network")
    return check_keypoints(observations, bird.keypoint_names, source)


def windows_of(observations: Observations, config: FitConfig, source: object) -> Windows:
    """Return the windows of a fit.

    Raises:
        InputError: no track with a usable frame, or unusable crop settings.
    """
    windows = cut_windows(observations, config)
    if len(windows) == 0 and distant_birds(observations).any():
        problem = "no track has a usable frame: boxes or keypoints lie far outside their images"
        raise InputError(source, problem, "give positions in image pixels")
    if len(windows) == 0:
        raise InputError(
            source,
            f"no track has a frame with {max(config.min_keypoints, 1)} confident keypoints",
            "detect more keypoints, or lower min_keypoints in the config: with 0, masks are enough for `jaxfit fit`",
        )
    return windows


def _windows_of_runs(
    observations: Observations, configs: Sequence[FitConfig], model: FitModel, source: object
) -> list[Windows]:
    """Return the windows of each config. Configs with an equal `windows_key` share their windows."""
    windows: dict[Hashable, Windows] = {}
    sides: dict[Hashable, Bool[np.ndarray, "W"]] = {}
    initial_poses, found = model.initial_poses, []
    for config in configs:
        key = windows_key(config)
        if key not in windows:
            windows[key] = windows_of(observations, config, source)
            if initial_poses is not None:
                if config.overlap_frames and initial_poses.crop is not None:
                    problem = "holds one crop for every frame, but windows that share a frame have two"
                    remedy = "set `overlap: 0` in the config, or leave out --init"
                    raise InputError(initial_poses.source, problem, remedy)
                initial_poses.check_crops(windows[key])
        own = windows[key]
        if config.initialise.method == "auto" and initial_poses is None:
            which = key, repr(single_frame_config(config))
            if which not in sides:
                sides[which] = seen_from_the_side(own, config, model)
                tracks, side = (len(np.unique(some)) for some in (own.track, own.track[sides[which]]))
                text = "seen from the side: all orientations are searched" if side else "seen from above"
                _logger.info("%d of %d tracks: %s", side or tracks, tracks, text)
            own = replace(own, all_orientations=sides[which])
        found.append(own)
    return found


def _fitted_bird(bird: Bird, config: FitConfig, initial_poses: InitialPoses | None) -> Bird:
    """Return the bird with the prior of the config, without shape directions that no stage and no initial pose uses.

    Unused shape directions only cost time.
    """
    if config.species_bone_sd:
        mirrored = np.eye(bird.num_joints - 1)
        for left, right in bird.bone_pairs:
            mirrored[left, right] = mirrored[right, left] = 1
        widened = np.asarray(bird.bone_covariance, np.float64) + config.species_bone_sd**2 * mirrored
        bird = replace(bird, bone_covariance=jnp.asarray(widened, jnp.float32))
    if any("betas" in stage.optimised for stage in config.stages):
        return bird
    if initial_poses is not None and initial_poses.has_shape:
        return bird
    return eqx.tree_at(
        lambda b: (b.shape_basis, b.shape_variance), bird, (bird.shape_basis[:0], bird.shape_variance[:0])
    )
