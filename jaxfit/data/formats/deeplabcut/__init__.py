"""File formats of DeepLabCut."""
