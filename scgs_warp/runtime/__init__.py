"""The process and its devices: environment, threads, launches, memory, progress, stop signals."""
