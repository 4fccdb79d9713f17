"""The library runs under jaxtyping's import hook, which checks all annotated shapes and types."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.extended

HOOK = """
import sys
import warnings
warnings.filterwarnings("ignore")
from jaxtyping import install_import_hook
# an int is a valid float, as for static type checkers
install_import_hook("jaxfit", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")
sys.path.insert(0, {tests!r})
"""

POSE = """
import jax.numpy as jnp
import numpy as np
from support.birds import random_pose, toy_bird
from jaxfit.fitting import windows
from jaxfit.model import camera, kinematics, rotation
from jaxfit.model.kinematics import rest_pose

bird = toy_bird()
rig, one = kinematics.fold_bird(bird), random_pose(bird, 0)
A = kinematics.joint_transforms(rig, one)
kinematics.posed_joints(rig, A, one)
camera.to_screen(kinematics.posed_keypoints(rig, A, one), camera.CropCamera())
kinematics.posed_vertices(rig, A, one)
rest_pose(bird), rest_pose(bird, 3), rest_pose(bird, 3, True)
R = rotation.axis_angle_to_matrix(jnp.ones((4, 3)))
rotation.unwrap_axis_angle(rotation.matrix_to_axis_angle(R))
rotation.geodesic_distance(R, R)
rotation.view_grid(5, 4), rotation.viewing_axis_rotations(30)
windows.weighted_median_filter(np.ones((6, 5, 2), np.float32), np.ones((6, 5), np.float32))
assert bird.keypoints.shape == (12, 3)
"""

OBJECTIVE = """
from support.terms_by_hand import all_settings, every_gradient, posed_window, random_targets, window_pose
from jaxfit.objective.objective import evaluate_terms
from jaxfit.objective.registry import find_terms
pose = window_pose()
evaluate_terms(posed_window(pose, random_targets()), find_terms(all_settings()), all_settings())
every_gradient(pose, pose, random_targets(), all_settings())
"""

FIT = """
from pathlib import Path
from support.cli_files import arguments, write_inputs
from jaxfit.cli.main import main

folder = Path({folder!r})
write_inputs(folder)
(folder / "full.yaml").write_text('''
base: paper
window: 6
edge: unbiased
error_bars: true
crop: {{size_px: 64}}
initialise: {{method: so3, turns: 6, directions: 8, hypotheses: 2}}
terms: {{keypoints: 100, mask: 1, mask_smooth_l1: 1, bone_prior: 1, shape_prior: 1, shape_norm: 1, stage_anchor: 1}}
stages:
  - {{name: least_squares, steps: 2, terms: [keypoints, pose_prior, velocity, acceleration],
     optimised: [global_orient, scale], solver: levenberg_marquardt}}
  - {{name: a, steps: 2, terms: [keypoints, pose_prior, bone_prior, shape_prior, velocity],
     optimised: [global_orient, betas], keep_best: true}}
  - {{name: b, steps: 2, terms: [keypoints, mask, mask_smooth_l1, shape_norm, stage_anchor, acceleration],
     optimised: [body_pose, bone_length, transl, scale], blur: 0.5, carry_moments: true, keypoints_off: [crown]}}
''')
assert main(arguments(folder, folder / "out", config="full.yaml")) == 0
again = ["--init", str(folder / "out" / "poses.npz")]
assert main([*arguments(folder, folder / "on", config="full.yaml"), *again]) == 0
assert main(["evaluate", str(folder / "out"), "--truth", str(folder / "birds.json")]) == 0
assert main(["model", "info", str(folder / "toy.npz")]) == 0
"""

SCENE = """
from pathlib import Path
from jaxfit.cli.main import main

folder = Path({folder!r})
scene, out = str(folder / "scene"), str(folder / "o.mp4")
assert main(["simulate", "--birds", "2", "--frames", "3", "--size", "320x200", "--out", scene]) == 0
assert main(["evaluate", scene + "/truth", "--truth", scene]) == 0
assert main(["overlay", scene + "/truth", "--video", scene + "/footage.mp4", "--side-views", "--out", out]) == 0
assert main(["model", "view", "murre", "--out", str(folder / "views.png")]) == 0
"""

VIEWS = """
from pathlib import Path
from jaxfit.cli.main import main

folder = Path({folder!r})
scene, quick = folder / "scene", folder / "quick.yaml"
size = ["--birds", "2", "--frames", "12", "--size", "480x280", "--seed", "3"]
assert main(["simulate", *size, "--cameras", "3", "--distortion", "--out", str(scene)]) == 0
cameras, files = str(scene / "cameras.toml"), [str(scene / f"cam{{i}}" / "detections.json") for i in range(3)]
assert main(["cameras", "show", cameras, "--out", str(folder / "plan.png")]) == 0
assert main(["cameras", "check", cameras, *files]) == 0
quick.write_text('''
base: paper
window: 12
crop: {{size_px: 64}}
stages:
  - {{name: a, steps: 2, terms: [keypoints, mask, pose_prior, place_likelihood], solver: levenberg_marquardt}}
''')
assert main(["fit", *files, "--cameras", cameras, "--config", str(quick), "--out", str(folder / "result")]) == 0
"""


def run_with_checks(program, **environment):
    """Run a program in a new process with the import hook."""
    head = HOOK.format(tests=str(Path(__file__).parent))
    command = [sys.executable, "-c", head + program]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=False)


def test_the_hook_catches_a_wrong_shape():
    wrong = "import jax.numpy as jnp\nfrom jaxfit.model.rotation import *\naxis_angle_to_matrix(jnp.ones((2, 4)))"
    done = run_with_checks(wrong)
    assert done.returncode != 0
    assert "parameter 'axis_angle'" in done.stderr


@pytest.mark.parametrize("name", ["objective", "fit", "scene", "views"])
def test_annotations_are_satisfied(name, tmp_path):
    program = {"objective": POSE + OBJECTIVE, "fit": FIT, "scene": SCENE, "views": VIEWS}[name]
    program = program if name == "objective" else program.format(folder=str(tmp_path))
    done = run_with_checks(program, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr[-3000:]
