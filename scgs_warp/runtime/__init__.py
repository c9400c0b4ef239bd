"""Services around the computation: environment, threads, kernel launches, memory, progress, stop signals."""
