"""Sections of the panel beside the picture."""
