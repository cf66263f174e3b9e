"""Initial states, equilibria, and the ranks of constraints."""
