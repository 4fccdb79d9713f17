"""Limits on input: what jaxfit rejects before it takes memory or time that a damaged file could demand.

Each limit is far above real input. docs/limits.md lists all of them.
"""

# --- messages
MESSAGE_CHARACTERS = 300
"""Longest message of an error or a warning on the command line."""

# --- images and masks
IMAGE_SIDE_PX = 16_384
"""Longest side of an image or a mask. The run lengths of larger masks overflow the buffers of pycocotools."""

# --- arrays (.npz and .npy files)
NPZ_BYTES = 2**30
"""Memory of all arrays that jaxfit reads from one .npz file: a result of about 1,000,000 birds × frames."""
NPZ_ARRAYS = 1000
"""Number of arrays in an .npz file."""
NPZ_DIRECTORY_BYTES = 2**20
"""Size of the table of contents of an .npz file."""
NPY_HEADER_BYTES = 4096
"""Size of the header of an array in an .npz or .npy file."""
NPY_DIMENSIONS = 8
"""Dimensions of an array in an .npz or .npy file."""
NPZ_TEXT_CHARACTERS = 1000
"""Length of one text in an array of texts."""

# --- bird models
MODEL_BYTES = 2**27
"""Memory of all arrays of a bird model; the arrays of the murre have 2 MB."""
MODEL_VERTICES = 100_000
"""Vertices of a bird model."""
MODEL_FACES = 200_000
"""Faces of a bird model."""
MODEL_JOINTS = 256
"""Joints of a bird model."""
MODEL_KEYPOINTS = 256
"""Keypoints of a bird model."""
MODEL_SHAPES = 256
"""Shape coefficients of a bird model."""
CHECKPOINT_BYTES = 2**28
"""Size of a PyTorch checkpoint of a bird model; published models have about 2 MB."""
CHECKPOINT_OPCODES = 200_000
"""Length of the pickle of a PyTorch checkpoint."""
CHECKPOINT_ENTRIES = 10_000
"""Files in a PyTorch checkpoint."""
MODEL_JSON_BYTES = 2**24
"""Size of the JSON file of a bird model; the published file has about 3 MB."""

# --- written files
NAME_BYTES = 255
"""Length of one name in a path."""
LEFTOVER_DAYS = 7
"""Age at which jaxfit removes the temporary files of a killed process of another computer on a shared disk."""
