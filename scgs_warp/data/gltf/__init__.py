"""Reader of glTF 2.0 files as moving triangle meshes."""
