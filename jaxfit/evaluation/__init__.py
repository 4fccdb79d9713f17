"""How good a result is: metrics, and a result against annotations."""
