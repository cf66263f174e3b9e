"""Studies that simulate a system many times."""
