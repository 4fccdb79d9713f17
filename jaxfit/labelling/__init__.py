"""Choice of the frames of a video that a person should label."""
