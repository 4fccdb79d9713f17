"""From observations to poses: windows, starting poses, stages, the solver, results."""
