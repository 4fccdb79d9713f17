"""Observations without masks: the config loses the stages that compare masks. tests/cli/test_import.py fits one."""

import dataclasses

import pytest
from support.fits import config

from jaxfit.config.fit import StageConfig, load_config
from jaxfit.fitting.stages import without_mask_stages


@pytest.mark.parametrize("name", ["paper", "baseline", "photo"])
def test_shipped_configs_lose_their_mask_stages(name):
    whole = load_config(name)
    short = without_mask_stages(whole)
    assert 0 < len(short.stages) < len(whole.stages)
    assert not any(term.startswith("mask") for stage in short.stages for term in stage.terms)
    assert [stage.terms for stage in short.stages] == [stage.terms for stage in whole.stages[: len(short.stages)]]


def test_stages_after_a_mask_stage_start_without_moments():
    stages = tuple(
        StageConfig(name, 3, ("keypoints", *["mask"] * ("m" in name)), carry_moments=carry)
        for name, carry in (("a", False), ("m", True), ("b", True), ("c", True))
    )
    short = without_mask_stages(dataclasses.replace(config(), stages=stages))
    assert [(stage.name, stage.carry_moments) for stage in short.stages] == [("a", False), ("b", False), ("c", True)]


def test_a_config_with_mask_stages_only_loses_the_mask_terms():
    stage = StageConfig("only", 3, ("keypoints", "mask", "pose_prior"))
    mask = StageConfig("mask", 3, ("mask",))
    short = without_mask_stages(dataclasses.replace(config(), stages=(stage, mask)))
    assert [stage.terms for stage in short.stages] == [("keypoints", "pose_prior"), ("mask",)]
