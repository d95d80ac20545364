"""Takes as weights of blendshapes."""
