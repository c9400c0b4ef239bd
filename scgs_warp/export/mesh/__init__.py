"""Triangle meshes of a scene: the surface at a moment, its colours, its motion, and files that hold them."""
