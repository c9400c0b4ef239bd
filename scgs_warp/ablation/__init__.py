"""Ablations: one training run per cell of a table, on this machine or on a Ray cluster."""
