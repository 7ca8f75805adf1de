"""The stages wired together: inline, as processes, on a recorded schedule."""
