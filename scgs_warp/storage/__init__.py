"""Files and folders: atomic writing, checkpoints, JSON, NumPy arrays, pictures, output folders, safe paths."""
