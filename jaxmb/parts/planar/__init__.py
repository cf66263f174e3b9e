"""Parts of planar scenes, one family a file."""
