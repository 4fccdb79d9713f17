"""Limits on input: what jaxfit rejects before it takes memory or time that a damaged file could demand.

Each limit is far above real input. docs/limits.md lists all of them.
"""

# --- messages
MESSAGE_CHARACTERS = 300
"""Longest message of an error or a warning on the command line."""

# --- images and masks
IMAGE_SIDE_PX = 16_384
"""Longest side of an image or a mask. The run lengths of larger masks overflow the buffers of pycocotools."""

# --- text files
JSON_LEVELS = 100
"""Largest depth of lists and objects inside each other in a JSON file."""
