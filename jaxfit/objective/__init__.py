"""The objective: short pure terms and their weighted sum. The import of this package registers jaxfit's own terms."""

from jaxfit.objective import plausibility, smoothness, temporal, terms

__all__ = ["plausibility", "smoothness", "temporal", "terms"]
