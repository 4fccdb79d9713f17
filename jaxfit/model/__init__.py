"""What a bird is: mesh, joint tree, priors, pose and kinematics."""
