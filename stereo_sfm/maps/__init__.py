"""Persistent maps: saving, loading, merging, extending, and relocalization."""
