"""The live viewer, in its own process, and its null object."""
