"""Read the frames of videos, and write frames as videos."""
