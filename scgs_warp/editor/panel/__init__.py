"""The panel beside the picture, one file per tab. Sections know the editor through ``host.Host`` alone."""
