"""Simulation of birds with known truth.

`scene` simulates a whole scene of murres: `behaviour` and `flock` simulate their motion, `viewpoint` is the camera,
`individuals` draws their bodies, `footage` renders the pictures with the ledge, and `noise` simulates the errors of
detectors.
"""
