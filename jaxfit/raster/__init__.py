"""The soft silhouette, the z-buffer renderer, and the compiled kernels of both."""
