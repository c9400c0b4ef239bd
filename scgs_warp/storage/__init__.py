"""Files and folders: atomic writing, checkpoints, JSON, NumPy arrays, output folders, safe paths."""
