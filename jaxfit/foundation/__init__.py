"""What every package uses: errors, limits, progress, safe files, worker processes."""
