"""Forms of the stages for CUDA, by warps or blocks of threads, under the file names of their portable forms."""
