"""The objective: short pure terms and their weighted sum. Importing it registers the library's own terms."""

from jaxfit.objective import plausibility, smoothness, temporal, terms

__all__ = ["plausibility", "smoothness", "temporal", "terms"]
