"""The process and its devices: environment, threads, kernel launches, memory, progress, stop signals."""
