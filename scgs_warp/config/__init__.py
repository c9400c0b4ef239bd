"""Settings of a training run: fields with their defaults, presets, validation."""
