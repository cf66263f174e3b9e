"""Linear algebra and rotation algebra that the rest is built on."""
