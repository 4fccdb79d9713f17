"""Observations without masks: stages that compare masks continue with keypoints. tests/cli/test_import.py fits one."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from support.fits import BIRD, CAMERA, config, truths

from jaxfit.config.fit import StageConfig, load_config, shipped_fit_configs
from jaxfit.data.formats.coco import read_coco
from jaxfit.fitting.fit import _without_mask_stages, fit
from jaxfit.fitting.solve import needs_mask, without_mask_stages
from jaxfit.foundation.errors import InputError
from jaxfit.model.published import import_model
from jaxfit.simulation.noise import detect


@pytest.mark.parametrize("name", shipped_fit_configs())
def test_shipped_configs_keep_all_their_steps_but_no_mask_terms(name):
    whole = load_config(name)
    short = without_mask_stages(whole)
    assert [(stage.name, stage.steps) for stage in short.stages] == [(s.name, s.steps) for s in whole.stages]
    for before, stage, given in zip(short.stages, short.stages[1:], whole.stages[1:], strict=False):
        assert not needs_mask(stage)
        if given.share_body or before.share_body:
            assert stage == dataclasses.replace(given, terms=stage.terms)
        elif needs_mask(given):
            assert (stage.terms, stage.keypoints_off) == (before.terms, before.keypoints_off)
            assert (stage.optimised, stage.step_scale) == (before.optimised, before.step_scale)


def test_the_fit_ends_with_the_settings_of_its_last_stage():
    """The first stage of `map` has wider errors, only for the search; a fit without masks does not end with them."""
    first, *later = without_mask_stages(load_config("map")).stages
    assert first.override
    assert not any(stage.override for stage in later)


def total_loss(observations, config, bird=BIRD):
    solution = fit(observations, bird, config)
    assert (solution.status == "ok").all()
    return sum(np.asarray(loss) for loss in solution.loss.values())


def with_last_steps(config, steps):
    return dataclasses.replace(
        config, stages=(*config.stages[:-1], dataclasses.replace(config.stages[-1], steps=steps))
    )


def test_a_stage_that_was_to_be_followed_by_masks_converges():
    """The keypoint stage alone ends far from the minimum. The fit comes as near as with many more steps."""
    first = StageConfig("first", 4, ("keypoints", "pose_prior"), solver="levenberg_marquardt")
    second = dataclasses.replace(first, steps=30, terms=("keypoints", "mask", "pose_prior"))
    whole = config(window=1, common_size=False)
    whole = dataclasses.replace(whole, stages=(first, second))
    # other birds have two minima, and the rounding of a processor decides between them
    observations = dataclasses.replace(detect(BIRD, truths(frames=2, birds=2)[1:], camera=CAMERA), masks={})
    loss = total_loss(observations, whole)
    converged = total_loss(observations, with_last_steps(without_mask_stages(whole), 150))
    alone = total_loss(observations, dataclasses.replace(whole, stages=whole.stages[:1]))
    assert (loss < 1.005 * converged).all()
    assert (alone > 1.05 * converged).any()


def staged(*stages):
    return without_mask_stages(dataclasses.replace(config(), stages=stages)).stages


def test_adam_continues_with_its_moments_and_every_config_stays_valid():
    stages = [
        StageConfig(name, 3, ("keypoints", *["mask"] * ("m" in name)), solver=solver, carry_moments=carry)
        for name, carry, solver in (
            ("m0", False, "adam"),
            ("a", False, "adam"),
            ("m1", False, "adam"),
            ("b", True, "adam"),
            ("c", False, "levenberg_marquardt"),
            ("m2", False, "adam"),
            ("d", True, "adam"),
        )
    ]
    short = staged(*stages)  # FitConfig checks that moments pass from Adam to Adam only
    carried = [("a", False), ("m1", True), ("b", True), ("c", False), ("m2", False), ("d", False)]
    assert [(stage.name, stage.carry_moments) for stage in short] == carried
    assert all(not after.carry_moments or before.solver == "adam" for before, after in pairwise(short))


def test_terms_and_parameters_that_only_masks_determine_are_left_out():
    first = StageConfig("first", 3, ("keypoints", "pose_prior"), keypoints_off=("tail_tip",))
    optimised = ("global_orient", "betas")
    masks = StageConfig("masks", 5, ("mask", "shape_norm", "stage_anchor"), optimised, keypoints_off=("crown",))
    assert staged(first, masks)[1] == dataclasses.replace(first, name="masks", steps=5, carry_moments=True)


def test_the_steps_of_another_solver_do_not_count():
    first = StageConfig("first", 12, ("keypoints",), solver="levenberg_marquardt")
    second = staged(first, StageConfig("masks", 400, ("mask",), solver="adam"))[1]
    assert (second.solver, second.steps) == ("levenberg_marquardt", 12)


def test_a_config_with_mask_stages_only_loses_the_mask_terms():
    stage = StageConfig("only", 3, ("keypoints", "mask", "pose_prior"))
    mask = StageConfig("mask", 3, ("mask",))
    assert [stage.terms for stage in staged(stage, mask)] == [("keypoints", "pose_prior")]


def test_moments_do_not_pass_over_a_stage_that_is_left_out():
    first = StageConfig("first", 3, ("keypoints", "mask"), solver="levenberg_marquardt")
    mask = StageConfig("mask", 3, ("mask",))
    last = StageConfig("last", 3, ("keypoints", "mask"), carry_moments=True)
    assert [(stage.name, stage.carry_moments) for stage in staged(first, mask, last)] == [
        ("first", False),
        ("last", False),
    ]
    assert [stage.carry_moments for stage in staged(mask, last)] == [False]


def test_a_config_that_compares_masks_only_is_refused():
    some = dataclasses.replace(config(), stages=(StageConfig("outline", 1, ("mask",)),))
    with pytest.raises(InputError, match="birds: holds no masks, but every term of the config compares masks"):
        _without_mask_stages([some], "birds")


def test_warnings_name_the_stages(caplog):
    stages = (
        StageConfig("early", 1, ("mask",)),
        StageConfig("points", 1, ("keypoints",)),
        StageConfig("late", 1, ("keypoints", "mask")),
    )
    _without_mask_stages([dataclasses.replace(config(), stages=stages)], "birds")
    assert "birds: no masks, so these stages run without the terms that compare masks: late" in caplog.text
    assert "birds: no masks, so these stages are skipped: early" in caplog.text


@pytest.mark.extended
def test_photographs_with_keypoints_only_converge(reference_dir):
    bird = import_model("aves", [reference_dir / "models" / "aves"])
    for species in ("029.American_Crow", "087.Mallard"):
        observations = dataclasses.replace(read_coco(reference_dir / "cub" / f"{species}.json"), masks={})
        photo = dataclasses.replace(load_config("photo"), learn_weights=())
        converged = total_loss(observations, with_last_steps(without_mask_stages(photo), 300), bird)
        assert (total_loss(observations, photo, bird) < 1.005 * converged).all()
