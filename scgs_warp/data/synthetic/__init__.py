"""Synthetic data sets with known motion: the built-in figure and animated meshes."""
