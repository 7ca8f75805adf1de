"""The service on a robot: a source tracked without end, its map kept, its pose given to others."""
