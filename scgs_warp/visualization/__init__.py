"""Pictures and films of a scene and of a run."""
