"""Readers of camera files, one module per program. `jaxfit.cameras.files` recognises the program."""
