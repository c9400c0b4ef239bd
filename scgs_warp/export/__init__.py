"""Scenes in files that other programs open."""
