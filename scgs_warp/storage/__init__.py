"""Files and folders: checkpoints, JSON, output folders, safe paths."""
