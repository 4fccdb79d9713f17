"""What people do with results: frames to label, corrected tracks, joined results."""
