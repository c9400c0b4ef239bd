"""SIMD forms of the stages for the CPU, under the file names of their portable forms."""
