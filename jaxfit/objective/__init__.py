"""The objective: short pure terms and their weighted sum."""
