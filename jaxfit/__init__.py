"""jaxfit: temporally consistent 3D pose and shape of birds from ordinary video."""
