"""Bird models: mesh, joint tree, priors, pose, camera and kinematics."""
