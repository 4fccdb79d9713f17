"""Simulation of birds with known truth.

`scene` simulates a whole scene of murres: `behaviour` and `flock` simulate their motion, `viewpoint` is the camera,
`visibility` renders masks and occlusion, `ledge`, `texture` and `footage` render the pictures, and `noise` simulates
the errors of detectors. For any bird model, `motion` draws smooth poses from the pose prior, and `detections` renders
observations of these poses without a background.
"""
