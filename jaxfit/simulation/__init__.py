"""Birds with known truth.

`scene` puts a whole one together: `behaviour` and `flock` move murres, `viewpoint` looks at them, `visibility` says
what is seen, `ledge`, `texture` and `footage` film them, `noise` is what detectors would report. For any bird model and
without surroundings, `motion` draws smooth poses from its prior and `detections` makes plain observations of them.
"""
