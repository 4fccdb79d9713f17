"""Limits on input: what jaxfit rejects before it takes memory or time that a damaged file could demand.

Each limit is far above real input. docs/limits.md lists all of them.
"""

# --- messages
MESSAGE_CHARACTERS = 300
"""Longest message of an error or a warning on the command line."""

# --- images and masks
IMAGE_SIDE_PX = 16_384
"""Longest side of an image or a mask. The run lengths of larger masks overflow the buffers of pycocotools."""

# --- birds far outside their image, and crops
DISTANCE_IMAGE_SIDES = 1.0
"""Largest distance of a box or a keypoint outside its image, as a multiple of the image's longer side. A fit skips and
reports frames with a larger distance."""
CROP_IMAGE_SIDES = 2
"""Largest side of a crop, as a multiple of the longer side of its image."""

# --- polygons of masks
POLYGONS = 256
"""Largest number of polygons of one mask."""
POLYGON_LENGTH_PX = 1_000_000
"""Largest length of the outlines of one mask. pycocotools takes time and memory for every pixel of an edge."""
