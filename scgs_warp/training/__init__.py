"""Training: the loop, one step of it, adaptive density control, the run folder."""
