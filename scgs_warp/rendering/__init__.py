"""Gaussians to images."""
