"""Frames of many kinds of birds in many kinds of landscapes, for networks that must know more than one ledge."""
