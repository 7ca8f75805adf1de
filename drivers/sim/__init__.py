"""The simulated store and its cameras."""
