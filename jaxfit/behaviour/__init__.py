"""What birds do: features of every frame, bouts of behaviour, time budgets."""
