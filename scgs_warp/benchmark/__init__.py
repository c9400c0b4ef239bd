"""Benchmarks of a frame, a rasterisation, a training step and an edit."""
