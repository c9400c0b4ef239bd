"""File formats that hold Gaussians."""
