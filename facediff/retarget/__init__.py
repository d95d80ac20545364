"""Takes carried over to other meshes."""
