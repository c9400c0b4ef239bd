"""CUDA forms of the stages, which work by warps or blocks of threads; file names match the portable forms."""
