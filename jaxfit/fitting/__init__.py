"""The fit, from observations to poses: windows, initial poses, stages, solvers, and the solution."""
