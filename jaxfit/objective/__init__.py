"""The objective: short pure terms and their weighted sum. Importing it registers the library's own terms."""

from jaxfit.objective import anatomy, smoothness, temporal, terms

__all__ = ["anatomy", "smoothness", "temporal", "terms"]
