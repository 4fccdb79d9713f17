"""Corrections of tracks by hand: swap, cut, join and delete tracks, and fit the touched windows again."""
