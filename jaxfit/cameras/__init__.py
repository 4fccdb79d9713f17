"""Calibrated cameras in one world: lens, pose, files of other programs, triangulation."""
