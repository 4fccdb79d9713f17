"""Export of results to files that other tools open."""
