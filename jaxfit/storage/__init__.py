"""Storage: files and folders written atomically, safe reading of arrays, and validation of array layouts."""
