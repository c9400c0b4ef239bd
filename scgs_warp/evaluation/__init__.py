"""Metrics of a trained scene: images and motion."""
