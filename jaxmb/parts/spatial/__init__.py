"""Parts of spatial scenes, one family a file."""
