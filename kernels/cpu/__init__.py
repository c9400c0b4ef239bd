"""SIMD forms of the stages for the CPU; file names match the portable forms."""
