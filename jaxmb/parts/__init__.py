"""What a scene is made of."""
