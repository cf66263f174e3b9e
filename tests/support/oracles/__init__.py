"""Models that share no code with the package."""
