"""Learnt weights on the command line: `learnt.yaml` holds them, and a fit with this file gives the same result."""

import numpy as np
import pytest
from support.cli_files import arguments

from jaxfit.cli.main import main
from jaxfit.config.fit import load_config
from jaxfit.data.solution import load_solution
from jaxfit.fitting import learn

CONFIG = """
base: paper
window: 6
crop: {mode: image, size_px: 64}
learn_weights: [keypoint_likelihood, mask_smooth_l1]
terms: {keypoint_likelihood: {sd_sure_px: 2}, pose_prior: 0.5, motion_likelihood: 1}
stages:
  - name: only
    solver: levenberg_marquardt
    steps: 10
    terms: [keypoint_likelihood, pose_prior, motion_likelihood]
    step_scale: {transl: [1, 1, 0]}
"""


@pytest.mark.extended
def test_a_fit_with_learnt_yaml_gives_the_same_result(inputs, tmp_path):
    (tmp_path / "learning.yaml").write_text(CONFIG)
    command = arguments(inputs, tmp_path / "first")
    command[command.index("--config") + 1] = str(tmp_path / "learning.yaml")
    assert main(command) == 0
    learnt = tmp_path / "first" / "learnt.yaml"
    assert "# learnt from the data: terms.keypoint_likelihood.sd_sure_px = " in learnt.read_text()
    config = load_config(learnt)
    assert config.terms["keypoint_likelihood"]["sd_sure_px"] != 2
    assert config == load_config(tmp_path / "first" / "config.yaml")
    command[command.index("--config") + 1] = str(learnt)
    command[command.index("--out") + 1] = str(tmp_path / "second")
    assert main(command) == 0
    assert not (tmp_path / "second" / "learnt.yaml").exists()
    a, b = (load_solution(tmp_path / name)[0] for name in ("first", "second"))
    np.testing.assert_array_equal(a.keypoints.px, b.keypoints.px)


def test_too_few_data_keep_the_config_and_the_file_gives_the_reason(inputs, tmp_path, monkeypatch):
    monkeypatch.setattr(learn, "MIN_FRAMES", 1000)
    (tmp_path / "learning.yaml").write_text(
        f"base: {inputs / 'quick.yaml'}\nlearn_weights: [keypoint_likelihood]\n"
        "terms: {keypoint_likelihood: {sd_sure_px: 2}}\n"
        "stages: [{name: only, steps: 2, terms: [keypoint_likelihood]}]\n"
    )
    assert main(arguments(inputs, tmp_path / "out", config=tmp_path / "learning.yaml")) == 0
    text = (tmp_path / "out" / "learnt.yaml").read_text()
    assert "# no weights are learnt: " in text
    assert "are too few" in text
    assert load_config(tmp_path / "out" / "learnt.yaml").terms["keypoint_likelihood"]["sd_sure_px"] == 2
