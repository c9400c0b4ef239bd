"""Pages of scenes from a local server: access control, the server, and the view of a run, a file or a training."""
