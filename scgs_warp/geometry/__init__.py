"""Cameras, quaternions and scene normalisation."""
