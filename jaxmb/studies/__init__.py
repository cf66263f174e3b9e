"""What motions are simulated for."""
