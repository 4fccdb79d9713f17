"""The raster core: the soft silhouette, the z-buffer, and the compiled kernels of both."""
