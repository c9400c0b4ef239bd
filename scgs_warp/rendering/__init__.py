"""Rendering: Gaussians to images."""
