"""Files and folders: atomic writing, checkpoints, JSON, numpy arrays, output folders, safe paths."""
