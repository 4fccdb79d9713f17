"""The objective: short pure terms and their weighted sum. The import of this package registers jaxfit's own terms."""

from jaxfit.objective import likelihood, temporal, terms

__all__ = ["likelihood", "temporal", "terms"]
