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

# --- configs and grids
CONFIG_BYTES = 1_000_000
"""Largest size of a config or grid file. The shipped configs have about 3,000 bytes."""
CONFIG_LEVELS = 50
"""Largest depth of lists and mappings inside each other in a config. The shipped configs have up to 6 levels."""
CONFIG_VALUES = 100_000
"""Largest number of keys, values, lists and mappings in a config; an alias counts with all values of its anchor."""
CONFIG_DIGITS = 100
"""Most characters of a number in a config."""
CONFIG_KEY_CHARACTERS = 1_000
"""Longest key in a config."""
CONFIG_BASES = 20
"""Most files in a chain of bases of one config."""
GRID_RUNS = 10_000
"""Most runs of a grid or a sweep. The grid of the paper has 34 runs."""
ABLATION_BYTES = 200_000_000
"""Largest size of a file that describes the runs of an ablation (ablation.json), or their metrics."""
TERM_NUMBER = 1e30
"""Largest weight or setting of a term; larger values overflow in 32-bit numbers."""
